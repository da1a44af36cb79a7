"""`sortie view`: open a run in the Rerun viewer, or save a picture of it."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Annotated

import typer

import sortie
from sortie.sim.cli.console import err, print_written
from sortie.sim.cli.options import ReplaceOption
from sortie.sim.folders import RunError, ensure_files


def view(
    run: Annotated[Path, typer.Argument(help="A run's folder.")],
    picture: Annotated[
        Path | None,
        typer.Option(
            help="Save a picture of the viewer here instead of opening it. It needs no screen, but a Vulkan driver for the "
            "CPU (Debian, Ubuntu: apt install mesa-vulkan-drivers)."
        ),
    ] = None,
    at_s: Annotated[
        float, typer.Option("--at", help="With --picture: the simulated time that it shows, s.", min=0)
    ] = 0.0,
    replace: ReplaceOption = False,
) -> None:
    """Open a run's recording in the Rerun viewer. If the run has none, it is made now."""
    if at_s and picture is None:
        raise RunError("--at goes with --picture: the viewer has a time line of its own")
    opened = sortie.open_run(run)
    ensure_files(picture, replace=replace)
    if picture is None:
        opened.view()
        return
    with warnings.catch_warnings(record=True) as complaints:
        warnings.simplefilter("always", UserWarning)
        opened.picture(picture, at_s)
    for complaint in complaints:
        err.print(str(complaint.message), soft_wrap=True)
    print_written("kept in", picture)
