"""`python -m research from-uav3d`: make a recording from UAV3D's files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from research.uav3d.uav3d import convert
from sortie.sim.cli.console import print_written


def from_uav3d(
    root: Annotated[Path, typer.Argument(help="The folder with uav3d_infos_val.pkl and the tables' folder.")],
    out_path: Annotated[Path, typer.Option("--out", help="An npz file, or a new Zarr folder.")],
    split: Annotated[str, typer.Option(help="train or val.")] = "val",
) -> None:
    """Make a recording from a UAV3D split: scenes, times, poses and cars. Add detections yourself."""
    convert(root, split, out_path)
    print_written("kept in", out_path)
