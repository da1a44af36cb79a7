"""The dose–response study's figure by matplotlib (the optional extra `report`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from sortie.perception.evaluation.figures import INK, figure_of, legend_below
from sortie.perception.study.doses import DosePlan, DoseRow, Effect

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = ("#1f6fb4", "#2a9d5c", "#c2571a", "#8a63b8", "#7a7f87")
CAPTION = "Weight that silent peers draw, against what sharing little is worth"


def draw(plan: DosePlan, rows: Sequence[DoseRow]) -> Figure:
    """A panel for each figure of the study over the weight on zeros: a colour a network; hollow at 0: masked fusion."""
    panels: list[tuple[str, Callable[[DoseRow], Effect]]] = [
        (f"four peers at a budget of {plan.starved:g} − a drone alone", lambda r: r.starved),
        ("two silent peers − four silent peers", lambda r: r.silent),
    ]
    panels += [(f"two peers − four, budget {budget:g}", _contrast(k)) for k, budget in enumerate(plan.budgets)]
    figure, axes = figure_of(2, 3, (11.0, 6.4), sharex=True)
    names = list(dict.fromkeys(r.network for r in rows))
    for i, (ax, (title, of)) in enumerate(zip(axes, panels, strict=True)):
        ax.axhline(0, color=INK, lw=0.8)
        for k, name in enumerate(names):
            colour, its = COLOURS[k % len(COLOURS)], [r for r in rows if r.network == name]
            filled = sorted((r for r in its if r.dose.unsent == "zero"), key=lambda r: r.weight_on_zeros)
            line = [r for r in filled if r.dose.absent == "excluded"]
            ax.plot([r.weight_on_zeros for r in line], [of(r).value for r in line], color=colour, lw=1, label=name)
            for r in its:
                effect, x = of(r), r.weight_on_zeros
                ax.plot([x, x], [effect.low, effect.high], color=colour, lw=1.4)
                face = "white" if r.dose.unsent == "masked" else colour
                mark = "s" if r.dose.absent == "zeros" else "o"
                ax.plot(x, effect.value, mark, color=colour, mfc=face, ms=5)
        ax.set_title(title, loc="left", fontsize=10)
        if i % 3 == 0:
            ax.set_ylabel("AP points")
        if i >= 3:
            ax.set_xlabel("softmax weight of four silent peers on cars")
    legend_below(figure, axes[0])
    return figure


def _contrast(k: int) -> Callable[[DoseRow], Effect]:
    return lambda r: r.contrasts[k]
