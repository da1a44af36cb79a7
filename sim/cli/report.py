"""`sortie report`: write a run as one page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import sortie
from sortie.sim.cli.console import print_written
from sortie.sim.cli.options import ReplaceOption
from sortie.sim.folders import ensure_files
from sortie.sim.results.blocks import GENERATOR
from sortie.sim.results.run_files import PAGE


def report(
    run: Annotated[Path, typer.Argument(help="A run's folder.")],
    out_path: Annotated[
        Path | None, typer.Option("--out", help="The page; default: report.html in the run's folder.")
    ] = None,
    replace: ReplaceOption = False,
) -> None:
    """Write a run as one self-contained HTML page: figures, outcome and decisions. Only a page of Sortie is replaced without --replace."""
    path = out_path or run / PAGE
    opened = sortie.open_run(run)
    ensure_files(path, replace=replace, mark=GENERATOR)
    print_written("kept in", opened.report(path))
