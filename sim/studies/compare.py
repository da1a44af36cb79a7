"""Policies side by side on one scenario: same seed, same scenes, same draws, paired intervals."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any

from sortie.perception.metrics.ap import Matched
from sortie.perception.metrics.bootstrap import compare as bootstrap
from sortie.policies.registry import resolve
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import matched, outcome
from sortie.sim.results.record import SortieRecord


@dataclass(frozen=True, slots=True)
class Compared:
    """One policy's sortie, and its accuracy against the first policy's."""

    policy: str
    record: SortieRecord
    outcome: dict[str, Any]
    gain: dict[str, tuple[float, float, float] | None]
    """AP@0.5 minus the first policy's and its 95 % interval, `full_scene` and `mission`; None where undefined."""


def compare(
    flown: Sequence[tuple[str, Scenario]],
    seed: int | None = None,
    *,
    progress: Callable[[str, float], None] | None = None,
) -> list[Compared]:
    """Fly a scenario under several policies on the same seed.

    Args:
        flown: label and scenario, alike but for their policy.
        progress: called with the label and the simulated time.

    Raises:
        PolicyError: an unknown policy or parameter, before anything is flown.
    """
    for _, scenario in flown:
        resolve(scenario.policy.name, scenario.policy.params)
    rows: list[Compared] = []
    for label, scenario in flown:
        watch = None if progress is None else functools.partial(progress, label)
        record = run_sortie(scenario, None, seed, progress=watch)
        first = rows[0].record if rows else None
        rows.append(Compared(label, record, outcome(record), _gain(record, first)))
    return rows


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


def _gain(record: SortieRecord, first: SortieRecord | None) -> dict[str, tuple[float, float, float] | None]:
    gains: dict[str, tuple[float, float, float] | None] = {"full_scene": None, "mission": None}
    if first is None:
        return gains
    for name, mission in (("full_scene", False), ("mission", True)):
        theirs, ours, groups = pair_up([first], [record], mission=mission)
        if all(any(m.truths for m in arm) for arm in (theirs, ours)):  # where there was nothing to find there is no AP
            d = bootstrap(theirs, ours, groups)
            gains[name] = (d.delta, d.low, d.high)
    return gains
