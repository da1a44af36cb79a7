"""Rank policies on a suite: fly what is not there, take what comes with Sortie, and compare."""

from __future__ import annotations

import functools
import hashlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sortie.policies.contract import Policy, PolicyError
from sortie.policies.registry import POLICIES, resolve
from sortie.scenarios.reading.load import condition_sets, load, load_conditions, read
from sortie.scenarios.schema.conditions import Condition, ConditionSet
from sortie.sim.experiment.conditions import fly_suite, scenario_of
from sortie.sim.experiment.flight import Flight
from sortie.sim.experiment.places import METRICS, Control, Flights, PairDifference, Standing, standings
from sortie.sim.experiment.pools import processes
from sortie.sim.experiment.stored import Results, read_results
from sortie.sim.experiment.verdict import Verified, verify
from sortie.sim.folders import RunError
from sortie.sim.identity import code_version

SUITE = "ranking_v1"
BY_TORCH = ("perception.detector=torch", "perception.sample_rate_hz=0.5")
"""What makes a suite fly with the neural detector, which takes most of a second for each scored instant."""
REFERENCE = "worked"
"""The policy whose flight in the first condition is compared with the stored one: equal records show that the stored
results are those of this version, and the times of its decisions how fast this machine is beside the other."""
FURTHER = 3
"""Further draws of the suite that the surrogate flies for a ranking by torch."""


class Entry(NamedTuple):
    """A policy that is ranked."""

    label: str
    function: Policy | None = None
    """Decides; None where the label names the policy."""


@dataclass(frozen=True, slots=True)
class Ranked:
    """A ranking."""

    suite: str
    digest: str
    sortie: str
    """The version of Sortie that ranked."""
    stored: str | None
    """The version that flew the built-in policies, where their stored results were taken."""
    stale: bool
    """Whether this version flies otherwise than that one did, so that the stored results are not its own."""
    speed: float
    """How many times as long a decision takes here as where the stored results were made."""
    detector: str
    rows: tuple[Standing, ...]
    """The highest score first."""
    pairs: tuple[PairDifference, ...]
    flights: Flights
    verified: dict[str, Verified]
    entries: tuple[str, ...]
    """The policies that were asked for."""
    taken: tuple[str, ...]
    """Those with stored results."""
    conditions: int
    control: Control | None
    """The surrogate's flights, by which a ranking by torch was made more precise."""
    width: float
    """Median width of the intervals of pairs relative to those without `control`; 1 without it."""

    def row(self, policy: str) -> Standing:
        """One policy's."""
        return next(r for r in self.rows if r.policy == policy)

    def against(self, policy: str) -> dict[str, PairDifference]:
        """A policy's score minus each other policy's, by the other's name."""
        found = {}
        for pair in self.pairs:
            if policy == pair.policy:
                found[pair.other] = pair
            elif policy == pair.other:
                d = pair.difference
                turned = replace(d, mean=-d.mean, low=-d.high, high=-d.low)
                found[pair.policy] = PairDifference(policy, pair.policy, turned)
        return {r.policy: found[r.policy] for r in self.rows if r.policy in found}

    def decision_us(self, policy: str) -> float:
        """Median time of a decision, mean over conditions, as on this machine, µs; NaN where the policy always failed."""
        own = self.row(policy).figures["policy_eval_us.p50"].mean
        return own * self.speed if policy in self.taken else own


def load_suite(name: str, *, by_torch: bool = False) -> ConditionSet:
    """A suite, as policies fly in it.

    Raises:
        ScenarioError: no such file, or an error in it.
        RunError: a file of another kind, or conditions without a seed and a town of their own.
    """
    suite = load_conditions(name)
    if suite is None:
        raise RunError(f"--suite {name}: holds no conditions; ranking_v1 is a suite, and so is any set of conditions")
    if suite.seeds:
        raise RunError(
            f"--suite {name}: seeds is {list(suite.seeds)}, must be [], with a `seed=` in the `set` of each condition: "
            "places are compared over conditions that are drawn independently"
        )
    flown: dict[tuple[str, int], str] = {}
    for condition in suite.conditions:
        scenario = load(suite.base, [*suite.set, *condition.set])
        for field, value in (("seed", scenario.seed), ("perception.scene.seed", scenario.perception.scene.seed)):
            other = flown.setdefault((field, value), condition.name)
            if other != condition.name:
                raise RunError(
                    f"--suite {name}: {field} is {value} in {other} and in {condition.name}, must differ from condition to "
                    f"condition: write `{field}=` into the `set` of each; places are compared over independent draws"
                )
    return suite.model_copy(update={"set": (*suite.set, *BY_TORCH)}) if by_torch else suite


def rank(
    entries: Sequence[Entry],
    kept: Path | None = None,
    *,
    suite: str = SUITE,
    against: Sequence[str] | None = None,
    again: bool = False,
    by_torch: bool = False,
    further: int | None = None,
    workers: int = 1,
    progress: Callable[[str, int, int], None] = lambda stage, done, of: None,
) -> Ranked:
    """Rank policies among others.

    Args:
        entries: the policies that are asked for.
        kept: the file that flights are taken from, and kept in.
        suite: a library suite's name, or a file.
        against: names of the policies to rank them among; None is every built-in one with stored results, or every one where
            nothing stored is taken.
        again: fly these too, instead of taking the results that come with Sortie.
        by_torch: fly with the neural detector, and with the surrogate as control variate.
        further: draws of the suite that the surrogate flies beyond the suite itself; 0 flies torch alone; None is `FURTHER`
            for a suite of the library, else 0.
        workers: how many processes fly.
        progress: called with a stage, how much of it is done, and of how much.

    Raises:
        ScenarioError, PolicyError, RunError: the suite, a policy or the file is wrong, before anything flies.
    """
    asked = load_suite(suite, by_torch=by_torch)
    if further is not None and not by_torch:
        raise RunError(f"--further {further}: needs --by-torch, which these further flights make more precise")
    more = _further(suite, further) if by_torch else []
    digest = digest_of(suite)
    own = {entry.label: entry for entry in entries}
    stored = None if again or by_torch else read_results(suite, digest)
    built_in = list(POLICIES if stored is None else stored.flights)
    others = [p for p in (built_in if against is None else against) if p not in own]
    if len(own) < len(entries) or not own:
        raise PolicyError(
            f"policies: {', '.join(e.label for e in entries) or 'none'}, must be one or more, each named once"
        )
    decides = {p: own[p].function if p in own else None for p in (*own, *others)}
    resolved = {p: _policy(asked, p) if f is None else f for p, f in decides.items()}
    flights: Flights = {}
    verified: dict[str, Verified] = {}
    taken = () if stored is None else tuple(p for p in decides if decides[p] is None and p in stored.flights)
    if stored is not None:
        flights |= {p: stored.flights[p] for p in taken}
        verified |= {p: stored.verified[p] for p in taken}
    if not taken:
        stored = None  # nothing of it is shown, so that it need not be this version's
    todo = {p: f for p, f in decides.items() if p not in flights}
    flights |= fly(asked, todo, workers=workers, kept=kept, progress=functools.partial(progress, "flights"))
    control = None
    if more:
        plain = load_suite(suite)
        wide = plain.model_copy(update={"conditions": (*plain.conditions, *more)})
        watch = functools.partial(progress, "flights by the surrogate")
        control = Control(wide, fly(wide, decides, workers=workers, kept=kept, progress=watch))
    for k, policy in enumerate(unproved := [p for p in decides if p not in verified]):
        progress("verification", k, len(unproved))
        verified[policy] = verify(resolved[policy])
    progress("verification", len(unproved), len(unproved))
    stale, speed = (False, 1.0) if stored is None else _checked(stored, asked, kept)
    flights = {p: flights[p] for p in decides}
    rows, pairs = standings(asked, flights, control)
    return Ranked(
        suite,
        digest,
        code_version(),
        None if stored is None else stored.sortie,
        stale,
        speed,
        "torch" if by_torch else "surrogate",
        tuple(rows),
        tuple(pairs),
        flights,
        verified,
        tuple(own),
        taken,
        len(asked.conditions),
        control,
        1.0 if control is None else _width(pairs, standings(asked, flights)[1]),
    )


def digest_of(suite: str) -> str:
    """The first twelve hex digits of SHA-256 over a suite's file: what a citation names.

    Raises:
        ScenarioError: no such file.
    """
    return hashlib.sha256(read(suite)[0].encode()).hexdigest()[:12]


def _further(suite: str, draws: int | None) -> list[Condition]:
    """The conditions that only the surrogate flies: further draws of the suite, which lie beside it in the library.

    Raises:
        RunError: more are asked for than there are.
    """
    more = load_conditions(f"{suite}_further") if f"{suite}_further" in condition_sets() else None
    found = () if more is None else more.conditions
    draw = [int(c.name.rpartition("_")[2]) for c in found]
    if draws is not None and draws > max(draw, default=0):
        raise RunError(f"--further {draws}: --suite {suite} has {max(draw, default=0)} further draws")
    return [c for c, number in zip(found, draw, strict=True) if number <= (FURTHER if draws is None else draws)]


def fly(
    suite: ConditionSet,
    decides: Mapping[str, Policy | None],
    *,
    workers: int = 1,
    kept: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Flights:
    """Fly policies once in each condition, those that are names in processes of their own.

    Args:
        decides, kept: as `fly_suite`.
        progress: called with how many flights there are, and of how many.
    """
    of, done = len(decides) * len(suite.conditions), itertools.count(1)
    with processes(min(workers, of)) as pool:
        found = fly_suite(suite, decides, METRICS, pool=pool, kept=kept, landed=lambda policy: progress(next(done), of))
    return {policy: {name: flight for name, (flight,) in its.items()} for policy, its in found.items()}


def _width(pairs: Sequence[PairDifference], alone: Sequence[PairDifference]) -> float:
    """Median width of intervals relative to others of the same pairs; 1 where there are none."""
    shares = [
        a.difference.half_width / b.difference.half_width
        for a, b in zip(pairs, alone, strict=True)
        if b.difference.half_width > 0
    ]
    return float(np.median(shares)) if shares else 1.0


def _policy(suite: ConditionSet, label: str) -> Policy:
    """What a name means, with the parameters in its brackets.

    Raises:
        PolicyError: there is no such policy.
    """
    section = scenario_of(suite, suite.conditions[0], label).policy
    return resolve(section.name, section.params)


def _checked(stored: Results, suite: ConditionSet, kept: Path | None) -> tuple[bool, float]:
    """Whether the stored results are not this version's, and how much slower this machine decides."""
    first = suite.conditions[0]
    here = fly(suite.model_copy(update={"conditions": (first,)}), {REFERENCE: None}, kept=kept)[REFERENCE][first.name]
    there = stored.flights[REFERENCE][first.name]
    return here.fingerprint != there.fingerprint, _time(here) / _time(there)


def _time(flight: Flight) -> float:
    return flight.values["policy_eval_us.p50"] or 1.0
