"""Policies side by side on one scenario: same seeds, same scenes, same draws, paired intervals."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from sortie.perception.metrics.ap import Matched
from sortie.perception.metrics.bootstrap import compare as bootstrap
from sortie.policies.contract import Policy
from sortie.policies.registry import own_fusion, resolve
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import matched, outcome
from sortie.sim.results.record import SortieRecord

AREAS = {"full_scene": False, "mission": True}
"""Where AP is scored: its name in the outcome, and whether it is the mission's disc."""


class Contender(NamedTuple):
    """One of the policies that are compared."""

    label: str
    scenario: Scenario
    """With this policy in it; otherwise alike among contenders."""
    function: Policy | None = None
    """Decides in place of the scenario's policy; None where the scenario names it."""

    def with_own_fusion(self) -> Contender:
        """The same with the fusion that its method was published with, where it is a prior method."""
        fusion = None if self.function is not None else own_fusion(self.scenario.policy.name)
        if fusion is None:
            return self
        perception = self.scenario.perception.model_copy(update={"fusion": fusion})
        return self._replace(scenario=self.scenario.model_copy(update={"perception": perception}))


@dataclass(frozen=True, slots=True)
class Compared:
    """One policy's sortie under one seed, and its accuracy against the first policy's."""

    policy: str
    outcome: dict[str, Any]
    gain: dict[str, tuple[float, float, float] | None]
    """AP@0.5 minus the first policy's and its 95 % interval over the sortie's instants, `full_scene` and `mission`;
    None where it is not defined."""
    record: SortieRecord | None
    """None where several seeds were flown: their records would fill the memory."""


@dataclass(frozen=True, slots=True)
class Gain:
    """One policy's AP@0.5 minus the first policy's, over all seeds."""

    policy: str
    metric: str
    """`ap50.full_scene` or `ap50.mission`."""
    gain: float
    low: float
    high: float
    """The 95 % interval, by a paired bootstrap over what `over` names."""
    over: str
    """`instants of one sortie` or `sorties`: what was resampled, and so what the interval covers."""


class PairedFusions:
    """Fusions that the first policy and another one both scored, and what the bootstrap must not part."""

    def __init__(self) -> None:
        self._first: list[Matched] = []
        self._other: list[Matched] = []
        self._groups: list[int] = []

    def add(self, first: Sequence[Matched], other: Sequence[Matched], groups: Sequence[int]) -> None:
        """Add what the two sorties of one seed both scored."""
        self._first += first
        self._other += other
        self._groups += groups

    def gain(self) -> tuple[float, float, float] | None:
        """AP of the other minus the first's with its interval; None where there was nothing to find."""
        if not all(any(m.truths for m in arm) for arm in (self._first, self._other)):
            return None
        gain = bootstrap(self._first, self._other, self._groups)
        return gain.delta, gain.low, gain.high


def compare(
    contenders: Sequence[Contender],
    seeds: Sequence[int],
    *,
    progress: Callable[[str, int, float], None] | None = None,
) -> tuple[tuple[Compared, ...], tuple[Gain, ...]]:
    """Fly a scenario under several policies on the same seeds.

    Args:
        progress: called with the label, the seed and the simulated time.

    Returns:
        One `Compared` a seed and policy, seed by seed; and the gains of every policy but the first over all seeds.

    Raises:
        PolicyError: an unknown policy or parameter, before anything is flown.
    """
    for contender in contenders:
        if contender.function is None:
            resolve(contender.scenario.policy.name, contender.scenario.policy.params)
    flown: list[Compared] = []
    several = len(seeds) > 1
    pairs = {(c.label, name): PairedFusions() for c in contenders[1:] for name in AREAS}
    for k, seed in enumerate(seeds):
        first: SortieRecord | None = None
        for label, scenario, function in contenders:
            watch = None if progress is None else functools.partial(progress, label, seed)
            record = run_sortie(scenario, function, seed, progress=watch)
            gains: dict[str, tuple[float, float, float] | None] = dict.fromkeys(AREAS)
            if first is not None:
                for name, mission in AREAS.items():
                    theirs, ours, instants = pair_up([first], [record], mission=mission)
                    here = PairedFusions()
                    here.add(theirs, ours, instants)
                    gains[name] = here.gain()
                    pairs[label, name].add(theirs, ours, [k] * len(ours) if several else instants)
            first = record if first is None else first
            flown.append(Compared(label, outcome(record), gains, None if several else record))
    over = "sorties" if several else "instants of one sortie"
    over_all = {key: pair.gain() for key, pair in pairs.items()}
    return tuple(flown), tuple(Gain(label, f"ap50.{name}", *g, over) for (label, name), g in over_all.items() if g)


def pair_up(
    a: Sequence[SortieRecord],
    b: Sequence[SortieRecord],
    *,
    mission: bool,
    begin_s: float = 0.0,
    leaving_out: Collection[int] = (),
    whole_sorties: bool = False,
) -> tuple[list[Matched], list[Matched], list[int]]:
    """Fusions that two arms of sorties both scored, side by side, and what the bootstrap may not part.

    Args:
        a, b: records in pairs.
        mission, begin_s: as for `matched`.
        leaving_out: drones that are not counted.
        whole_sorties: those of one sortie stand or fall together; else those of one instant.
    """
    first: list[Matched] = []
    second: list[Matched] = []
    groups: list[int] = []
    instants: dict[tuple[int, float], int] = {}
    for k, (one, other) in enumerate(zip(a, b, strict=True)):
        ours, theirs = (matched(r, mission=mission, begin_s=begin_s) for r in (one, other))
        for t_s, drone in ours:
            if (t_s, drone) in theirs and drone not in leaving_out:
                first.append(ours[t_s, drone])
                second.append(theirs[t_s, drone])
                groups.append(k if whole_sorties else instants.setdefault((k, t_s), len(instants)))
    return first, second, groups
