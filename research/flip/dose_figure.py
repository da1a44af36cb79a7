"""The dose–response study's figure by matplotlib (the optional extra `report`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from research.flip.doses import Dose, DosePlan, DoseRow, Effect
from research.flip.figures import PAPER_CONTRAST
from research.paper.figures import INK, PAPER, figure_of, legend_below

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#1f6fb4", "#2a9d5c", "#c2571a", "#8a63b8", "#7a7f87")
APART = 0.012
"""Between networks at the same weight by definition, so that their intervals can be told apart."""
PAPER_STARVED = {0.01: -5.4}


def draw(plan: DosePlan, rows: Sequence[DoseRow]) -> Figure:
    """A panel for each figure of the study over the weight on zeros: a colour a network, a mark a kind of dose.

    Panels of two peers minus four have one scale.
    """
    starved = f"four peers, budget {plan.starved:g} − a drone alone"
    panels: list[tuple[str, Callable[[DoseRow], Effect], float | None]] = [
        (starved, lambda r: r.starved, PAPER_STARVED.get(plan.starved)),
        ("two silent peers − four silent peers", lambda r: r.silent, None),
    ]
    for k, budget in enumerate(plan.budgets):
        panels.append((f"two peers − four peers, budget {budget:g}", _contrast(k), PAPER_CONTRAST.get(budget)))
    figure, axes = figure_of(2, 3, (11.0, 6.6), sharex=True)
    names = list(dict.fromkeys(r.network for r in rows))
    for i, (ax, (title, of, paper)) in enumerate(zip(axes, panels, strict=True)):
        ax.axhline(0, color=INK, lw=0.8)
        if paper is not None:
            ax.axhline(paper, color=PAPER, lw=1, ls=":")
        for k, name in enumerate(names):
            its = [r for r in rows if r.network == name]
            _network(ax, its, of, COLOURS[k % len(COLOURS)], APART * (k - (len(names) - 1) / 2))
        ax.set_title(title, loc="left", fontsize=10)
        if i % 3 == 0:
            ax.set_ylabel("difference of AP, points")
        if i >= 3:
            ax.set_xlabel("weight of four silent peers on cars (0 to 1)")
    ends = [ax.get_ylim() for ax in axes[2:]]
    for ax in axes[2:]:
        ax.set_ylim(min(low for low, _ in ends), max(high for _, high in ends))
    for name, colour in zip(names, COLOURS, strict=False):
        axes[0].plot([], [], color=colour, lw=2, label=name)
    for label, dose in _KINDS.items():
        axes[0].plot([], [], _mark(dose), color=INK, mfc="white" if dose.unsent == "masked" else INK, ms=5, label=label)
    axes[0].plot([], [], color=PAPER, lw=1, ls=":", label="the paper's value")
    legend_below(figure, axes[0])
    return figure


_KINDS = {
    "zero fill, by weight": Dose(),
    "masked fusion (control)": Dose(unsent="masked"),
    "peers not chosen count as zeros": Dose(absent="zeros"),
}


def _mark(dose: Dose) -> str:
    return "s" if dose.absent == "zeros" else "o"


def _network(ax: Axes, rows: Sequence[DoseRow], of: Callable[[DoseRow], Effect], colour: str, shift: float) -> None:
    """One network's points with their intervals; a line joins the doses of zero fill by their weight."""
    line = sorted(
        (r for r in rows if r.dose.unsent == "zero" and r.dose.absent == "excluded"), key=lambda r: r.weight_on_zeros
    )
    ax.plot([r.weight_on_zeros for r in line], [of(r).value for r in line], color=colour, lw=1)
    for r in rows:
        effect, masked = of(r), r.dose.unsent == "masked"
        x = r.weight_on_zeros + (shift if masked or r.dose.absent == "zeros" else 0.0)
        ax.plot([x, x], [effect.low, effect.high], color=colour, lw=1.4)
        ax.plot(x, effect.value, _mark(r.dose), color=colour, mfc="white" if masked else colour, ms=5)


def _contrast(k: int) -> Callable[[DoseRow], Effect]:
    return lambda r: r.contrasts[k]
