"""`sortie view`: open a run in the Rerun viewer, or save a picture of it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sortie.sim.cli.console import err, out
from sortie.sim.folders import RunError
from sortie.sim.results import run_folder


def view(
    run: Annotated[Path, typer.Argument(help="A run's folder.")],
    picture: Annotated[
        Path | None, typer.Option(help="Save a picture of the viewer here instead of opening it; needs no screen.")
    ] = None,
    at_s: Annotated[
        float, typer.Option("--at", help="With --picture: the simulated time that it shows, s.", min=0)
    ] = 0.0,
) -> None:
    """Open a run's recording in the Rerun viewer. A missing recording is made again."""
    from sortie.sim.playback.recording import save_rrd
    from sortie.sim.playback.viewer import open_viewer

    if at_s and picture is None:
        raise RunError("--at goes with --picture: the viewer has a time line of its own")
    path = run / run_folder.RECORDING
    if not path.is_file():
        save_rrd(run_folder.load(run), path)
    if picture is None:
        open_viewer(path)
        return
    from sortie.sim.playback.picture import take_picture

    for complaint in take_picture(path, picture, at_s):
        err.print(complaint, soft_wrap=True)
    out.print(f"kept in [bold]{picture}[/bold]", soft_wrap=True)
