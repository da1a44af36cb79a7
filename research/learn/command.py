"""`python -m research learn`: fit the policy `learned`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from sortie.policies.catalogue.adaptive import ARMS
from sortie.scenarios.report_text import points
from sortie.sim.cli.console import bars, out, print_written
from sortie.sim.cli.options import SetOption
from sortie.sim.folders import ensure_files


def learn(
    conditions: Annotated[int, typer.Option(help="Number of training conditions.", min=8)] = 100,
    seed: Annotated[int, typer.Option(help="Seed of the training conditions.", min=0)] = 0,
    workers: Annotated[int, typer.Option(help="Number of processes.", min=1)] = 1,
    by_torch: Annotated[
        bool,
        typer.Option(
            "--by-torch", help="Fly with the surrogate, score with the torch detector; takes half an hour on one core."
        ),
    ] = False,
    set_: SetOption = None,
    out_file: Annotated[
        Path,
        typer.Option("--out", help="File for the fit; `learned` flies with policies/catalogue/learned.json."),
    ] = Path("runs/learned.json"),
) -> None:
    """Fit the policy `learned`: fly each of its choices in random conditions, and fit the gain in AP."""
    from research.learn.learn import BUDGETS, draw_condition, fly_lessons, gains, save, thresholds

    ensure_files(out_file)
    sets = tuple(set_ or ())
    draw_condition(seed, 0, sets)  # a wrong override fails here, before anything is flown
    with bars() as bar:
        lessons = fly_lessons(
            seed, conditions, sets=sets, by_torch=by_torch, workers=workers, progress=bar("conditions", conditions)
        )
    save(out_file, lessons, seed, by_torch=by_torch, sets=sets)
    table = Table("arm", "mean AP", "best in")
    for k, arm in enumerate(ARMS):
        wins = sum(max(lesson.ap) == lesson.ap[k] for lesson in lessons)
        table.add_row(arm.text, f"{sum(lesson.ap[k] for lesson in lessons) / len(lessons):.3f}", f"{wins}")
    out.print(table)
    table = Table("over the first arm, AP points, 95 %", *(f"budget {b:g}" for b in BUDGETS))
    for k, arm in enumerate(ARMS[1:], start=1):
        found = gains(lessons, k)
        for phase in ("search", "track"):
            cells = (found.get((phase, b)) for b in BUDGETS)
            table.add_row(
                f"{arm.text}: {phase}", *("–" if c is None else points((c.mean, c.low, c.high), "+.1f") for c in cells)
            )
    out.print(table)
    enough = ", ".join(f"{name} {budget:.3f}" for name, budget in thresholds(lessons).items())
    out.print(f"maps find more than boxes from a budget of: {enough}")
    print_written("kept in", out_file)
