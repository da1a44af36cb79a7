"""Places of policies on a suite: from their flights to a table in which policies that cannot be told apart share places."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sortie.scenarios.control_variates import controlled_mean
from sortie.scenarios.intervals import AMOUNT, LEVEL, SHARE, Estimate, Floats, Range, mean_interval
from sortie.scenarios.schema.conditions import ConditionSet
from sortie.sim.experiment.flight import Flight
from sortie.sim.folders import RunError
from sortie.sim.results.outcome import possible

METRICS = (
    "ap50.mission",
    "ap50.full_scene",
    "tracking.hota",
    "bytes.data_sent",
    "bytes.context_sent",
    "energy_j.total",
    "energy_j.fault",
    "energy_j.radio",
    "deadline_miss_rate",
    "mission.target_detected_share",
    "mission.target_in_view_share",
    "mission.region_observed_share",
    "mission.flown_share",
    "policies.violated_ticks",
    "policies.invariant_violations",
    "switches",
    "age_s.p99",
    "policy_eval_us.p50",
    "policy_eval_us.p99",
)
"""What is kept of each flight: numbers of its outcome, by their names."""
Flights = dict[str, dict[str, Flight]]
"""By policy and condition."""


@dataclass(frozen=True, slots=True)
class Standing:
    """One policy among all that are ranked."""

    policy: str
    place: tuple[int, int]
    """The best and the worst place that the intervals leave open; with 95 % confidence, the true places of all policies lie
    within theirs."""
    score: Estimate
    """Mean AP@0.5 over conditions: of the mission region in conditions with a region, else of the full scene. The interval
    is Student's, 95 %, over conditions; with `Control`, as `control_variates.controlled_mean` has it."""
    failed: tuple[str, ...]
    """Conditions in which the policy failed. It has a score of 0 there, the lowest."""
    figures: Mapping[str, Estimate]
    """Means of each of `METRICS`, with 95 % intervals, over the conditions in which the policy flew and that have a value."""

    @property
    def energy_j(self) -> float:
        """Mean energy of a sortie without what battery faults take, J."""
        return self.figures["energy_j.total"].mean - self.figures["energy_j.fault"].mean


@dataclass(frozen=True, slots=True)
class PairDifference:
    """One policy's score minus another's, over the same conditions."""

    policy: str
    other: str
    difference: Estimate
    """With an interval so wide that all intervals of a ranking hold their true differences at once with 95 % confidence."""

    @property
    def sign(self) -> int:
        """1 where the policy is better, −1 where the other one is, 0 where the interval does not tell."""
        return (self.difference.low > 0) - (self.difference.high < 0)


class Control(NamedTuple):
    """The surrogate's flights, as control variates for those by another detector."""

    suite: ConditionSet
    """The conditions of the ranking, in their order, and further ones behind them."""
    flights: Mapping[str, Mapping[str, Flight]]
    """Of the same policies in all of these conditions."""


class Scored(NamedTuple):
    """One policy's AP in each condition, or the difference of two policies'; 0 where a policy failed."""

    ap: Floats
    """[conditions]"""
    surrogate: Floats
    """[conditions and further ones], NaN where there is none; empty without `Control`."""

    def minus(self, other: Scored) -> Scored:
        """The difference, condition by condition."""
        return Scored(self.ap - other.ap, self.surrogate - other.surrogate)

    def mean(self, within: Range, level: float = LEVEL) -> Estimate:
        """Over the conditions, corrected by the surrogate's where there are any."""
        if not len(self.surrogate):
            return mean_interval(self.ap, within, level)
        paired, further = np.split(self.surrogate, [len(self.ap)])
        return controlled_mean(self.ap, paired, further, level).estimate


def scores(
    suite: ConditionSet, flights: Mapping[str, Mapping[str, Flight]], control: Control | None = None
) -> dict[str, Scored]:
    """The AP of each policy in each condition, by the condition's metric.

    Conditions in which a policy has no AP although it flew, because no car was to be seen, are left out for all.

    Raises:
        RunError: no condition is left.
    """
    found = {policy: _aps(suite, of_policy) for policy, of_policy in flights.items()}
    known: NDArray[np.bool_] = np.isfinite(np.array(list(found.values()))).all(axis=0)
    if not known.any():
        raise RunError("no condition has an accuracy under every policy: no car was to be seen, or nothing was scored")
    if control is None:
        return {policy: Scored(values[known], np.zeros(0)) for policy, values in found.items()}
    further = len(control.suite.conditions) - len(known)
    kept = np.concatenate([known, np.full(further, True)])
    return {
        policy: Scored(values[known], _aps(control.suite, control.flights[policy])[kept])
        for policy, values in found.items()
    }


def _aps(suite: ConditionSet, flights: Mapping[str, Flight]) -> Floats:
    """[conditions]: 0 where the policy failed, NaN where no car was to be seen."""
    each = [(flights[c.name], f"ap50.{c.metric}") for c in suite.conditions]
    return np.array([0.0 if f.error else math.nan if f.values[name] is None else f.values[name] for f, name in each])


def differences(scored: Mapping[str, Scored]) -> list[PairDifference]:
    """Every pair of policies once, in the order of the policies.

    Intervals are of paired differences, with Bonferroni's correction for the number of pairs.
    """
    pairs = list(itertools.combinations(scored, 2))
    level = 1 - (1 - LEVEL) / max(1, len(pairs))
    return [PairDifference(a, b, scored[a].minus(scored[b]).mean(SHARE.of_differences(), level)) for a, b in pairs]


def places(policies: Sequence[str], pairs: Sequence[PairDifference]) -> dict[str, tuple[int, int]]:
    """The best and the worst place of each policy: behind all that are better, ahead of all that are worse.

    If every interval holds its true difference, each policy's true place lies within its range (Klein, Wright and
    Wieczorek, *A joint confidence region for an overall ranking of populations*, 2020).

    Example:
        >>> apart = PairDifference("a", "b", Estimate(0.2, 0.1, 0.3, 30))
        >>> open_ = [PairDifference(p, "c", Estimate(0.0, -0.1, 0.1, 30)) for p in "ab"]
        >>> places("abc", [apart, *open_])
        {'a': (1, 2), 'b': (2, 3), 'c': (1, 3)}
    """
    better, worse = dict.fromkeys(policies, 0), dict.fromkeys(policies, 0)
    for pair in pairs:
        if pair.sign:
            first, last = (pair.policy, pair.other) if pair.sign > 0 else (pair.other, pair.policy)
            worse[first] += 1
            better[last] += 1
    return {p: (1 + better[p], len(policies) - worse[p]) for p in policies}


def standings(
    suite: ConditionSet, flights: Mapping[str, Mapping[str, Flight]], control: Control | None = None
) -> tuple[list[Standing], list[PairDifference]]:
    """All policies, the highest score first, and the differences that their places follow from.

    Raises:
        RunError: no condition has an accuracy under every policy.
    """
    scored = scores(suite, flights, control)
    pairs = differences(scored)
    place = places(list(scored), pairs)
    rows = [
        Standing(
            policy,
            place[policy],
            scored[policy].mean(SHARE),
            tuple(c.name for c in suite.conditions if flights[policy][c.name].error),
            {name: _mean(name, flights[policy].values()) for name in METRICS},
        )
        for policy in scored
    ]
    return sorted(rows, key=lambda r: -r.score.mean), pairs


def _mean(name: str, flights: Iterable[Flight]) -> Estimate:
    values = [f.values[name] for f in flights if f.values[name] is not None]
    wall_clock = name.startswith("policy_eval_us")
    return mean_interval(np.array(values, float), AMOUNT if wall_clock else possible(name))
