"""`python -m research train`: the command."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from sortie.sim.cli.console import out, stages
from sortie.sim.cli.options import DeviceOption, ImagePx, ImagePxOption
from sortie.sim.folders import RunError, ensure_files


class ExchangeForm(StrEnum):
    rectified = "rectified"
    signed = "signed"


class Decoder(StrEnum):
    shallow = "shallow"
    deep = "deep"


class Grid(StrEnum):
    coarse = "coarse"
    fine = "fine"


class Precision(StrEnum):
    float32 = "float32"
    bfloat16 = "bfloat16"


class Unsent(StrEnum):
    masked = "masked"
    zero = "zero"


class Range(StrEnum):
    full = "102.4"
    small = "51.2"


def train(
    out_file: Annotated[
        Path, typer.Option("--out", help="File for the weights (safetensors); their card is written beside it.")
    ] = Path("runs/train/disconet.safetensors"),
    steps: Annotated[int, typer.Option(help="Optimiser steps.", min=1)] = 500,
    batch: Annotated[int, typer.Option(help="Fleet-frames a step, an even number.", min=2)] = 4,
    scenes: Annotated[
        int,
        typer.Option(
            help="Number of scenes of the train split, from the first; beyond its usual 100, more are made.", min=1
        ),
    ] = 100,
    seed: Annotated[int, typer.Option(help="Seed of weights and batches.", min=0)] = 0,
    peak_lr: Annotated[float, typer.Option(help="The cycle's highest learning rate.")] = 2.5e-3,
    cell_dropout: Annotated[
        float, typer.Option(help="Share of the links on which cells are randomly dropped, 0 to 1.", min=0, max=1)
    ] = 0.0,
    unsent: Annotated[Unsent, typer.Option(help="How a dropped cell enters the fusion in training.")] = Unsent.masked,
    fusion: Annotated[
        str, typer.Option(help="Fusion method, see `sortie list fusion`, or path/to/file.py:Name.")
    ] = "disconet",
    exchange: Annotated[
        ExchangeForm, typer.Option(help="Features after or before the last ReLU.")
    ] = ExchangeForm.rectified,
    decoder: Annotated[Decoder, typer.Option(help="The head's trunk.")] = Decoder.shallow,
    grid: Annotated[
        Grid, typer.Option(help="Where maps are fused: in the exchanged cells, or in the head's.")
    ] = Grid.coarse,
    varied: Annotated[
        float,
        typer.Option(help="Share of the steps on dense scenes, any height and differing headings.", min=0, max=1),
    ] = 0.0,
    precision: Annotated[
        Precision,
        typer.Option(
            help="Precision of the computation; bfloat16 takes about half the time if the processor supports it."
        ),
    ] = Precision.float32,
    range_: Annotated[Range, typer.Option("--range", help="How far the grids reach, ± metres.")] = Range.full,
    image_px: ImagePxOption = ImagePx.usual,
    bench_seed: Annotated[int, typer.Option(help="Seed of the benchmark.", min=0)] = 0,
    bench_dir: Annotated[Path, typer.Option("--bench", help="Folder of benchmarks.")] = Path("runs/bench"),
    warm_start: Annotated[
        Path | None,
        typer.Option(
            help="Start from this weights file, or from the shipped weights of a fusion, as far as shapes fit."
        ),
    ] = None,
    minutes: Annotated[float | None, typer.Option(help="Stop after this many minutes.", min=0.1)] = None,
    device: DeviceOption = None,
    resume: Annotated[bool, typer.Option(help="Continue from the last checkpoint.")] = True,
) -> None:
    """Train the detector on the benchmark's train split. An interrupted run continues.

    Loss and validation AP are kept as CSV beside the weights, and if Rerun is installed as its recording (training.rrd).
    """
    from research.benchmark.dataset import Benchmark  # here: torch takes a second to import
    from research.flip.networks import config_of
    from research.train.devices import device_named
    from research.train.recipe import Recipe
    from research.train.train import train as train_detector
    from sortie.perception.geometry import Geometry
    from sortie.perception.network.detector import named_weights, shipped
    from sortie.perception.network.fusion.registry import FUSIONS
    from sortie.scenarios.plugins.reference import resolve

    half_extent_m = float(range_.value)
    # before scenes are rendered, which takes minutes
    if warm_start is not None:
        warm_start = shipped(str(warm_start)) if str(warm_start) in FUSIONS else named_weights(warm_start)
    recipe = Recipe(
        steps=steps,
        batch=batch,
        seed=seed,
        scenes=scenes,
        peak_lr=peak_lr,
        cell_dropout=cell_dropout,
        unsent=unsent.value,
        varied=varied,
        precision=precision.value,
        warm_start=warm_start.name if warm_start else "",
    )
    if fusion not in FUSIONS:
        resolve("fusion", fusion, None, FUSIONS)
    device_named(device)
    if warm_start is not None and not warm_start.is_file():
        raise RunError(f"{warm_start}: no such weights")
    ensure_files(out_file)
    config = config_of(
        {
            "half_extent_m": half_extent_m, "fusion": fusion, "exchange": exchange.value, "decoder": decoder.value,
            "grid": grid.value, "image_px": int(image_px.value),
        }
    )  # fmt: skip
    with stages() as progress, _curves(out_file) as scalars:
        result = train_detector(
            out_file,
            recipe,
            config,
            Benchmark(bench_seed, geometry=Geometry(half_extent_m, int(image_px.value))),
            root=bench_dir,
            warm_start=warm_start,
            minutes=minutes,
            resume=resume,
            device=device,
            progress=progress,
            scalars=scalars,
        )
    out.print(training_table(result))


@contextmanager
def _curves(weights: Path) -> Iterator[Callable[[int, dict[str, float]], None] | None]:
    """Keeps curves as a recording beside the weights; None if Rerun is missing."""
    try:
        from research.train.playback import TrainingLog
    except ImportError:
        yield None
        return
    log = TrainingLog(weights.parent / "training.rrd", weights.stem)
    yield log.log
    log.close()


def training_table(result: Any) -> Table:
    """The result of a training run."""
    table = Table(title="training", show_header=False)
    for name in result.__slots__ if hasattr(result, "__slots__") else vars(result):
        table.add_row(name, str(getattr(result, name)))
    return table
