"""`sortie calibrate`: the surrogate from the torch detector's own runs, and both side by side on whole sorties."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from scenarios.load import load
from sim.console import out, stages, user_errors


def calibrate(
    out_file: Annotated[
        Path, typer.Option("--out", help="Where the calibration goes (safetensors); its card lies beside.")
    ] = Path("runs/calibrate/surrogate.safetensors"),
    weights: Annotated[Path | None, typer.Option(help="The detector's weights; left out, the shipped ones.")] = None,
    scenes: Annotated[int, typer.Option(help="Scenes to fit to.", min=2)] = 44,
    held_out: Annotated[int, typer.Option(help="Scenes to be judged on.", min=2)] = 14,
    seed: Annotated[int, typer.Option(help="Seed of scenes and fits.", min=0)] = 0,
    work: Annotated[Path, typer.Option(help="Keeps the detector's answers; what is there is not asked again.")] = Path(
        "runs/calibrate"
    ),
    fly: Annotated[
        str | None, typer.Option(help="Then fly this scenario with both detectors under worked, all-4 and silence.")
    ] = None,
    rate_hz: Annotated[float, typer.Option(help="How often those sorties are scored.", min=0.05, max=10)] = 0.5,
) -> None:
    """Fit the surrogate to the torch detector's own runs and judge it on held-out scenes; goes on where it was cut off."""
    from perception.surrogate.calibrate import calibrate as make  # here: torch takes a second to import
    from perception.surrogate.judge import WITHIN

    with user_errors():
        if fly is not None:
            load(fly)
        with stages() as progress:
            _, verdict = make(
                out_file, work=work, weights=weights, scenes=scenes, held_out=held_out, seed=seed, progress=progress
            )
    table = Table("condition", "torch", "surrogate", "error", title="AP@0.5 on held-out scenes")
    for v in verdict.levels:
        colour = "green" if abs(v.error) <= WITHIN else "red"
        table.add_row(v.condition, f"{v.torch:.3f}", f"{v.surrogate:.3f}", f"[{colour}]{v.error:+.3f}[/{colour}]")
    out.print(table)
    for o in verdict.orders:
        said = "not significant" if not o.significant else "kept" if o.kept else "[red]lost[/red]"
        out.print(
            f"{o.b} − {o.a}: torch {o.torch:+.3f} \\[{o.low:+.3f}, {o.high:+.3f}], surrogate {o.surrogate:+.3f}, {said}"
        )
    out.print(f"kept in [bold]{out_file}[/bold], its card in [bold]{out_file.with_suffix('.md')}[/bold]")
    if fly is not None:
        with user_errors():
            out.print(side_by_side(fly, out_file, weights, rate_hz))


def side_by_side(scenario: str, calibration: Path, weights: Path | None, rate_hz: float) -> Table:
    """AP of whole sorties by both detectors, policy by policy, on the same seed."""
    from sim.outcome import accuracy
    from sim.sortie import run_sortie

    table = Table("policy", "region", "torch", "surrogate", "error", title=f"{scenario}, scored at {rate_hz:g} Hz")
    shared = [f"perception.sample_rate_hz={rate_hz}"]
    torch = [*shared, "perception.detector=torch", *([f"perception.weights={weights}"] if weights else [])]
    ours = [*shared, "perception.detector=surrogate", f"perception.weights={calibration}"]
    for policy in ("silence", "worked", "all-4"):
        a, b = (accuracy(run_sortie(load(scenario, how), policy)) for how in (torch, ours))
        for region in ("full_scene", "mission"):
            x, y = a[region], b[region]
            if x is not None and y is not None:
                table.add_row(policy, region, f"{x:.3f}", f"{y:.3f}", f"{y - x:+.3f}")
    return table
