"""The report's figures by matplotlib (the optional extra `report`): the paper's frontier and flip, and all claims as a forest."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from research.paper.claims import BUDGETS, CURVE
from research.paper.rows import INSTRUMENTS, ClaimRow, Point
from research.paper.verdict import ClaimVerdict
from sortie.scenarios.replacing import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 160
PAPER, INK = "#9a9a9a", "#222222"
COLOURS = {"full": "#1f6fb4", "mission": "#c2571a"}
POLICY_COLOURS = {"all-4": "#1f6fb4", "best-2": "#2a9d5c", "worst-2": "#c2571a", "random-2": "#8a63b8"}
VERDICTS = {
    ClaimVerdict.REPRODUCED: "#2a9d5c", ClaimVerdict.NOT_REPRODUCED: "#d08a00", ClaimVerdict.OPPOSITE: "#c33a2f",
    ClaimVerdict.INCONCLUSIVE: "#7a7f87",
}  # fmt: skip
DASHES = {"zero": "-", "masked": (0, (4, 2))}
PAPER_CURVE = {
    "full": {0.01: 0.131, 0.02: 0.180, 0.05: 0.293, 0.1: 0.351, 1.0: 0.371},
    "mission": {0.05: 0.773, 0.1: 0.784, 1.0: 0.763},
}
"""Read off the paper's sentences; 0.01, 0.02, 0.05 and 0.1 of the full scene by arithmetic on them."""
PAPER_SINGLE = 0.185


def available() -> bool:
    """Whether figures can be drawn."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        return False
    return True


def frontier(points: Sequence[Point]) -> Figure:
    """The byte–accuracy curve, full scene and mission, under both instruments, the paper's points beside it."""
    figure, axes = figure_of(1, 2, (10.4, 3.9))
    for ax, region, title in zip(axes, COLOURS, ("full scene", "32 m mission disc"), strict=True):
        for instrument, name in INSTRUMENTS.items():
            line = [p for budget in CURVE for p in _of(points, instrument, region, "all-4", budget)]
            if line:
                style: dict[str, Any] = {
                    "linestyle": DASHES[instrument],
                    "alpha": 1.0 if instrument == "zero" else 0.75,
                }
                _whiskers(ax, [p.received_budget for p in line], line, COLOURS[region], name, **style)
        for single in _of(points, "zero", region, "none", 0.0):
            ax.axhspan(single.low, single.high, color=INK, alpha=0.08, lw=0)
            ax.axhline(single.ap, color=INK, lw=1, ls=":", label="a single drone")
        known = PAPER_CURVE[region]
        ax.plot(list(known), list(known.values()), "D", ms=4.5, mfc="none", color=PAPER, label="paper (UAV3D)")
        if region == "full":
            ax.axhline(PAPER_SINGLE, color=PAPER, lw=1, ls=":", label="paper, a single drone")
        _budget_axis(ax, CURVE)
        ax.set_title(title, loc="left", fontsize=10)
        ax.set_ylabel("AP@0.5")
    legend_below(figure, axes[0])
    return figure


def peer_selection(points: Sequence[Point]) -> Figure:
    """AP of the fixed policies by budget at matched bytes, the best of each marked, a panel an instrument."""
    shown = [i for i in INSTRUMENTS if any(p.instrument == i for p in points)]
    figure, axes = figure_of(1, len(shown), (5.2 * len(shown), 3.9), sharey=True)
    for ax, instrument in zip(axes, shown, strict=True):
        place = np.arange(len(BUDGETS), dtype=float)
        for k, (policy, colour) in enumerate(POLICY_COLOURS.items()):
            line = [p for budget in BUDGETS for p in _of(points, instrument, "full", policy, budget)]
            if len(line) == len(BUDGETS):
                _whiskers(ax, place + 0.13 * (k - 1.5), line, colour, policy, linestyle="none", markersize=6)
        for i, budget in enumerate(BUDGETS):
            several = [p for policy in POLICY_COLOURS for p in _of(points, instrument, "full", policy, budget)]
            if several:
                top = max(several, key=lambda p: p.ap)
                at = i + 0.13 * (list(POLICY_COLOURS).index(top.peers) - 1.5)
                ax.plot(at, top.high + 0.012, "v", color=POLICY_COLOURS[top.peers], ms=7)
        for single in _of(points, "zero", "full", "none", 0.0):
            ax.axhline(single.ap, color=INK, lw=1, ls=":", label="a single drone")
        ax.set_xticks(place, [f"{budget:g}" for budget in BUDGETS])
        ax.set_xlabel("received budget, share of full sharing")
        ax.set_title(f"{INSTRUMENTS[instrument]}  (▼ the best)", loc="left", fontsize=10)
    axes[0].set_ylabel("AP@0.5, full scene")
    legend_below(figure, axes[0])
    return figure


def forest(rows: Iterable[ClaimRow]) -> Figure:
    """Every difference of APs: the paper's interval in grey, ours by verdict, masked fusion hollow."""
    rows = [r for r in rows if r.unit == "AP points"]
    ids = list(dict.fromkeys(r.id for r in rows))
    figure, (ax,) = figure_of(1, 1, (8.2, 0.9 + 0.34 * len(ids)))
    labels = []
    for i, claim in enumerate(ids):
        its = {r.instrument: r for r in rows if r.id == claim}
        first = next(iter(its.values()))
        labels.append(first.says)
        y = -i
        if first.paper_value is not None:
            _bar(
                ax, y + 0.22, first.paper_value, first.paper_low, first.paper_high, PAPER, "D", filled=not first.follows
            )
        for instrument, down in (("zero", 0.02), ("masked", -0.2)):
            row = its.get(instrument)
            if row is not None and row.value is not None:
                colour = VERDICTS.get(ClaimVerdict(row.verdict), INK)
                _bar(ax, y + down, row.value, row.low, row.high, colour, "o", filled=instrument == "zero")
        if i % 2:
            ax.axhspan(y - 0.5, y + 0.5, color=INK, alpha=0.035, lw=0)
    ax.axvline(0, color=INK, lw=0.8)
    ax.set_yticks([-i for i in range(len(ids))], labels, fontsize=8)
    ax.set_ylim(-len(ids) + 0.4, 0.6)
    ax.set_xlabel("AP points")
    for side in ("top", "right", "left"):
        ax.spines[side].set_visible(False)
    ax.tick_params(axis="y", length=0)
    handles = [
        ax.plot([], [], "D", color=PAPER, ms=5, label="paper")[0],
        ax.plot([], [], "D", color=PAPER, mfc="white", ms=5, label="paper, by arithmetic")[0],
        *(ax.plot([], [], "o", color=c, ms=5, label=str(v))[0] for v, c in VERDICTS.items()),
        ax.plot([], [], "o", color=INK, mfc="white", ms=5, label="masked fusion")[0],
    ]
    figure.legend(handles=handles, fontsize=8, frameon=False, loc="outside lower center", ncols=len(handles))
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a PNG under a temporary name, then rename it; without the date, so that equal figures are equal files."""
    with replacing(path) as part:
        figure.savefig(part, format="png", dpi=DPI, metadata={"Software": None})


def figure_of(rows: int, columns: int, size: tuple[float, float], **options: Any) -> tuple[Figure, Sequence[Axes]]:
    """A figure without a window or pyplot's global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    axes = np.atleast_1d(figure.subplots(rows, columns, **options)).ravel().tolist()
    for ax in axes:
        ax.grid(axis="y" if len(axes) > 1 else "x", color=INK, alpha=0.12, lw=0.6)
        for side in ("top", "right"):
            ax.spines[side].set_visible(False)
    return figure, axes


def legend_below(figure: Figure, ax: Axes) -> None:
    """One legend for all panels, under them."""
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=8, frameon=False, loc="outside lower center", ncols=len(labels))


def _of(points: Sequence[Point], instrument: str, region: str, peers: str, budget: float) -> list[Point]:
    return [
        p
        for p in points
        if (p.instrument, p.region, p.peers, p.received_budget, p.allocation)
        == (instrument, region, peers, budget, "uniform")
    ]


def _whiskers(ax: Axes, x: Any, line: Sequence[Point], colour: str, label: str, **style: Any) -> None:
    ap = np.array([p.ap for p in line])
    spread = np.abs(np.array([[p.low for p in line], [p.high for p in line]]) - ap)
    options: dict[str, Any] = {"fmt": "o", "markersize": 4.5, "capsize": 2.5, "lw": 1.5, "elinewidth": 1, **style}
    ax.errorbar(x, ap, yerr=spread, color=colour, label=label, **options)


def _budget_axis(ax: Axes, budgets: Sequence[float]) -> None:
    ax.set_xscale("log")
    ax.set_xticks(list(budgets), [f"{budget:g}" for budget in budgets])
    ax.minorticks_off()
    ax.set_xlabel("received budget, share of full sharing")


def _bar(
    ax: Axes, y: float, value: float, low: float | None, high: float | None, colour: str, marker: str, *, filled: bool
) -> None:
    if low is not None and high is not None:
        ax.plot([low, high], [y, y], color=colour, lw=1.6, solid_capstyle="butt")
    ax.plot(value, y, marker, color=colour, mfc=colour if filled else "white", ms=4.8)


__all__ = ["available", "figure_of", "forest", "frontier", "legend_below", "peer_selection", "save"]
