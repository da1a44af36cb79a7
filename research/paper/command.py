"""`python -m research paper`: the command."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer
from rich.table import Table
from rich.text import Text

from research.paper import report
from research.paper.rows import INSTRUMENTS, ClaimRow, differ_by_chance
from research.paper.verdict import ClaimVerdict
from research.paper.ways import Absent, CellsBy, Serve, Ways
from sortie.sim.cli.console import out, print_written, stages
from sortie.sim.cli.options import DeviceOption, WorkersOption, refuse
from sortie.sim.folders import RunError
from sortie.sim.readme import with_section
from sortie.sim.terminal import Terminal

if TYPE_CHECKING:
    from research.paper.picture import Picture

NARROW, PIPED_WIDTH = 150, 170
"""Columns of a terminal that show both instruments, and those that a pipe or file is given."""
COLOURS = {
    ClaimVerdict.REPRODUCED: "green",
    ClaimVerdict.NOT_REPRODUCED: "yellow",
    ClaimVerdict.OPPOSITE: "red",
    ClaimVerdict.INCONCLUSIVE: "cyan",
}


def paper(
    context: typer.Context,
    frames: Annotated[
        int | None, typer.Option(help="Use only this many frames of the test split; each is of another scene.", min=2)
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the benchmark.", min=0)] = 0,
    weights: Annotated[Path | None, typer.Option(help="A weights file; default: the shipped one.")] = None,
    unsent: Annotated[
        str, typer.Option(help="How unsent cells enter the fusion: zero (the paper), masked, or both.")
    ] = "both",
    cells_by: Annotated[str, typer.Option(help="How cells are ranked: confidence or norm.")] = "confidence",
    absent: Annotated[
        str, typer.Option(help="Peers that were not chosen: excluded from the fusion, or zeros in it.")
    ] = "excluded",
    serve: Annotated[
        str, typer.Option(help="Which cells go first: grid (by rank alone), or region_first (the mission's disc).")
    ] = "grid",
    temperature: Annotated[
        float, typer.Option(help="The fusion softmax's logits are divided by it; inf gives equal weights.")
    ] = 1.0,
    silent_weight: Annotated[
        float, typer.Option(help="Added to a silent peer's logit in the fusion's softmax, under zero fill.")
    ] = 0.0,
    tau: Annotated[float, typer.Option(help="Score threshold.")] = 0.1,
    scenes: Annotated[bool, typer.Option("--by-scene", help="Resample whole scenes instead of frames.")] = False,
    workers: WorkersOption = None,
    device: DeviceOption = None,
    out_dir: Annotated[Path, typer.Option("--out", help="The report's folder.")] = Path("runs/paper"),
    work: Annotated[
        Path, typer.Option(help="Folder that keeps the benchmark and finished frames between runs.")
    ] = Path("runs"),
    against: Annotated[Path | None, typer.Option(help="Folder of another report: print which verdicts differ.")] = None,
    live: Annotated[
        Path | None,
        typer.Option(help="Output of `sortie live --out`, for processor time and data plane of real processes."),
    ] = None,
    readme: Annotated[
        Path | None, typer.Option(help="Write the table of claims between the markers of this Markdown file.")
    ] = None,
    frame: Annotated[
        int | None, typer.Option(help="Draw only this frame in Rerun, as in the paper's data figure.", min=0)
    ] = None,
    ego: Annotated[int, typer.Option(help="With --frame: the ego, whose peers' cells are shown.", min=0)] = 0,
    show: Annotated[bool, typer.Option("--view", help="With --frame: open the viewer.")] = False,
) -> None:
    """Measure the claims of the paper's Evaluation again: its value, ours, and a verdict for each.

    Finished frames are kept, so an interrupted run continues.
    """
    if frame is None:
        refuse(context, ("ego", "show"), "--frame")
    else:
        refuse(context, ("against", "readme"), "the whole report, not with --frame")
    from research.paper import figures, rows
    from research.paper import making as making
    from research.paper.results import TableSettings
    from sortie.perception.network.detector import named_weights  # here: torch takes a second to import

    chosen = {"both": ("zero", "masked"), "zero": ("zero",), "masked": ("masked",)}.get(unsent)
    if chosen is None:
        raise RunError(f"unsent is {unsent!r}, must be zero, masked or both")
    for name, value, allowed in (
        ("cells_by", cells_by, get_args(CellsBy)),
        ("absent", absent, get_args(Absent)),
        ("serve", serve, get_args(Serve)),
    ):
        if value not in allowed:
            raise RunError(f"{name} is {value!r}, must be {' or '.join(allowed)}")
    given = {"temperature": temperature, "silent_weight": silent_weight}
    fusion_params = {name: value for name, value in given.items() if value != {"temperature": 1.0}.get(name, 0.0)}
    if readme is not None:
        with_section(readme, report.BEGIN + report.END, report.BEGIN, report.END)  # its errors come first
    ways = Ways(absent, serve)  # type: ignore[arg-type]
    asked = TableSettings(chosen, cells_by, tau, "scene" if scenes else "frame", ways=ways)  # type: ignore[arg-type]
    cores = workers or os.cpu_count() or 1
    job = making.PaperSettings(
        named_weights(weights),
        asked,
        frames,
        seed,
        cores,
        _command(context),
        live,
        fusion_params,
        device,
    )
    if frame is not None:
        _open_frame(
            making.frame_picture(job, work, frame, ego),
            work / "frames" / f"seed{seed}_frame{frame}_ego{ego}.rrd",
            show=show,
        )
        return
    making.ensure_writable(out_dir)
    other = [] if against is None else rows.read(against / making.TABLE)[0]
    with stages() as progress:
        result = making.make(job, work, progress)
    making.write(result, out_dir)
    wide = out if out.is_terminal else Terminal(width=PIPED_WIDTH)
    wide.print(verdicts_table(result.rows, masked=wide.width >= NARROW))
    out.print(_tally(result.rows))
    if not figures.available():
        out.print("no figures: they need matplotlib, as in pip install 'sortie-sim[report]'")
    print_written(f"{result.facts['cpu_s']:.0f} CPU-seconds, {result.facts['wall_s']:.0f} s; kept in", out_dir)
    if against is not None:
        out.print(_differences(result.rows, other, against))
    if readme is not None:
        link = _relative(out_dir / making.REPORT, readme.parent)
        making.put_into_readme(readme, result.rows, result.facts, link)
        print_written("results section of", readme, " written")


def verdicts_table(rows: Sequence[ClaimRow], *, masked: bool = True) -> Table:
    """Every claim: the paper's figure, ours under each instrument (or the first alone), and the verdicts."""
    shown = [i for i in INSTRUMENTS if any(r.instrument == i for r in rows)][: None if masked else 1]
    more = None if masked else f"a terminal {NARROW} columns wide shows masked fusion too, and so does the report"
    table = Table(title="the paper's Evaluation, AP differences in points with 95 % intervals", caption=more)
    table.add_column("claim", min_width=30)
    table.add_column("paper", justify="right")
    for i in shown:
        table.add_column(INSTRUMENTS[i], justify="right")
        table.add_column("verdict")
    claims: dict[str, dict[str, ClaimRow]] = {}
    for row in rows:
        claims.setdefault(row.id, {})[row.instrument] = row
    section = ""
    for several in claims.values():
        first = next(iter(several.values()))
        if first.section != section:
            section = first.section
            table.add_section()
            table.add_row(Text(section, "bold"))
        cells: list[str | Text] = []
        for k, i in enumerate(shown):
            it = several.get(i) or (several.get("") if k == 0 else None)
            cells += ["", ""] if it is None else [report.ours(it), _coloured(it)]
        table.add_row(first.says, report.papers(first), *cells)
    return table


def _tally(rows: Sequence[ClaimRow]) -> str:
    names: dict[str, str] = {str(i): name for i, name in INSTRUMENTS.items()}
    names[""] = "measured on a flown sortie"
    return "\n".join(
        f"{name}: {report.tally(r for r in rows if r.instrument == i)}"
        for i, name in names.items()
        if any(r.instrument == i for r in rows)
    )


def _differences(ours: Sequence[ClaimRow], theirs: Sequence[ClaimRow], where: Path) -> str:
    """Which claims came out otherwise in another report."""
    judged = {(r.id, r.instrument): r.verdict for r in theirs}
    lines = [
        f"  {r.says} ({INSTRUMENTS.get(r.instrument, 'flown')}): {r.verdict}, there {judged[r.id, r.instrument]}"  # type: ignore[call-overload]
        for r in ours
        if judged.get((r.id, r.instrument), r.verdict) != r.verdict
    ]
    both = [r for r in ours if (r.id, r.instrument) in judged]
    chance = f"two tables of one truth differ in {differ_by_chance(both):.1f} on average"
    first = f"{len(both) - len(lines)} of {len(both)} verdicts are those of {where} ({chance})"
    return "\n".join([first + (", but:" if lines else ""), *lines])


def _coloured(row: ClaimRow) -> Text:
    text = Text(row.verdict, COLOURS.get(ClaimVerdict(row.verdict), "dim"))
    return Text.assemble(text, f", {row.size}" if row.size and row.rule != "exact" else "")


def _open_frame(picture: Picture, path: Path, *, show: bool) -> None:
    from research.paper.playback import save_frame
    from sortie.sim.playback.viewer import open_viewer

    save_frame(picture, path)
    what = f"{picture.name}, ego {picture.ego}: {len(picture.truth)} cars, {len(picture.found)} boxes; kept in"
    print_written(what, path)
    if show:
        open_viewer(path)


def _command(context: typer.Context) -> str:
    """The command with those options that the numbers depend on and that differ from their defaults."""
    given = []
    for parameter in context.command.params:
        name, value = parameter.name, context.params.get(parameter.name or "")
        if (
            name
            in (
                "frames",
                "seed",
                "weights",
                "unsent",
                "cells_by",
                "absent",
                "serve",
                "temperature",
                "silent_weight",
                "tau",
                "scenes",
                "live",
                "device",
            )
            and value != parameter.default
        ):
            shown = value.name if isinstance(value, Path) else value
            given.append(parameter.opts[0] if value is True else f"{parameter.opts[0]} {shown}")
    return " ".join(["python -m research paper", *given])


def _relative(path: Path, folder: Path) -> str:
    """The link from a file in `folder` to `path`."""
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
