"""The study's figures by matplotlib (the optional extra `report`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from research.flip.measure import StudyRow
from research.flip.plan import StudyPlan
from research.flip.report import UNSENT, FixedSettings, StudyRows
from research.paper.figures import INK, PAPER, figure_of, legend_below, save

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER_CONTRAST = {0.02: 7.7, 0.05: 1.4, 0.1: -4.0, 0.25: -4.8}
"""Best of two peers minus four, AP points, as the paper prints them."""
CAPTIONS = {
    "contrasts.png": "Two peers minus four at matched bytes, network by network",
    "starved.png": "The starved fleet against a single drone",
}
COLOURS = {"full": "#1f6fb4", "full-more": "#7fb2dd", "dropout": "#2a9d5c", "signed": "#8a63b8", "deep": "#c2571a"}


def draw_all(plan: StudyPlan, rows: Sequence[StudyRow], folder: Path) -> list[tuple[str, str]]:
    """Write every figure as PNG; returns file names and captions."""
    for name, draw in (("contrasts.png", contrasts), ("starved.png", starved)):
        save(draw(plan, rows), folder / name)
    return list(CAPTIONS.items())


def contrasts(plan: StudyPlan, rows: Sequence[StudyRow]) -> Figure:
    """Two peers minus four at matched bytes by budget, a panel a filling, one mark a network, the paper's beside."""
    found, budgets = StudyRows(rows), plan.measured.budgets
    figure, axes = figure_of(1, len(plan.measured.unsent), (10.4, 3.9), sharey=True)
    networks = found.networks()
    for ax, unsent in zip(axes, plan.measured.unsent, strict=True):
        ax.axhline(0, color=INK, lw=0.8)
        if unsent == "zero":
            at = [budgets.index(budget) for budget in PAPER_CONTRAST if budget in budgets]
            ax.plot(at, [PAPER_CONTRAST[budgets[i]] for i in at], "D", ms=6, mfc="none", color=PAPER, label="paper")
        for k, (variant, seed) in enumerate(networks):
            its = [found.get(FixedSettings(variant, seed, unsent), "contrast", budget) for budget in budgets]
            x = np.arange(len(budgets)) + 0.6 * ((k + 0.5) / len(networks) - 0.5)
            _whiskers(ax, x, its, COLOURS.get(variant, INK), _first(networks, variant, seed))
        ax.set_xticks(range(len(budgets)), [f"{budget:g}" for budget in budgets])
        ax.set_xlabel("received budget, share of full sharing")
        ax.set_title(UNSENT[unsent], loc="left", fontsize=10)
    axes[0].set_ylabel("AP of two peers minus four, points")
    legend_below(figure, axes[0])
    return figure


def starved(plan: StudyPlan, rows: Sequence[StudyRow]) -> Figure:
    """All four peers at the least budget minus a single drone, network by network, under each filling."""
    found, networks = StudyRows(rows), StudyRows(rows).networks()
    figure, (ax,) = figure_of(1, 1, (7.2, 1.2 + 0.36 * len(networks)))
    ax.axvline(0, color=INK, lw=0.8)
    for k, (variant, seed) in enumerate(networks):
        for unsent, down, face in (("zero", 0.12, None), ("masked", -0.12, "white")):
            row = found.get(FixedSettings(variant, seed, unsent), "starved", plan.measured.starved)
            if row is not None:
                colour = COLOURS.get(variant, INK)
                ax.plot([row.low, row.high], [down - k] * 2, color=colour, lw=1.6)
                ax.plot(row.value, down - k, "o", color=colour, mfc=face or colour, ms=5)
    ax.set_yticks([-k for k in range(len(networks))], [f"{v}-{s}" for v, s in networks])
    ax.set_xlabel(f"AP at a budget of {plan.measured.starved:g} minus a single drone, points (hollow: masked fusion)")
    return figure


def _first(networks: Sequence[tuple[str, int]], variant: str, seed: int) -> str:
    """One legend entry a variant."""
    return variant if (variant, seed) == next(n for n in networks if n[0] == variant) else ""


def _whiskers(ax: object, x: np.ndarray, rows: Sequence[StudyRow | None], colour: str, label: str) -> None:
    there = [(at, r) for at, r in zip(x, rows, strict=True) if r is not None]
    value = np.array([r.value for _, r in there])
    spread = np.abs(np.array([[r.low for _, r in there], [r.high for _, r in there]]) - value)
    ax.errorbar(  # type: ignore[attr-defined]
        [at for at, _ in there], value, yerr=spread, fmt="o", ms=4.5, capsize=2, lw=1, color=colour, label=label or None
    )


__all__ = ["contrasts", "draw_all", "starved"]
