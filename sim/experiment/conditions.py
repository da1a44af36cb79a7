"""Policies over a set of conditions: each policy flies in each, at the same budget, seeds and draws, and is compared in pairs."""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sortie.perception.metrics.ap import average_precision
from sortie.policies.contract import Policy
from sortie.policies.registry import resolve, within_budget
from sortie.scenarios.intervals import SHARE, mean_interval
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.scenarios.schema.conditions import Condition, ConditionSet
from sortie.sim.experiment.detectors import ANSWERS
from sortie.sim.experiment.flight import MATCHED, OUTCOME, Flight, Task, task_of
from sortie.sim.experiment.flight_file import fly_all
from sortie.sim.experiment.pools import Pool
from sortie.sim.folders import RunError
from sortie.sim.policy_text import policy_overrides

FIXED = ("all-4", "best-2", "worst-2", "random-2", "fixed-compression", "silence")
"""Policies that do the same whatever the condition; the best of them, and the best of them in each condition, are the
paper's two yardsticks."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One policy in one condition, over all seeds."""

    policy: str
    condition: str
    ap: float
    """AP@0.5 by the condition's metric."""
    data_bytes: float
    """Sent a sortie, handshakes included."""
    energy_j: float
    miss_rate: float | None
    """Share of payloads past their deadline, mean over the seeds that have one; None where no payload had a deadline."""
    flown_share: float = 1.0
    """`mission.flown_share`, mean over the seeds. Below 1, `ap` is of the drones that fly."""


@dataclass(frozen=True, slots=True)
class Summary:
    """One policy over all conditions."""

    policy: str
    ap: float
    gain: tuple[float, float, float]
    """Mean AP over that of the best fixed policy, with its paired 95 % interval over conditions; NaN for a single one."""
    of_oracle: float | None
    """Mean AP relative to the best fixed policy of each condition; None where those have an AP of zero."""
    data_bytes: float
    energy_j: float
    miss_rate: float | None
    """Mean over the conditions that have one; None for a policy that never sent a payload."""


def fly_conditions(
    conditions: ConditionSet,
    policies: Sequence[str],
    *,
    progress: Callable[[str, int], None] | None = None,
    by_torch: bool = False,
    kept: Path | None = None,
) -> list[Cell]:
    """Every policy in every condition, within the condition's budget (`Condition.budget`).

    Args:
        progress: called with the policy and how many of its flights there are.
        by_torch: score with the torch detector what is flown with the surrogate.
        kept: the file that flights are taken from, and kept in.

    Raises:
        ScenarioError, PolicyError, RunError: a condition or policy that cannot be flown or scored, before anything is.
    """
    planned = [(p, c, scenario_of(conditions, c, p)) for p in policies for c in conditions.conditions]
    for _, condition, scenario in planned:
        if scenario.perception.detector == "none":
            raise RunError(
                f"condition {condition.name}: perception.detector is none, conditions are compared by accuracy"
            )
    done: Counter[str] = Counter()

    def watch(policy: str) -> None:
        done[policy] += 1
        if progress is not None:
            progress(policy, done[policy])

    seen_by = ANSWERS if by_torch else ""
    figures, cells = (OUTCOME, MATCHED), list[Cell]()
    for policy in policies:  # whose matched boxes alone are in memory
        found = fly_suite(conditions, {policy: None}, figures, seen_by=seen_by, kept=kept, landed=watch)[policy]
        cells += [_cell(policy, condition, found[condition.name]) for condition in conditions.conditions]
    return cells


def fly_suite(
    suite: ConditionSet,
    decides: Mapping[str, Policy | None],
    figures: Sequence[str],
    *,
    seen_by: str = "",
    pool: Pool | None = None,
    kept: Path | None = None,
    landed: Callable[[str], None] = lambda policy: None,
) -> dict[str, dict[str, list[Flight]]]:
    """Fly policies in every condition on every seed; by policy and condition.

    Args:
        decides: by label the function that decides; None for what the label names: `name(key=value)` or
            `path/to/file.py:function`. A budget reaches a function by its parameter `received_budget`, `sent_budget` or
            `rho`, where it has one.
        figures, seen_by: as `Task` has them.
        pool, kept: as `fly_all` takes them. With a pool, what fails is a row.
        landed: called with the policy of each flight that is there.

    Raises:
        ScenarioError, PolicyError: a policy or its parameters are wrong; raised before anything flies.
    """
    tasks: list[Task] = []
    place: list[tuple[str, str]] = []
    for label, function in decides.items():
        for condition in suite.conditions:
            scenario = scenario_of(suite, condition, label if function is None else "silence")
            budget = {} if function is None else within_budget(function, condition.budget)
            flies = functools.partial(function, **budget) if function is not None and budget else function
            for seed in suite.seeds or (scenario.seed,):
                tasks.append(task_of(scenario, figures, seed=seed, function=flies, seen_by=seen_by))
                place.append((label, condition.name))

    def watch(task: Task, t_s: float) -> None:
        if math.isinf(t_s):
            landed(place[task.number][0])

    flights: dict[str, dict[str, list[Flight]]] = {p: {c.name: [] for c in suite.conditions} for p in decides}
    for (label, name), flight in zip(place, fly_all(tasks, pool, kept, watch, failing=pool is not None), strict=True):
        flights[label][name].append(flight)
    return flights


def scenario_of(conditions: ConditionSet, condition: Condition, policy: str) -> Scenario:
    """A condition's scenario under a policy, within the condition's budget.

    Args:
        policy: a name, `name(key=value)` or `path/to/file.py:function`. Parameters in the brackets stay as they are.
    """
    scenario = load(conditions.base, [*conditions.set, *condition.set, *policy_overrides(policy, "")])
    params = {**within_budget(resolve(scenario.policy.name), condition.budget), **scenario.policy.params}
    return scenario.model_copy(update={"policy": scenario.policy.model_copy(update={"params": params})})


def _cell(policy: str, condition: Condition, flights: Sequence[Flight]) -> Cell:
    frames = [m for flight in flights for m in flight.values[MATCHED][0][condition.metric].values()]
    results = [flight.outcome for flight in flights]
    return Cell(
        policy,
        condition.name,
        float(average_precision(frames)) if frames else math.nan,
        float(np.mean([r["bytes"]["data_sent"] for r in results])),
        float(np.mean([r["energy_j"]["total"] for r in results])),
        mean_of_known(r["deadline_miss_rate"] for r in results),
        float(np.mean([r["mission"]["flown_share"] for r in results])),
    )


def summarise(cells: Sequence[Cell]) -> list[Summary]:
    """Every policy's means over the conditions, against the best fixed policy flown and each condition's best fixed one.

    Accuracy is of the conditions in which every policy has one: where no car was to be seen, there is none.

    Raises:
        RunError: there is no such condition.
    """
    policies = list(dict.fromkeys(c.policy for c in cells))
    conditions = list(dict.fromkeys(c.condition for c in cells))
    at = {(c.policy, c.condition): c for c in cells}
    ap = {p: np.array([at[p, c].ap for c in conditions]) for p in policies}
    known = np.isfinite(list(ap.values())).all(axis=0)
    if not known.any():
        raise RunError(
            "no condition has an accuracy under every policy: there was no car to be seen, or nothing scored"
        )
    ap = {p: a[known] for p, a in ap.items()}
    best = _best_fixed({p: float(a.mean()) for p, a in ap.items()})
    oracle = float(np.max([ap[p] for p in _fixed(policies)], axis=0).mean())
    rows = []
    for p in policies:
        mine = [at[p, c] for c in conditions]
        gain = mean_interval(ap[p] - ap[best], SHARE.of_differences())
        mean = float(ap[p].mean())
        rows.append(
            Summary(
                p,
                mean,
                (gain.mean, gain.low, gain.high),
                mean / oracle if oracle else None,
                float(np.mean([c.data_bytes for c in mine])),
                float(np.mean([c.energy_j for c in mine])),
                mean_of_known(c.miss_rate for c in mine),
            )
        )
    return rows


def mean_of_known(values: Iterable[float | None]) -> float | None:
    """The mean of those that are known; None if none is."""
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def best_fixed(rows: Sequence[Summary]) -> str:
    """The fixed policy that the gains are over."""
    return _best_fixed({r.policy: r.ap for r in rows})


def _best_fixed(ap: Mapping[str, float]) -> str:
    return max(_fixed(list(ap)), key=lambda p: ap[p])


def _fixed(policies: Sequence[str]) -> list[str]:
    """Those that do the same whatever the condition; the first of all where none does."""
    return [p for p in policies if p in FIXED] or list(policies[:1])
