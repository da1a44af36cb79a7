"""What campaigns cost by their number of runs: time, the driver's memory, the store's size; and what a million would cost.

    python -m research.validation.campaign_scale                           campaigns of 100, 300, 1,000, 3,000 and 10,000 runs
    python -m research.validation.campaign_scale --runs 100 300 1000       of these
    python -m research.validation.campaign_scale --rows 100000             a driver that stores this many rows without flights

Each campaign flies sorties of one second with two drones and no detector, by `workers=1`, in a process of its own. A line
a + b × runs is fitted to every quantity, with errors relative to it, and printed at a million runs. The driver alone is
also measured on more rows than were flown: its engine makes up each row from the run's task. This shows whether the line
of the driver's costs holds beyond the campaigns that were flown.
"""

from __future__ import annotations

import argparse
import itertools
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import nnls

import sortie
from research.validation.stored import Cell, Column, Table
from sortie.scenarios.reading.campaign import load_campaign
from sortie.sim.experiment.drive import run_campaign
from sortie.sim.experiment.flight import Flight, Task
from sortie.sim.experiment.plan import make_plan
from sortie.sim.experiment.pools import Landed

BASE = "name: small\nduration_s: 1\nfleet: {drones: 2}\nperception: {detector: none}\n"
CAMPAIGN = """
campaign: scale
base: base.yaml
vary:
  fleet.battery.initial_soc: {{kind: uniform, low: 0.2, high: 1}}
  radio.tx_power_dbm: {{kind: uniform, low: 10, high: 20}}
sample: {{count: {draws}}}
policies: [worked, "best-2(received_budget=0.1)"]
metrics: [bytes.data_sent, energy_j.total]
seed: 5
"""
IN_MEMORY = Path("/dev/shm")  # noqa: S108 - a folder of its own is made there
"""Where folders lie if they can, so that a slow disk does not hide the rest."""
RUNS, ROWS, MILLION = (100, 300, 1_000, 3_000, 10_000), 100_000, 1_000_000


@dataclass(frozen=True, slots=True)
class Cost:
    """What one campaign took."""

    runs: int
    flown: bool
    """False where the rows were made up."""
    wall_s: float
    workers_cpu_s: float
    driver_cpu_s: float
    driver_peak_b: float
    """The driver's largest resident memory, B."""
    store_b: float
    """Size of `campaign.sqlite`, its table and manifest, B."""


QUANTITIES = ("wall_s", "workers_cpu_s", "driver_cpu_s", "driver_peak_b", "store_b")
OF_THE_DRIVER = QUANTITIES[2:]
"""What is the same for rows that were made up."""


@dataclass(frozen=True, slots=True)
class Line:
    """a + b × runs."""

    a: float
    b: float
    worst: float
    """The largest deviation of a measured value from the line, as a share of the value."""

    def at(self, runs: int) -> float:
        """The line's value."""
        return self.a + self.b * runs


def fit(runs: Sequence[int], values: Sequence[float]) -> Line:
    """The line with a, b ≥ 0 and the least squares of relative errors; values must be above 0.

    Example:
        >>> line = fit([100, 200, 400], [3.0, 4.0, 6.0])
        >>> round(line.a, 6), round(line.b, 6), round(line.at(1000), 6)
        (2.0, 0.01, 12.0)
    """
    x, y = np.asarray(runs, float), np.asarray(values, float)
    (a, b), _ = nnls(np.column_stack([1 / y, x / y]), np.ones_like(y))
    return Line(float(a), float(b), float(np.max(np.abs(1 - (a + b * x) / y))))


TOGETHER = 200
"""Rows that a made-up pool gives at once."""


class MadeUp:
    """A pool that answers tasks with rows of the usual size, without flights."""

    def rows(self, tasks: Iterator[Task]) -> Iterator[Landed]:
        """As `Pool`."""
        while batch := list(itertools.islice(tasks, TOGETHER)):
            yield [(task, _made_up(task)) for task in batch]


def _made_up(task: Task) -> Flight:
    key = task.key
    values = float(int(key[:5], 16)), int(key[5:14], 16) / 1e9
    return Flight("", key[:16], dict(zip(task.figures, values, strict=True)), key)


def drive(runs: int, flown: bool) -> Cost:
    """One campaign, driven by this process, which must have done nothing else."""
    with tempfile.TemporaryDirectory(dir=IN_MEMORY if IN_MEMORY.is_dir() else None) as name:
        folder = Path(name)
        (folder / "base.yaml").write_text(BASE)
        (file := folder / "scale.yaml").write_text(CAMPAIGN.format(draws=runs // 2))
        out, begin_s, cpu_s = folder / "out", time.perf_counter(), time.process_time()
        if flown:
            sortie.campaign(file, out=out, workers=1)
        else:
            run_campaign(make_plan(load_campaign(str(file))), out, MadeUp())
        wall_s, cpu_s = time.perf_counter() - begin_s, time.process_time() - cpu_s
        # not ru_maxrss, which begins with the memory of the process that started this one
        status = Path("/proc/self/status").read_text()
        peak_b = 1024 * int(status.partition("VmHWM:")[2].split()[0])
        worker = resource.getrusage(resource.RUSAGE_CHILDREN)
        store_b = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    return Cost(runs, flown, wall_s, worker.ru_utime + worker.ru_stime, cpu_s, peak_b, store_b)


def measure(runs: int, flown: bool = True) -> Cost:
    """One campaign, in a process of its own."""
    command = [
        sys.executable,
        "-m",
        "research.validation.campaign_scale",
        "--drive",
        str(runs),
        *([] if flown else ["--made-up"]),
    ]
    cost = Cost(**json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout))
    sys.stderr.write(f"{cost}\n")
    return cost


def tables(runs: Sequence[int] = RUNS, rows: int = ROWS) -> dict[str, Table]:
    """The costs that were measured, the line's values beside rows that were made up, and at a million."""
    measure(2)  # what is compiled once is no campaign's cost
    flown = [measure(count) for count in runs]
    return {"campaign_scale": table(flown, measure(rows, flown=False))}


def table(flown: Sequence[Cost], made_up: Cost) -> Table:
    """Costs by number of runs, with the lines."""
    lines = {name: fit([cost.runs for cost in flown], [getattr(cost, name) for cost in flown]) for name in QUANTITIES}

    def by_line(runs: int) -> list[Cell]:
        return [lines[name].at(runs) for name in QUANTITIES]

    found: list[list[Cell]] = [[cost.runs, "flown", *(getattr(cost, n) for n in QUANTITIES)] for cost in flown]
    its: list[Cell] = [getattr(made_up, n) if n in OF_THE_DRIVER else None for n in QUANTITIES]
    found.append([made_up.runs, "rows without flights", *its])
    found += [[runs, "by the line", *by_line(runs)] for runs in (made_up.runs, MILLION)]
    found.append([None, "the line: before the first run", *(lines[n].a for n in QUANTITIES)])
    # a run's share is far smaller than the units of the columns
    per_run = [lines[n].b for n in QUANTITIES]
    text = [*(f"{1e3 * seconds:.3g} ms" for seconds in per_run[:3]), *(f"{size:,.0f} B" for size in per_run[3:])]
    found.append([None, "the line: each run", *text])
    found.append([None, "the line: worst deviation", *(f"{100 * lines[n].worst:.0f} %" for n in QUANTITIES)])
    seconds, size = (",.1f", " s", 1.0), (",.2f", " MB", 1e-6)
    columns = [
        Column("runs"), Column("how"), Column("wall time", *seconds), Column("processor time, worker", *seconds),
        Column("processor time, driver", *seconds), Column("peak memory, driver", *size), Column("store", *size),
    ]  # fmt: skip
    about = (
        "Campaigns of sorties of 1 s with two drones and no detector, one worker, the folder in memory: a disk adds the time of a "
        "commit per batch. Other jobs shared the processor, which adds to wall times. The rows *by the line* are extrapolated, not measured."
    )
    return Table(columns, found, about)


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, nargs="+", default=RUNS, help="runs of each campaign, even numbers")
    parser.add_argument(
        "--rows", type=int, default=ROWS, help="rows of the driver without flights (default: %(default)s)"
    )
    parser.add_argument("--drive", type=int, metavar="RUNS", help=argparse.SUPPRESS)
    parser.add_argument("--made-up", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.drive is not None:
        sys.stdout.write(json.dumps(asdict(drive(options.drive, not options.made_up))))
        return
    for made in tables(options.runs, options.rows).values():
        sys.stdout.write(f"{made.markdown()}\n")


if __name__ == "__main__":
    main()
