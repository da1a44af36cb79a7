"""A campaign's figures. matplotlib is imported where it draws."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sortie.scenarios.intervals import Estimate, Floats, mean_interval
from sortie.sim.experiment.rows import CampaignRows, is_accuracy
from sortie.sim.results.outcome import possible

MAX_METRICS, MAX_FIELDS = 8, 6
APART = 0.012
"""How far policies stand beside one another, of a field's range, so that whiskers do not hide whiskers."""
COST = ("bytes.data_sent", "data_rate_mbps", "energy_j.total")


def in_units(metric: str) -> tuple[str, float]:
    """A metric's name on an axis, with its unit, and the factor to it: `bytes.data_sent, MB`, 1e-6.

    Other metrics have their units in their names.
    """
    if metric.startswith("bytes."):
        return f"{metric}, MB", 1e-6
    if "energy_j" in metric:
        return f"{metric.replace('energy_j', 'energy')}, kJ", 1e-3
    return metric, 1.0


def _scaled(estimate: Estimate, factor: float) -> Estimate:
    return replace(estimate, mean=estimate.mean * factor, low=estimate.low * factor, high=estimate.high * factor)


def with_values(rows: CampaignRows) -> list[str]:
    """The campaign's metrics that some scene counts for; of the others nothing can be drawn or said."""
    return [m for m in rows.plan.campaign.metrics if rows.counted(m)[0].any()]


def costs(metrics: Sequence[str]) -> list[str]:
    """The metrics that accuracy is set against: bytes, and energy."""
    return [m for m in COST if m in metrics]


def drawn(rows: CampaignRows) -> tuple[list[str], list[str]]:
    """Metrics and fields that have a place in the figure."""
    fields = [f for f in rows.plan.campaign.vary if rows.bins(f)]
    return with_values(rows)[:MAX_METRICS], fields[:MAX_FIELDS]


def on_front(x: list[float], y: list[float]) -> list[bool]:
    """Which points are Pareto-optimal: no other costs as little and sees as much, and one of both strictly.

    A point that lacks a value is not: it stands nowhere.
    """
    return [
        not (math.isnan(x[i]) or math.isnan(y[i]))
        and not any(
            (a <= x[i] and b >= y[i] and (a < x[i] or b > y[i]))
            for j, (a, b) in enumerate(zip(x, y, strict=True))
            if j != i
        )
        for i in range(len(x))
    ]


def draw_varied(rows: CampaignRows, path: Path) -> bool:
    """Metrics (rows) over varied fields (columns), a line a policy, whiskers 95 %; whether there is anything to draw."""
    metrics, fields = drawn(rows)
    if not metrics or not fields:
        return False
    figure, axes = _axes(len(metrics), len(fields))
    for r, metric in enumerate(metrics):
        name, factor = in_units(metric)
        for c, field in enumerate(fields):
            ax = axes[r][c]
            bins = rows.bins(field)
            words = isinstance(rows.table[field][0].as_py(), str)
            places = [x for _, x, _ in bins]
            apart = APART * (max(places) - min(places) or 1.0)
            for p, label in enumerate(rows.plan.policies):
                aside = apart * (p - (len(rows.plan.policies) - 1) / 2)
                points = [
                    (
                        x + aside,
                        _scaled(mean_interval(_column(rows.by_unit(metric, mask), p), possible(metric)), factor),
                    )
                    for _, x, mask in bins
                ]
                ax.errorbar(
                    [x for x, _ in points],
                    [e.mean for _, e in points],
                    whiskers([e for _, e in points]),
                    marker="o",
                    markersize=3,
                    capsize=2,
                    label=label,
                )
            if words:
                ax.set_xticks([x for _, x, _ in bins], [name for name, _, _ in bins])
            if c == 0:
                ax.set_ylabel(name)
            if r == len(metrics) - 1:
                ax.set_xlabel(field)
    axes[0][0].legend(fontsize="small")
    figure.savefig(path)
    return True


def draw_pareto(rows: CampaignRows, path: Path) -> bool:
    """Accuracy against each cost, a point a policy with both intervals; whether there is anything to draw."""
    metrics = with_values(rows)
    accuracies, prices = [m for m in metrics if is_accuracy(m)], costs(metrics)
    if not accuracies or not prices:
        return False
    figure, axes = _axes(len(accuracies), len(prices))
    for r, accuracy in enumerate(accuracies):
        for c, price in enumerate(prices):
            ax = axes[r][c]
            price_name, factor = in_units(price)
            xs = [
                _scaled(mean_interval(_column(rows.by_unit(price), p), possible(price)), factor)
                for p in range(len(rows.plan.policies))
            ]
            ys = [
                mean_interval(_column(rows.by_unit(accuracy), p), possible(accuracy))
                for p in range(len(rows.plan.policies))
            ]
            for p, label in enumerate(rows.plan.policies):
                x, y = [xs[p]], [ys[p]]
                ax.errorbar(x[0].mean, y[0].mean, whiskers(y), whiskers(x), "o", capsize=2, label=label)
            front = on_front([x.mean for x in xs], [y.mean for y in ys])
            line = sorted((x.mean, y.mean) for x, y, f in zip(xs, ys, front, strict=True) if f)
            ax.plot([x for x, _ in line], [y for _, y in line], color="0.6", zorder=0)
            ax.set_xlabel(price_name)
            ax.set_ylabel(accuracy)
    axes[0][0].legend(fontsize="small")
    figure.savefig(path)
    return True


def whiskers(estimates: Sequence[Estimate]) -> Floats:
    """[2, estimates]: how far each interval reaches below and above its mean; 0 where there is none or it has no end."""
    reach = np.array([(e.mean - e.low, e.high - e.mean) for e in estimates]).T
    return np.where(np.isfinite(reach), reach, 0.0)


def _column(means: Any, policy: int) -> Any:
    return means[:, policy]


def _axes(rows: int, columns: int) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.4 * columns + 0.6, 2.4 * rows + 0.5), dpi=110, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)
