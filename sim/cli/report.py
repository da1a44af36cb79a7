"""`sortie report`: a run as one page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sortie.sim.cli.console import out
from sortie.sim.results import run_folder

PAGE = "report.html"


def report(
    run: Annotated[Path, typer.Argument(help="A run's folder.")],
    out_path: Annotated[
        Path | None, typer.Option("--out", help="The page; left out, report.html in the run's folder.")
    ] = None,
) -> None:
    """Write a run as one HTML page that needs nothing else: figures, outcome, and the decisions in words."""
    from sortie.sim.results.report import save_page

    record = run_folder.load(run)
    path = out_path or run / PAGE
    save_page(record, path)
    out.print(f"kept in [bold]{path}[/bold]", soft_wrap=True)
