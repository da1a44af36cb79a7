"""The dose–response study as tables and a picture: every network at every dose, and each hypothesis with its verdict."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from stored import Cell, Column, Table

from sortie.perception.evaluation.figures import save
from sortie.perception.study.dose_figure import draw
from sortie.perception.study.dose_run import measure
from sortie.perception.study.doses import DosePlan, DoseRow, Effect, FrameRange, read_plan, verdicts

MEASURED = (FrameRange(0, 80, 168),)
"""The plan's frames as far as they have been measured: its first, in its order."""


def tables(work: Path, root: Path, picture: Path, workers: int = 2) -> dict[str, Table | str]:
    """Measures what is missing under `work`, and draws the picture."""
    plan = read_plan()
    rows = list(measure(plan, work, root, frames=MEASURED, workers=workers))
    save(draw(plan, rows), picture)
    return {"doses": dose_table(plan, rows), "dose_verdicts": verdict_table(plan, rows)}


def dose_table(plan: DosePlan, rows: Sequence[DoseRow]) -> Table:
    """A row for each network and dose, in the plan's order."""
    contrasts = [f"two − four, {budget:g}" for budget in plan.budgets]
    effects = [Column(name, "+.1f") for name in (f"starved, {plan.starved:g}", "two silent − four silent", *contrasts)]
    columns = [Column("network"), Column("dose"), Column("weight on zeros", ".2f"), *effects]
    found = [
        [r.network, r.dose.label, r.weight_on_zeros, *map(_cell, (r.starved, r.silent, *r.contrasts))] for r in rows
    ]
    return Table(columns, found, f"{_frames(plan, rows)} Five egos a frame; AP points with 95 % intervals over frames.")


def verdict_table(plan: DosePlan, rows: Sequence[DoseRow]) -> Table:
    """A row for each hypothesis: in which networks it holds by the plan's rule."""
    found = verdicts(rows)
    out: list[list[Cell]] = []
    for k, hypothesis in enumerate(plan.hypotheses):
        name, _, says = hypothesis.partition(": ")
        holds = [several[k] for several in found.values()]
        out.append([name, says, *("held" if h else "not held" for h in holds), f"{sum(holds)} of {len(holds)}"])
    return Table(
        [Column("hypothesis"), Column("it says"), *map(Column, found), Column("held in")], out, _frames(plan, rows)
    )


def _frames(plan: DosePlan, rows: Sequence[DoseRow]) -> str:
    """A sentence: how much of the plan all this stands on."""
    of = sum(r.last - r.first + 1 for r in plan.frames)
    if (count := rows[0].frames) == of:
        return f"All {of} frames of the plan."
    return f"The first {count} of the plan's {of} frames, in the plan's order."


def _cell(e: Effect) -> Cell:
    return e.value, e.low, e.high
