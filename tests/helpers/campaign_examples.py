"""Small campaigns that several tests of the room fly."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from sortie.scenarios.reading.campaign import load_campaign
from sortie.sim.experiment import flight
from sortie.sim.experiment.flight import Flight, Task, fly_in_worker
from sortie.sim.experiment.plan import CampaignPlan, make_plan
from sortie.sim.experiment.rows import CampaignRows
from sortie.sim.experiment.store import FILE

CLUSTER = pytest.mark.filterwarnings(
    "default:::distributed", "default::ResourceWarning", "default::pytest.PytestUnraisableExceptionWarning"
)
"""A cluster whose processes are killed leaves sockets behind; dask says so when they are collected."""
BASE = """
name: small
duration_s: 0.5
fleet: {drones: 2}
perception: {detector: none}
"""
CAMPAIGN = """
campaign: small_ones
base: base.yaml
vary:
  fleet.battery.initial_soc: {kind: uniform, low: 0.2, high: 1}
  fleet.formation.spacing_m: {kind: grid, values: [20, 40]}
sample: {count: 6}
replications: 2
policies: [worked, "best-2(received_budget=0.1)"]
metrics: [bytes.data_sent, energy_j.total]
seed: 5
"""
"""6 draws at 2 grid points, 2 replications, 2 policies: 48 runs in two parts."""


def write(folder: Path, text: str = CAMPAIGN, base: str = BASE) -> Path:
    """A campaign's file, its base beside it."""
    (folder / "base.yaml").write_text(base)
    path = folder / "small_ones.yaml"
    path.write_text(text)
    return path


def plan(folder: Path, text: str = CAMPAIGN, base: str = BASE) -> CampaignPlan:
    """The plan of a campaign."""
    return make_plan(load_campaign(write(folder, text, base)))


def table_bytes(folder: Path) -> dict[str, bytes]:
    """The files of a campaign's table."""
    return {p.name: p.read_bytes() for p in sorted((folder / "runs").iterdir())}


def rows_on_disk(folder: Path) -> int:
    """How many runs of a campaign's folder have a row."""
    try:
        with closing(sqlite3.connect(f"file:{folder / FILE}?mode=ro", uri=True, timeout=60)) as db:
            return int(db.execute("SELECT count(*) FROM runs").fetchone()[0])
    except sqlite3.OperationalError:  # not there yet
        return 0


class Pretended:
    """A pool whose rows follow from the task alone, without flying; it can break off after some runs.

    Args:
        change: what becomes of each row.
    """

    def __init__(
        self,
        order: Sequence[int] | None = None,
        stop_after: int | None = None,
        change: Callable[[Task, Flight], Flight] = lambda task, row: row,
    ) -> None:
        self.order, self.stop_after, self.change, self.flown = order, stop_after, change, list[int]()

    def rows(self, tasks: Iterator[Task]) -> Iterator[list[tuple[Task, Flight]]]:
        todo = list(tasks)
        if self.order is not None:
            todo = [todo[i] for i in self.order if i < len(todo)]
        for task in todo:
            if self.stop_after is not None and len(self.flown) >= self.stop_after:
                raise KeyboardInterrupt
            self.flown.append(task.number)
            yield [(task, self.change(task, pretend(task)))]


class InProcess:
    """A pool that flies one run after the other in the test's own process."""

    def rows(self, tasks: Iterator[Task]) -> Iterator[list[tuple[Task, Flight]]]:
        for task in tasks:
            yield [(task, fly_in_worker(task))]


def small_cluster(n_workers: int = 1, **options: Any) -> Any:
    """A dask cluster on this machine, one thread a worker, without a dashboard."""
    from distributed import LocalCluster

    return LocalCluster(
        n_workers=n_workers,
        threads_per_worker=1,
        dashboard_address="127.0.0.1:0",
        memory_limit=0,
        silence_logs="CRITICAL",
        **options,
    )


def pretend(task: Task) -> Flight:
    """A row made of the task."""
    scenario = json.loads(task.scenario)
    value = scenario["fleet"]["battery"]["initial_soc"] + 10 * (scenario["policy"]["name"] == "worked")
    values = dict(zip(task.figures, (value, float(task.replication)), strict=True))
    return Flight("", task.key[:16], values, task.key, task.files)


def rows_of(tmp_path: Path, text: str, value: object, metric: str = "bytes.data_sent") -> CampaignRows:
    """A campaign whose metric is a function of (fields' values, policy number)."""
    p = plan(tmp_path, text)
    columns: dict[str, list[object]] = {}
    for run in range(p.runs):
        at = p.at(run)
        fields = p.varied(at.cell)
        row = {**at._asdict(), "policy": p.policies[at.policy], "status": "done", **fields}
        row[metric] = value(fields, at.policy)  # type: ignore[operator]
        for name, v in row.items():
            columns.setdefault(name, []).append(v)
    table = pa.table(columns)
    return CampaignRows(p, table, table["unit"].to_numpy(), np.array([p.at(r).policy for r in range(p.runs)]))


def report_lines(rows: CampaignRows, folder: Path) -> list[str]:
    """A campaign's report without its figures."""
    from sortie.sim.experiment.report import report_blocks
    from sortie.sim.results.blocks import markdown

    return markdown(report_blocks(rows, folder)).splitlines()


def failed(task: Task, error: str = "ValueError: planted") -> Flight:
    """The row of a run that failed."""
    return flight.failed(task, error)
