"""Drive a campaign: hand out missing runs, store their results, stop when `stop_when` is reached."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from sortie.scenarios.intervals import mean_interval
from sortie.sim.experiment.cluster import WAIT_S, Security, open_cluster
from sortie.sim.experiment.plan import CampaignPlan
from sortie.sim.experiment.pools import Pool, processes
from sortie.sim.experiment.store import CampaignStore
from sortie.sim.folders import RunError
from sortie.sim.results.outcome import possible


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a campaign is."""

    finished: int
    """Runs with rows on disk, including those of earlier drivers."""
    of: int
    failed: int
    """Of those."""
    flown: int
    """By this driver."""
    seconds: float
    """Since this driver began."""
    by_torch: bool = False
    """Whether it is the part that the torch detector flies."""

    @property
    def per_second(self) -> float:
        return self.flown / self.seconds if self.seconds > 0 else 0.0

    @property
    def left_s(self) -> float:
        return (self.of - self.finished) / self.per_second if self.flown else math.inf


@contextmanager
def open_pool(
    workers: int = 0,
    scheduler: str | None = None,
    *,
    security: Security | None = None,
    memory_b: int | None = None,
    wait_s: float = WAIT_S,
    notice: Callable[[str], None] = lambda line: None,
) -> Iterator[Pool]:
    """Where a campaign flies: a `scheduler` is joined as `open_cluster` says; without one, `workers` processes start here.

    Nothing flies in the driver: a run that ends its process, or takes all memory, is one failed run.

    Raises:
        RunError: as `open_cluster`.
    """
    if scheduler is not None:
        with open_cluster(scheduler, security, memory_b, wait_s, notice) as cluster:
            yield cluster
        return
    if security is not None:
        raise RunError("--security goes with --scheduler")
    with processes(workers, memory_b) as pool:
        yield pool


def run_campaign(
    plan: CampaignPlan,
    folder: Path,
    pool: Pool,
    *,
    resume_only: bool = False,
    retry_failed: bool = False,
    units: int | None = None,
    progress: Callable[[Progress], None] = lambda p: None,
    notice: Callable[[str], None] = lambda line: None,
) -> Progress:
    """Fly what is missing of a campaign into its folder.

    Rows are on disk before `progress` counts them; whenever this ends early, the next call goes on.

    Args:
        retry_failed: runs that failed count as missing.
        units: fly the first so many; None: all.
        notice: called with a line on flights that are there and are not taken.

    Raises:
        RunError: a folder that cannot be used, a cluster that is not there, a disk that is full.
    """
    store = CampaignStore(folder, plan, resume_only=resume_only, retry_failed=retry_failed)
    try:
        for line in store.said:
            notice(line)
        done = _drive(plan, store, pool, plan.runs if units is None else units * plan.unit_runs, progress)
        store.export()
        return done
    finally:
        store.close()


def _drive(
    plan: CampaignPlan, store: CampaignStore, pool: Pool, runs: int, progress: Callable[[Progress], None]
) -> Progress:
    stop = Stop(plan)
    frontier = 0
    begin_s, flown = time.perf_counter(), 0

    def enough() -> bool:
        """Look at finished parts in their order, so that it is the same whoever finished first."""
        nonlocal frontier
        while frontier < store.parts and store.is_done(frontier):
            frontier += 1
            if plan.campaign.stop_when is None:
                continue
            rows = store.part(frontier - 1)
            if rows is not None and stop.enough(rows):
                store.drop_after(frontier - 1)
                return True
        return False

    def state(of: int) -> Progress:
        seconds = time.perf_counter() - begin_s
        return Progress(min(store.finished, of), of, store.failed, flown, seconds, plan.by_torch)

    if enough():
        return state(store.runs_of(frontier - 1).stop)
    progress(state(runs))
    for landed in pool.rows(store.missing(runs)):
        store.add(landed)
        flown += len(landed)
        if enough():
            end = store.runs_of(frontier - 1).stop
            flown = max(0, flown - (store.finished - end))  # runs beyond the end are dropped
            return state(end)
        progress(state(runs))
    return state(runs)


class Stop:
    """Whether the intervals that `stop_when` names are narrow enough; evaluated part by part, in their order.

    Units are what is averaged over (draws, or replications where nothing is drawn), so that replications of one draw
    do not count as independent. Intervals are Student's; values that are all equal have none, and count as known from
    30 units on. Stopping at a narrow interval favours samples that look
    less spread than they are: with `at_least` 30 the coverage of a 95 % interval loses about a point.
    """

    def __init__(self, plan: CampaignPlan) -> None:
        self._plan, self._rule = plan, plan.campaign.stop_when
        self._means: list[list[float]] = [[] for _ in plan.policies]
        self._open: list[list[float]] = [[] for _ in plan.policies]
        self._unit = 0

    def enough(self, rows: pa.Table) -> bool:
        """Take a part's rows in; whether enough is known."""
        rule = self._rule
        assert rule is not None  # noqa: S101
        units, policies = rows["unit"].to_pylist(), rows["policy"].to_pylist()
        for unit, label, value in zip(units, policies, rows[rule.metric].to_pylist(), strict=True):
            if unit != self._unit:
                self._close()
                self._unit = unit
            self._open[self._plan.policies.index(label)].append(math.nan if value is None else value)
        if rows["run"][-1].as_py() + 1 == self._plan.runs:
            self._close()
        compared = self._means[1:] if rule.difference else self._means
        if min(map(len, compared)) < rule.at_least:
            return False
        within = possible(rule.metric).of_differences() if rule.difference else possible(rule.metric)
        return all(mean_interval(m, within, rule.confidence).reaches(rule.half_width) for m in compared)

    def _close(self) -> None:
        first, paired = self._open[0], self._rule is not None and self._rule.difference
        for kept, values in zip(self._means, self._open, strict=True):
            of_scenes = [v - f for v, f in zip(values, first, strict=True)] if paired else values
            if known := [v for v in of_scenes if not math.isnan(v)]:
                kept.append(float(np.mean(known)))
        self._open = [[] for _ in self._open]
