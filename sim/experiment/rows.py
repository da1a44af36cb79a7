"""A campaign's rows as arrays, and their means by unit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sortie.sim.experiment.plan import CampaignPlan
from sortie.sim.experiment.store import CampaignTable
from sortie.sim.folders import RunError

Floats = NDArray[np.float64]
BINS = 4
ACCURACIES = ("full_scene", "mission")
MORE_IS_BETTER = {"soc", "battery", "data_delivered", "delivered", "voltage_v", "airborne", "connected_drones"}
LESS_IS_BETTER = {
    "bytes",
    "energy_j",
    "deadline_miss_rate",
    "age_s",
    "data_age_s",
    "switches",
    "medium_busy_fraction",
    "context_share",
    "data_rate_mbps",
    "payload_fates",
    "descriptor_drops",
    "feature_payload_bytes",
    "invariant_violations",
    "violated_ticks",
    "violations_by_cause",
    "shield_interventions",
    "distrusted_by",
    "lost",
    "lost_to",
}
"""Parts of a metric's path; of several the last one decides."""


@dataclass(frozen=True)
class CampaignRows:
    """What is finished of a campaign, as far as whole units of it are."""

    plan: CampaignPlan
    table: pa.Table
    unit: NDArray[np.int64]
    policy: NDArray[np.int64]
    """By number."""
    finished: pa.Table | None = None
    """All finished parts, those of units that are not whole among them; None: the same."""

    @property
    def all(self) -> pa.Table:
        """Every finished row."""
        return self.table if self.finished is None else self.finished

    @property
    def done(self) -> NDArray[np.bool_]:
        return np.asarray(self.table["status"].to_numpy(zero_copy_only=False) == "done", bool)

    def values(self, metric: str) -> Floats:
        """[runs]; NaN where there is none."""
        return np.asarray(self.table[metric].to_numpy(zero_copy_only=False), float)

    def lost(self, mask: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
        """[units, policies]: where all runs of a policy at a grid point have failed. A policy that never finished a run has
        lost nothing: there is no mean of it anywhere."""
        mask = np.ones(len(self.unit), bool) if mask is None else mask
        failed = (self._count(mask & ~self.done) > 0) & (self._count(mask & self.done) == 0)
        flew = np.bincount(self.policy, self.done, minlength=failed.shape[2]) > 0
        return np.asarray(failed.any(axis=1) & flew)

    def counted(self, metric: str, mask: NDArray[np.bool_] | None = None) -> tuple[NDArray[np.bool_], int]:
        """Which runs [runs] count for a metric, and of how many scenes they are some.

        A scene is one replication of a unit at a grid point, with a run of each policy. It counts where every policy that
        ever has a value of the metric has one: means over other scenes would be no comparison. Units that a policy has
        `lost` are left out.
        """
        mask = np.ones(len(self.unit), bool) if mask is None else mask
        mask = mask & ~np.isin(self.unit, np.flatnonzero(self.lost(mask).any(axis=1)))
        policies = len(self.plan.policies)  # a scene's policies stand together
        known = ~np.isnan(self.values(metric)).reshape(-1, policies)
        whole = (known == known.any(axis=0)).all(axis=1, keepdims=True)
        return (known & whole).ravel() & mask, int(mask.sum()) // policies

    def by_unit(self, metric: str, mask: NDArray[np.bool_] | None = None) -> Floats:
        """As `every_unit`, of the units that have a scene that counts; NaN for a policy that never has a value."""
        means = self.every_unit(metric, mask)
        return np.asarray(means[~np.isnan(means).all(axis=1)])

    def every_unit(self, metric: str, mask: NDArray[np.bool_] | None = None) -> Floats:
        """Means [units, policies] over the grid points of a unit, each the mean of its replications, over the scenes that
        count (`counted`); NaN where there is none. A unit's row is its number."""
        use, _ = self.counted(metric, mask)
        counts = self._count(use)
        with np.errstate(invalid="ignore"):
            of_points = self._count(use, self.values(metric)) / counts
            return np.asarray(np.nansum(of_points, axis=1) / (counts > 0).sum(axis=1))

    def _count(self, which: NDArray[np.bool_], weights: Floats | None = None) -> Floats:
        """[units, points, policies]: how many of these runs, or the sum of their weights."""
        policies, points = len(self.plan.policies), len(self.plan.grid)
        units = int(self.unit.max()) + 1 if len(self.unit) else 0
        at = (self.unit * points + self.table["cell"].to_numpy() % points) * policies + self.policy
        some = None if weights is None else weights[which]
        count = np.bincount(at[which], some, minlength=units * points * policies)
        return count.reshape(units, points, policies).astype(float)

    def bins(self, field: str) -> list[tuple[str, float, NDArray[np.bool_]]]:
        """A varied field's range in parts: a label, a place on its axis, and the runs; few values stand as they are."""
        column = self.table[field].to_numpy(zero_copy_only=False)
        distinct = list(dict.fromkeys(column.tolist()))
        if len(distinct) <= 2 * BINS:
            distinct.sort(key=lambda v: (isinstance(v, str), v))
            names = short_names([v for v in distinct if isinstance(v, str)])
            return [
                (names[v] if isinstance(v, str) else f"{v:.10g}", i if isinstance(v, str) else v, column == v)
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


def read_rows(folder: Path) -> CampaignRows:
    """The finished parts of a campaign's folder.

    Raises:
        RunError: no campaign there, no unit of it finished at all its grid points, or a row that is broken.
    """
    with closing(CampaignTable(folder)) as store:
        plan = store.plan
        parts = [part for n in range(store.parts) if (part := store.part(n)) is not None]
        if not parts:
            go_on = "" if store.is_empty() else ", go on with the campaign"
            raise RunError(f"{folder}: no part is finished yet{go_on}")
    table = pa.concat_tables(parts)
    unit = table["unit"].to_numpy()
    whole = np.bincount(unit)[unit] == plan.unit_runs
    if not whole.any():
        raise RunError(f"{folder}: no {plan.unit} is finished at all its grid points yet, go on with the campaign")
    kept = table.filter(whole)
    number = {label: i for i, label in enumerate(plan.policies)}
    policy = np.array([number[label] for label in kept["policy"].to_pylist()], np.int64)
    return CampaignRows(plan, kept, unit[whole], policy, table)


def sign(metric: str) -> int:
    """1 where more of a metric is better, -1 where less is, 0 where that is not known."""
    if is_accuracy(metric):
        return 1
    for part in reversed(metric.replace("/", ".").split(".")):
        if part in MORE_IS_BETTER:
            return 1
        if part in LESS_IS_BETTER:
            return -1
    return 0


def is_accuracy(metric: str) -> bool:
    """`ap50.mission`, `phases.1.ap50.full_scene` and their like."""
    parts = metric.split(".")
    return "ap50" in parts and parts[-1] in ACCURACIES


def find_row(folder: Path, run: int) -> tuple[CampaignPlan, dict[str, Any] | None]:
    """A campaign's plan and one run's row; None for a run that has not been flown yet.

    Raises:
        RunError: no campaign there, no such run, or its row is broken.
    """
    with closing(CampaignTable(folder)) as store:
        if not 0 <= run < store.plan.runs:
            raise RunError(f"--run {run}: {folder} has runs 0 … {store.plan.runs - 1}")
        return store.plan, store.row(run)


def short_names(values: Sequence[str]) -> dict[str, str]:
    """Models in files by their file's name alone, where that leaves all values distinct.

    Example:
        >>> short_names(["free_space", "/home/me/rain.py:Rain(mmph=3)"])
        {'free_space': 'free_space', '/home/me/rain.py:Rain(mmph=3)': 'rain.py:Rain(mmph=3)'}
    """
    short = {value: re.sub(r"^.*/(?=[^/]*\.py:)", "", value) for value in values}
    return short if len(set(short.values())) == len(short) else {value: value for value in values}


def winner_metrics(metrics: Sequence[str]) -> list[str]:
    """The metrics that decide a winner: accuracies, or else the first metric with a known better direction."""
    return [m for m in metrics if is_accuracy(m)] or [m for m in metrics if sign(m)][:1]
