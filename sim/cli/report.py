"""`sortie report`: write a run as one page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import sortie
from sortie.sim.cli.console import out

PAGE = "report.html"


def report(
    run: Annotated[Path, typer.Argument(help="A run's folder.")],
    out_path: Annotated[
        Path | None, typer.Option("--out", help="The page; default: report.html in the run's folder.")
    ] = None,
) -> None:
    """Write a run as one self-contained HTML page: figures, outcome and decisions."""
    path = sortie.open_run(run).report(out_path or run / PAGE)
    out.print(f"kept in [bold]{path}[/bold]", soft_wrap=True)
