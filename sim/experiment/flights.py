"""Flights of policies on a suite: each policy once in each condition."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from pathlib import Path

from sortie.policies.contract import Policy
from sortie.policies.registry import within_budget
from sortie.scenarios.schema.conditions import ConditionSet
from sortie.sim.experiment.conditions import scenario_of
from sortie.sim.experiment.flight import Flight, Task, task_of
from sortie.sim.experiment.flight_file import fly_all
from sortie.sim.experiment.pools import processes

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
BY_TORCH = ("perception.detector=torch", "perception.sample_rate_hz=0.5")
"""What makes a suite fly with the neural detector, which takes most of a second for each scored instant."""

Flights = dict[str, dict[str, Flight]]
"""By policy and condition."""


def fly(
    suite: ConditionSet,
    decides: Mapping[str, Policy | None],
    *,
    workers: int = 1,
    kept: Path | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> Flights:
    """Fly policies in every condition of a suite; those that are names in processes of their own.

    Args:
        decides: by label the function that decides; None for what the label names: `name(key=value)` or
            `path/to/file.py:function`. A budget reaches a function by its parameter `received_budget`, `sent_budget` or
            `rho`, where it has one.
        workers: how many processes.
        kept: the file that flights are taken from, and kept in.
        progress: called with how many flights there are.

    Raises:
        ScenarioError, PolicyError: a policy or its parameters are wrong; raised before anything flies.
        RunError: the file cannot be used, or files changed meanwhile.
    """
    asked = [(label, c, function) for label, function in decides.items() for c in suite.conditions]
    tasks = [
        task_of(scenario_of(suite, c, label if f is None else "silence"), METRICS, function=f and within(f, c.budget))
        for label, c, f in asked
    ]
    done = 0

    def watch(task: Task, t_s: float) -> None:
        nonlocal done
        done += math.isinf(t_s)
        progress(done)

    with processes(min(workers, len(tasks))) as pool:
        rows = fly_all(tasks, pool, kept, watch, failing=True)
    flights: Flights = {label: {} for label in decides}
    for (label, condition, _), row in zip(asked, rows, strict=True):
        flights[label][condition.name] = row
    return flights


def within(policy: Policy, budget: float) -> Policy:
    """A function with a condition's budget."""
    found = within_budget(policy, budget)
    return functools.partial(policy, **found) if found else policy
