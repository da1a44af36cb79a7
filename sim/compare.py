"""Policies side by side on one scenario: same seed, same scenes, same draws, paired intervals."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from perception.harness.statistics import compare as bootstrap
from policies.registry import resolve
from scenarios.schema import Scenario
from sim.outcome import matched, outcome
from sim.record import SortieRecord
from sim.sortie import run_sortie


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


def _gain(record: SortieRecord, first: SortieRecord | None) -> dict[str, tuple[float, float, float] | None]:
    """Paired over fusions that both sorties scored; those of one instant stand or fall together in the bootstrap."""
    gains: dict[str, tuple[float, float, float] | None] = {"full_scene": None, "mission": None}
    if first is None:
        return gains
    for name, mission in (("full_scene", False), ("mission", True)):
        ours, theirs = matched(record, mission=mission), matched(first, mission=mission)
        both = [key for key in ours if key in theirs]
        if both:
            instants = {t_s: i for i, t_s in enumerate(dict.fromkeys(t_s for t_s, _ in both))}
            groups = [instants[t_s] for t_s, _ in both]
            d = bootstrap([theirs[k] for k in both], [ours[k] for k in both], groups)
            gains[name] = (d.delta, d.low, d.high)
    return gains
