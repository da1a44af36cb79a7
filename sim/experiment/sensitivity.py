"""Which varied field moves a metric, and by how much: Morris, Sobol' indices, or rank correlation, as the design allows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sortie.scenarios.intervals import Floats
from sortie.sim.experiment.rows import CampaignRows
from sortie.sim.experiment.spread import MORRIS_LEVELS, drawn_fields, unit_problem

COLUMNS = {
    "morris": ("μ*", "95 % of μ*", "σ"),
    "saltelli": ("first order", "± 95 %", "total", "± 95 %"),
    "other": ("Spearman's ρ",),
}
MEANING = {
    "morris": "Morris' elementary effects, in the metric's unit over the field's whole range: μ* how much it moves the "
    "metric, σ how much that depends on the other fields or is curved.",
    "saltelli": "Sobol' indices: the part of the metric's variance that is the field's alone (first order), and with all "
    "that it does together with others (total).",
    "other": "Spearman's rank correlation of field and metric over the draws: direction and monotony, not amount. For "
    "amounts fly the campaign with `sample.method: morris`, then `saltelli` on the fields that matter.",
}


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """Of one policy and metric: `figures` [fields, columns]."""

    policy: str
    metric: str
    method: str
    fields: tuple[str, ...]
    figures: Floats
    used: int
    """Draws that it is worked out from."""


def sensitivity(rows: CampaignRows, metric: str, policy: int) -> Sensitivity | None:
    """None where no numeric field is drawn, or too little is finished."""
    plan = rows.plan
    design = plan.campaign.sample.method
    method = design if design in ("morris", "saltelli") else "other"
    fields = tuple(drawn_fields(plan.campaign)) if method != "other" else _numeric(rows)
    if not fields:
        return None
    label = plan.policies[policy]
    if method == "other":
        mine = (rows.policy == policy) & ~np.isnan(rows.values(metric))
        x = [rows.table[f].to_numpy(zero_copy_only=False).astype(float)[mine] for f in fields]
        y = rows.values(metric)[mine]
        if len(y) < 8:
            return None
        figures = np.array([[_spearman(column, y)] for column in x])
        return Sensitivity(label, metric, method, fields, figures, len(y))
    block = len(fields) + (1 if method == "morris" else 2)
    y = _by_draw(rows, metric, policy).reshape(-1, block)
    kept = ~np.isnan(y).any(axis=1)  # a run that failed, or is not flown yet, takes its trajectory or block with it
    if kept.sum() < 2:
        return None
    points = plan.points.reshape(-1, block, len(fields))[kept].reshape(-1, len(fields))
    figures = _morris(points, y[kept].ravel()) if method == "morris" else _saltelli(len(fields), y[kept].ravel())
    return Sensitivity(label, metric, method, fields, figures, int(kept.sum()) * block)


def _numeric(rows: CampaignRows) -> tuple[str, ...]:
    return tuple(f for f in rows.plan.campaign.vary if rows.table[f].to_numpy(zero_copy_only=False).dtype != object)


def _by_draw(rows: CampaignRows, metric: str, policy: int) -> Floats:
    """A policy's values [draws of the design], replications averaged; NaN where one is missing."""
    mine = rows.policy == policy
    unit, values = rows.unit[mine], rows.values(metric)[mine]
    sums, flown, known = (
        np.bincount(unit, weights, minlength=rows.plan.units)
        for weights in (np.nan_to_num(values), None, ~np.isnan(values))
    )
    with np.errstate(invalid="ignore"):
        return np.where(known == flown, sums / known, math.nan)


def _morris(points: Floats, y: Floats) -> Floats:
    from SALib.analyze import morris

    if np.ptp(y) == 0:
        return np.zeros((points.shape[1], 3))
    indices = morris.analyze(unit_problem(points.shape[1]), points, y, num_levels=MORRIS_LEVELS, seed=0)
    return np.column_stack([np.asarray(indices[k], float) for k in ("mu_star", "mu_star_conf", "sigma")])


def _saltelli(fields: int, y: Floats) -> Floats:
    from SALib.analyze import sobol

    if np.ptp(y) == 0:
        return np.zeros((fields, 4))
    indices = sobol.analyze(unit_problem(fields), y, calc_second_order=False, seed=1)  # SALib reads 0 as no seed
    return np.column_stack([np.asarray(indices[k], float) for k in ("S1", "S1_conf", "ST", "ST_conf")])


def _spearman(x: Floats, y: Floats) -> float:
    from scipy.stats import spearmanr

    return float(spearmanr(x, y).statistic) if np.ptp(x) > 0 and np.ptp(y) > 0 else math.nan
