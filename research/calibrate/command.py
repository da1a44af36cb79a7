"""`python -m research calibrate`: fit the surrogate to the torch detector, and compare both on whole sorties."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.box import SIMPLE
from rich.table import Table
from rich.text import Text

from research.calibrate.in_flight import REGIONS, ConditionAp, flights, means
from sortie.policies.registry import resolve
from sortie.scenarios.reading.load import load, load_conditions
from sortie.scenarios.report_text import points
from sortie.sim.cli.console import out, print_written, stages
from sortie.sim.cli.options import refuse
from sortie.sim.folders import ensure_files

if TYPE_CHECKING:
    from research.calibrate.judge import CalibrationVerdict


def calibrate(
    context: typer.Context,
    out_file: Annotated[
        Path,
        typer.Option(
            "--out",
            help="File for the calibration (safetensors), its card is written beside it. The surrogate finds `NET.surrogate.safetensors` where a flight names `NET.safetensors`.",
        ),
    ] = Path("runs/calibrate/surrogate.safetensors"),
    weights: Annotated[Path | None, typer.Option(help="The detector's weights; default: the shipped ones.")] = None,
    scenes: Annotated[int, typer.Option(help="Number of scenes to fit to.", min=2)] = 44,
    held_out: Annotated[int, typer.Option(help="Number of held-out scenes for the evaluation.", min=2)] = 14,
    seed: Annotated[int, typer.Option(help="Seed of the scenes and fits.", min=0)] = 0,
    work: Annotated[
        Path, typer.Option(help="Folder for the detector's results; those that exist are not computed again.")
    ] = Path("runs/calibrate"),
    fly: Annotated[
        str | None,
        typer.Option(help="Afterwards fly this scenario or set of conditions with both detectors and compare them."),
    ] = None,
    made: Annotated[Path | None, typer.Option(help="With --fly: use this calibration instead of fitting one.")] = None,
    policies: Annotated[
        str, typer.Option(help="With --fly: the policies, separated by commas.")
    ] = "silence,all-4,boxes",
    rate_hz: Annotated[
        float, typer.Option(help="With --fly: how often those sorties are scored.", min=0.05, max=10)
    ] = 0.5,
    towns: Annotated[
        int, typer.Option(help="With --fly: in how many towns each of them is flown.", min=1, max=1000)
    ] = 1,
) -> None:
    """Fit the surrogate to the torch detector and evaluate it on held-out scenes. An interrupted run continues."""
    if fly is None:
        refuse(context, ("made", "policies", "rate_hz", "towns"), "--fly")
    from research.calibrate.calibrate import calibrate as make  # here: torch takes a second to import

    chosen = [p.strip() for p in policies.split(",")]
    for p in chosen if fly is not None else ():
        resolve(p)
    if fly is not None and load_conditions(fly) is None:
        load(fly)
    if made is None:
        ensure_files(out_file)
    if made is None:
        with stages() as progress:
            _, verdict = make(
                out_file, work=work, weights=weights, scenes=scenes, held_out=held_out, seed=seed, progress=progress
            )
        _tell(verdict, out_file)
    if fly is not None:
        with stages() as progress:
            flown = list(flights(fly, made or out_file, weights, rate_hz, chosen, progress, towns))
        in_towns = f", {towns} towns each" if towns > 1 else ""
        for table in _in_flight(flown, f"AP in points, {fly} at {rate_hz:g} Hz{in_towns}"):
            out.print(table)


def _tell(verdict: CalibrationVerdict, out_file: Path) -> None:
    """Levels, orders, and where they are kept."""
    from research.calibrate.judge import WITHIN

    table = Table("condition", "torch", "surrogate", "error", title="AP@0.5 on held-out scenes")
    for v in verdict.levels:
        colour = "green" if abs(v.error) <= WITHIN else "red"
        table.add_row(v.condition, f"{v.torch:.3f}", f"{v.surrogate:.3f}", Text(f"{v.error:+.3f}", colour))
    out.print(table)
    for o in verdict.orders:
        said = "not significant" if not o.significant else "kept" if o.kept else "lost"
        out.print(
            f"{o.b} − {o.a}: torch {o.torch:+.3f} [{o.low:+.3f}, {o.high:+.3f}], surrogate {o.surrogate:+.3f}, {said}"
        )
    print_written("kept in", out_file, f", its card in {out_file.with_suffix('.md')}")


def _in_flight(levels: Sequence[ConditionAp], title: str) -> Iterator[Table]:
    """AP by both detectors, and what policies gain over one another; in points, with 95 % intervals over conditions."""
    found = list(means(levels))
    for region, words in REGIONS.items():
        table = Table(title=f"{title}, {words}", box=SIMPLE, padding=(0, 1, 0, 0))
        for column in ("policy", "torch", "surrogate", "error"):
            table.add_column(column, no_wrap=True)
        for m in (m for m in found if m.region == region):
            table.add_row(m.what, points(m.torch), f"{100 * m.surrogate:.1f}", points(m.error))
        if table.row_count:
            yield table
