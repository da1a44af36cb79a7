"""The dose–response study as tables and a picture: every network at every dose, and each hypothesis with its verdict."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from research.flip.dose_figure import draw
from research.flip.dose_run import measure
from research.flip.doses import DosePlan, DoseRow, Effect, read_plan, verdicts
from research.paper.figures import save
from research.train.devices import gpu_name, measuring_device
from research.validation.stored import Cell, Column, Table


def tables(work: Path, root: Path, picture: Path, workers: int = 2) -> dict[str, Table | str]:
    """Measures what is missing under `work`, by a GPU where there is one, and draws the picture."""
    plan, device = read_plan(), measuring_device("auto")
    rows = list(measure(plan, work, root, workers=workers, device=device))
    save(draw(plan, rows), picture)
    by = gpu_name(device)
    return {"doses": dose_table(plan, rows, by), "dose_verdicts": verdict_table(plan, rows, by)}


def dose_table(plan: DosePlan, rows: Sequence[DoseRow], gpu: str = "") -> Table:
    """A row for each network and dose, in the plan's order."""
    contrasts = [f"two − four, {budget:g}" for budget in plan.budgets]
    effects = [Column(name, "+.1f") for name in (f"starved, {plan.starved:g}", "two silent − four silent", *contrasts)]
    columns = [Column("network"), Column("dose"), Column("weight on zeros", ".2f"), *effects]
    found = [
        [r.network, r.dose.label, r.weight_on_zeros, *map(_cell, (r.starved, r.silent, *r.contrasts))] for r in rows
    ]
    return Table(
        columns, found, f"{_frames(plan, rows, gpu)} Five egos a frame; AP points with 95 % intervals over frames."
    )


def verdict_table(plan: DosePlan, rows: Sequence[DoseRow], gpu: str = "") -> Table:
    """A row for each hypothesis: in which networks it holds by the plan's rule."""
    found = verdicts(rows)
    out: list[list[Cell]] = []
    for k, hypothesis in enumerate(plan.hypotheses):
        name, _, says = hypothesis.partition(": ")
        holds = [several[k] for several in found.values()]
        out.append([name, says, *("held" if h else "not held" for h in holds), f"{sum(holds)} of {len(holds)}"])
    return Table(
        [Column("hypothesis"), Column("it says"), *map(Column, found), Column("held in")], out, _frames(plan, rows, gpu)
    )


def _frames(plan: DosePlan, rows: Sequence[DoseRow], gpu: str) -> str:
    """A sentence: how much of the plan all this stands on, and which GPU computed it."""
    of, by = sum(r.last - r.first + 1 for r in plan.frames), f", on an {gpu}" if gpu else ""
    if (count := rows[0].frames) == of:
        return f"All {of} frames of the plan{by}."
    return f"The first {count} of the plan's {of} frames, in the plan's order{by}."


def _cell(e: Effect) -> Cell:
    return e.value, e.low, e.high
