"""A campaign's rows as arrays, and what they come to by unit. The table is the truth; this reads it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from sim.campaign.plan import Plan
from sim.campaign.store import JOURNAL, RUNS, read_plan
from sim.folders import RunError

Floats = NDArray[np.float64]
BINS = 4
LOWER_IS_BETTER = ("bytes", "energy_j", "deadline_miss_rate", "age_s", "data_age_s", "switches", "medium_busy_fraction",
                   "context_share", "data_rate_mbps", "payload_fates", "descriptor_drops")  # fmt: skip


@dataclass(frozen=True)
class Rows:
    """All finished parts of a campaign."""

    plan: Plan
    table: pa.Table
    unit: NDArray[np.int64]
    policy: NDArray[np.int64]
    """By number."""

    @property
    def done(self) -> NDArray[np.bool_]:
        return np.asarray(self.table["status"].to_numpy(zero_copy_only=False) == "done", bool)

    def values(self, metric: str) -> Floats:
        """[runs]; NaN where there is none."""
        return np.asarray(self.table[metric].to_numpy(zero_copy_only=False), float)

    def by_unit(self, metric: str, mask: NDArray[np.bool_] | None = None) -> Floats:
        """Means [units, policies] over the runs of a unit; NaN where no run has a value. Units without any are left out."""
        values = self.values(metric)
        use = ~np.isnan(values) if mask is None else ~np.isnan(values) & mask
        policies = len(self.plan.policies)
        units = int(self.unit.max()) + 1 if len(self.unit) else 0
        at = self.unit[use] * policies + self.policy[use]
        count = np.bincount(at, minlength=units * policies)
        total = np.bincount(at, values[use], minlength=units * policies)
        with np.errstate(invalid="ignore"):
            means = (total / count).reshape(units, policies)
        return means[~np.isnan(means).all(axis=1)]

    def pair(self, metric: str, a: int, b: int) -> tuple[Floats, Floats]:
        """Means by unit of two policies, over the scenes in which both have a value."""
        values = self.values(metric).reshape(-1, len(self.plan.policies))[
            :, [a, b]
        ]  # a scene's policies stand together
        both = ~np.isnan(values).any(axis=1)
        unit = self.unit[:: len(self.plan.policies)][both]
        at = np.unique(unit, return_inverse=True)[1]
        count = np.bincount(at)
        return np.bincount(at, values[both, 0]) / count, np.bincount(at, values[both, 1]) / count

    def bins(self, field: str) -> list[tuple[str, float, NDArray[np.bool_]]]:
        """A varied field's range in parts: a label, a place on its axis, and the runs; few values stand as they are."""
        column = self.table[field].to_numpy(zero_copy_only=False)
        distinct = list(dict.fromkeys(column.tolist()))
        if len(distinct) <= 2 * BINS:
            distinct.sort(key=lambda v: (isinstance(v, str), v))
            return [
                (v if isinstance(v, str) else f"{v:.4g}", i if isinstance(v, str) else v, column == v)
                for i, v in enumerate(distinct)
            ]
        if isinstance(distinct[0], str):
            return []
        edges = np.quantile(column, np.linspace(0, 1, BINS + 1))
        part = np.clip(np.searchsorted(edges, column, side="right") - 1, 0, BINS - 1)
        return [
            (f"{edges[i]:.3g} … {edges[i + 1]:.3g}", float(np.mean(column[part == i])), part == i)
            for i in range(BINS)
            if (part == i).any()
        ]


def read_rows(folder: Path) -> Rows:
    """The finished parts of a campaign's folder.

    Raises:
        RunError: no campaign there, or nothing finished.
    """
    plan = read_plan(folder)
    parts = sorted((folder / RUNS).glob("part-*.parquet"))
    if not parts:
        waiting = any((folder / JOURNAL).glob("*.jsonl"))
        raise RunError(f"{folder}: no part is finished yet" + (", go on with the campaign" if waiting else ""))
    table = pa.concat_tables([pq.read_table(p) for p in parts])
    number = {label: i for i, label in enumerate(plan.policies)}
    policy = np.array([number[label] for label in table["policy"].to_pylist()], np.int64)
    return Rows(plan, table, table["unit"].to_numpy(), policy)


def sign(metric: str) -> int:
    """1 where more of a metric is better, -1 where less is."""
    return -1 if metric.partition(".")[0] in LOWER_IS_BETTER else 1


def find_row(folder: Path, run: int) -> dict[str, Any]:
    """One run's row.

    Raises:
        RunError: no campaign there, no such run, or one that is not finished.
    """
    plan = read_plan(folder)
    if not 0 <= run < plan.runs:
        raise RunError(f"--run {run}: {folder} has runs 0 … {plan.runs - 1}")
    path = folder / RUNS / f"part-{run // plan.shard:05d}.parquet"
    if not path.is_file():
        raise RunError(f"--run {run}: {folder} has not finished it yet")
    row: dict[str, Any] = pq.read_table(path).slice(run % plan.shard, 1).to_pylist()[0]
    return row


def judged(metrics: Sequence[str]) -> list[str]:
    """The metrics by which a winner is told: accuracies, or the first one where there is none."""
    return [m for m in metrics if m.startswith("ap50.")] or list(metrics[:1])


def figure(value: float) -> str:
    """Four digits that count, with a unit prefix beyond a thousand."""
    if math.isnan(value):
        return "–"
    for limit, prefix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if abs(value) >= limit:
            return f"{value / limit:.4g}{prefix}"
    return f"{value:.4g}" if abs(value) >= 1 or value == 0 else f"{value:.3f}" if abs(value) >= 1e-3 else f"{value:.2g}"
