"""How long a campaign will take: the first run of each policy flies for a few seconds, and the rest is worked out."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from time import perf_counter

from sortie.sim.engine.sortie import fly_here
from sortie.sim.experiment.flight import scenario_of_task
from sortie.sim.experiment.plan import CampaignPlan

MEASURED_S = 5.0
"""Simulated seconds that are measured, from the first on, in which libraries load and loops compile."""


class _EnoughError(Exception):
    """The flight has been measured."""


def run_s(plan: CampaignPlan, clock: Callable[[], float] = perf_counter) -> float:
    """Wall-clock seconds of a run in one process, on the average over policies, without its outcome.

    Raises:
        ScenarioError, PolicyError, ...: whatever a sortie raises.
    """
    return sum(_of_run(plan, run, clock) for run in range(len(plan.policies))) / len(plan.policies)


def _of_run(plan: CampaignPlan, run: int, clock: Callable[[], float]) -> float:
    task = plan.task(run)
    scenario = scenario_of_task(task)
    times: list[tuple[float, float]] = [(0.0, clock())]

    def watch(t_s: float) -> None:
        times.append((t_s, clock()))
        if t_s - times[1][0] >= MEASURED_S:
            raise _EnoughError

    with suppress(_EnoughError):
        fly_here(scenario, None, task.seed, replication=task.replication, progress=watch)
    first = 1 if len(times) > 2 else 0  # of a flight of a second, its start is all that there is
    (begin_s, since_s), (end_s, until_s) = times[first], times[-1]
    return (until_s - since_s) / max(end_s - begin_s, 1e-9) * scenario.duration_s


def in_words(plan: CampaignPlan, seconds: float, workers: int) -> str:
    """The number of runs, where it comes from, and the estimate."""
    campaign, drawn = plan.campaign, plan.unit == "draw"
    parts = [(len(plan.policies), "policies"), (len(plan.grid), "grid points"), (campaign.replications, "replications")]
    if drawn:
        parts.insert(1, (plan.units, "draws"))
    product = " × ".join(f"{count} {what}" for count, what in parts if count > 1)
    minutes = plan.runs * seconds / workers / 60.0
    takes = f"{minutes:.0f} minutes" if minutes < 90 else f"{minutes / 60:.1f} hours"
    return (
        f"{campaign.campaign}: {plan.runs:,} runs{f' ({product})' if product else ''}, about {takes if minutes >= 1 else 'a minute'} with "
        f"{workers} worker{'s' if workers != 1 else ''}, estimated from {MEASURED_S:g} s of a run of each policy"
    )
