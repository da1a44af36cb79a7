"""`sortie recording`: show a recording of another model, or evaluate it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from sortie.perception.recordings.recording import open_recording
from sortie.scenarios.report_text import points
from sortie.sim.cli.console import bars, out, print_written
from sortie.sim.folders import RunError, ensure_files

app = typer.Typer(no_args_is_help=True, help="Recordings of other models: features and boxes on disk.")

RecordingArgument = Annotated[Path, typer.Argument(help="An npz file or a Zarr folder.")]


@app.command()
def show(path: RecordingArgument) -> None:
    """Check a recording and print its contents."""
    rec = open_recording(path)
    c, h, w = rec.grid
    out.print(f"{len(rec)} frames of {rec.drones} drones in {len(set(rec.scene.tolist()))} scenes", soft_wrap=True)
    held = ", ".join(rec.large) or "no features: cells are counted as the radio carries them"
    out.print(f"cells {c} × {h} × {w} of {rec.cell_m:g} m; {held}", soft_wrap=True)
    boxes = sum(len(rec.boxes(f, d)) for f in range(len(rec)) for d in range(rec.drones))
    out.print(f"{boxes} boxes, {sum(len(rec.truth(f)) for f in range(len(rec)))} cars", soft_wrap=True)


@app.command()
def evaluate(
    path: RecordingArgument,
    fusion: Annotated[
        str | None, typer.Option(help="Your fusion, path/to/file.py:function; default: boxes by cell.")
    ] = None,
    conditions: Annotated[
        str | None,
        typer.Option(
            help="Ways of sharing, separated by spaces: 'single best-2@0.02 all-4@1'. Gains are over the first."
        ),
    ] = None,
    tau: Annotated[float, typer.Option(help="Score threshold.")] = 0.1,
    save: Annotated[Path | None, typer.Option("--out", help="Write every match as Parquet here.")] = None,
) -> None:
    """Compute AP, gains and bytes of a recording under several ways of sharing. Without --fusion, boxes arrive with their cells."""
    from sortie.perception.evaluation import Sharing, evaluate_recording
    from sortie.perception.evaluation.harness import FLOOR

    ensure_files(save)
    if not FLOOR <= tau <= 1.0:  # before the evaluation, which may take hours
        raise RunError(f"tau is {tau:g}, must be {FLOOR:g} to 1")
    asked = None if conditions is None else [Sharing.parse(label) for label in conditions.split()]
    with bars() as bar:
        found = evaluate_recording(
            path, asked, fusion=fusion, progress=lambda done, of: bar("frames", of)(done) if done == of else None
        )
    shown = found.at(tau)
    first = shown.conditions[0]
    groups = len(set(shown.groups(by=shown.resampled).tolist()))
    table = Table(
        title=f"{path.name}, AP@0.5 at τ = {tau:g}",
        caption=f"gain: points over {first.label}, full scene, with 95 % interval over {groups} {shown.resampled}(s);\n"
        "bytes: mean of an ego in a frame",
    )
    for name in ("condition", "full", "gain", "mission", "payload, B", "index, B"):
        table.add_column(name, justify="left" if name == "condition" else "right", no_wrap=name == "gain")
    for c in shown.conditions:
        gain = None if c == first else shown.gain(c, first)
        over = "" if gain is None else points((gain.delta, gain.low, gain.high), "+.1f")
        bytes_ = (f"{b[c].mean():.0f}" for b in (shown.payload_bytes, shown.index_bytes))
        table.add_row(c.label, f"{shown.ap(c):.3f}", over, f"{shown.ap(c, 'mission'):.3f}", *bytes_)
    out.print(table)
    if save is not None:
        found.save(save)
        print_written("kept in", save)
