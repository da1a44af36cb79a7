"""The surrogate against the torch detector on fusions of flown sorties, with their formations, data ages and mission discs.

A sortie is flown by the surrogate, and again with the same traffic and the torch detector's answers at every scored moment.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sortie.perception.metrics.ap import Matched, average_precision
from sortie.scenarios.intervals import SHARE, Range, mean_interval
from sortie.scenarios.reading.load import load, load_conditions
from sortie.scenarios.schema import Scenario
from sortie.scenarios.schema.conditions import Condition, ConditionSet
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.experiment.conditions import scenario_of
from sortie.sim.experiment.detectors import surrogate_of, torch_answers
from sortie.sim.results.accuracy import both_matched

POLICIES = ("silence", "all-4", "boxes")
TOWNS_APART = 1000
"""Between the seeds of one condition's towns: sets number their conditions' towns on from one another."""
REGIONS = {"full_scene": "everywhere", "mission": "in the mission's disc"}


@dataclass(frozen=True, slots=True)
class ConditionAp:
    """AP@0.5 of one policy in one region of one condition, by both."""

    policy: str
    condition: str
    region: str
    torch: float
    surrogate: float


def flights(
    name: str,
    calibration: Path,
    weights: Path | None,
    rate_hz: float,
    policies: Sequence[str] = POLICIES,
    progress: Callable[[str, int, int], None] | None = None,
    towns: int = 1,
    leave_out: Collection[str] = (),
    sets: Sequence[str] = (),
) -> Iterator[ConditionAp]:
    """Fly a scenario, or every condition of a set with its first seed, under some policies.

    Args:
        leave_out: names of conditions that are not flown.
        towns: each is flown in so many: its own, and others of its kind, whose seeds, and the sortie's, count on from
            its own. A condition's AP is that of all their fusions together: a mission's disc holds a handful of cars, and
            twenty discs say little.
        sets: overrides of fields in every sortie, as `--set` takes them; a condition's own go before them.

    Raises:
        ScenarioError, PolicyError: what cannot be flown, before anything is.
    """
    conditions = load_conditions(name)
    if conditions is None:
        conditions = ConditionSet(
            base=name, seeds=(load(name).seed,), conditions=(Condition(name="sortie", budget=1.0),)
        )
        planned = [[(p, load(name, [f"policy.name={p}", "policy.params={}", *sets])) for p in policies]]
    else:
        conditions = conditions.model_copy(update={"set": (*conditions.set, *sets)})
        planned = [[(p, scenario_of(conditions, c, p)) for p in policies] for c in conditions.conditions]
    both = torch_answers(calibration, weights), surrogate_of(calibration)
    count, flown = len(planned) * len(policies) * towns, 0
    for condition, todo in zip(conditions.conditions, planned, strict=True):
        if condition.name in leave_out:
            flown += len(policies) * towns
            continue
        matched: dict[tuple[str, str], tuple[list[Matched], list[Matched]]] = {}
        for town, (policy, scenario) in itertools.product(range(towns), todo):
            if progress is not None:
                progress(f"{name} by both detectors", flown, count)
            there = _in_town(scenario, town, rate_hz)
            matches = [
                both_matched(run_sortie(there, None, conditions.seeds[0] + town, detector_of=make)) for make in both
            ]
            flown += 1
            for region in REGIONS:
                theirs, ours = matched.setdefault((policy, region), ([], []))
                theirs += matches[0][region].values()
                ours += matches[1][region].values()
        for (policy, region), (theirs, ours) in matched.items():
            torch = average_precision(theirs)
            if not np.isnan(torch):  # there is such a region, and there are cars in it
                yield ConditionAp(policy, condition.name, region, torch, average_precision(ours))
    if progress is not None:
        progress(f"{name} by both detectors", count, count)


def _in_town(scenario: Scenario, town: int, rate_hz: float) -> Scenario:
    """The scenario scored at a rate, in another town of its kind, by an offset of the seed."""
    scene = scenario.perception.scene.model_copy(update={"seed": scenario.perception.scene.seed + TOWNS_APART * town})
    perception = scenario.perception.model_copy(
        update={"detector": "surrogate", "sample_rate_hz": rate_hz, "scene": scene}
    )
    return scenario.model_copy(update={"perception": perception})


@dataclass(frozen=True, slots=True)
class ConditionMean:
    """The mean over conditions of a policy's AP, or of what it gains over another's, by both; with 95 % intervals over
    conditions of the torch detector's and of the difference; NaN for a single one."""

    what: str
    region: str
    torch: tuple[float, float, float]
    surrogate: float
    error: tuple[float, float, float]


def means(levels: Sequence[ConditionAp]) -> Iterator[ConditionMean]:
    """Of every policy, then of every policy against every earlier one."""
    policies = list(dict.fromkeys(v.policy for v in levels))
    for region in REGIONS:
        ap = {p: {v.condition: v for v in levels if (v.policy, v.region) == (p, region)} for p in policies}
        for p in policies:
            if ap[p]:
                yield _mean(p, region, _table(ap[p].values()), SHARE)
        for k, p in enumerate(policies):
            for earlier in policies[:k]:
                # drones that look from elsewhere may find none to look for
                both = [c for c in ap[p] if c in ap[earlier]]
                if both:
                    its, theirs = (_table([ap[name][c] for c in both]) for name in (p, earlier))
                    yield _mean(f"{p} − {earlier}", region, its - theirs, SHARE.of_differences())


def _table(levels: Iterable[ConditionAp]) -> np.ndarray:
    return np.array([(v.torch, v.surrogate) for v in levels])


def _mean(what: str, region: str, both: np.ndarray, within: Range) -> ConditionMean:
    torch = mean_interval(both[:, 0], within)
    off = mean_interval(both[:, 1] - both[:, 0], within.of_differences())
    surrogate = float(both[:, 1].mean())
    return ConditionMean(what, region, (torch.mean, torch.low, torch.high), surrogate, (off.mean, off.low, off.high))
