"""`python -m research fit`: what representations need beside a network's weights: a codebook, and how uncertain boxes are."""

from __future__ import annotations

import shlex
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from sortie.sim.cli.console import out, print_written, stages
from sortie.sim.cli.options import refuse
from sortie.sim.folders import ensure_files, write_text

app = typer.Typer(
    no_args_is_help=True,
    help="Fit what two representations need: a codebook for `codes`, and the errors of boxes for `uncertain_boxes`.",
)
BenchOption = Annotated[Path, typer.Option("--bench", help="Folder of benchmarks.")]
WeightsOption = Annotated[Path | None, typer.Option("--weights", help="The network's weights; default: the shipped.")]
OutOption = Annotated[Path | None, typer.Option("--out", help="File to write; default: beside the weights.")]


class Boxes(StrEnum):
    torch = "torch"
    surrogate = "surrogate"


@app.command("codebook")
def fit_codebook(
    weights: WeightsOption = None,
    out_file: OutOption = None,
    stages_: Annotated[
        int, typer.Option("--stages", help="Number of stages: the most bytes of a cell.", min=1, max=20)
    ] = 20,
    scenes: Annotated[int, typer.Option(help="Number of scenes of the train split.", min=1, max=100)] = 10,
    iterations: Annotated[int, typer.Option(help="Rounds of k-means in each stage.", min=1)] = 25,
    seed: Annotated[int, typer.Option(help="Seed of the draw of cells and of k-means.", min=0)] = 0,
    bench_seed: Annotated[int, typer.Option(help="Seed of the benchmark.", min=0)] = 0,
    bench_dir: BenchOption = Path("runs/bench"),
) -> None:
    """Fit a codebook to a network's features: cells become codes of one byte a stage. Takes about two minutes."""
    from research.benchmark.dataset import Benchmark  # here: torch takes a second to import
    from research.train.codebook import CodebookRecipe, make_codebook
    from sortie.perception.network.checkpoint import load_weights
    from sortie.perception.network.detector import named_weights
    from sortie.scenarios.shipped import CODEBOOK, beside

    path = named_weights(weights)
    target = out_file or beside(path, CODEBOOK)
    recipe = CodebookRecipe(stages_, scenes, iterations, seed)
    net = load_weights(path)
    ensure_files(target)
    with stages() as progress:
        facts = make_codebook(
            net, target, Benchmark(bench_seed, geometry=net.config.geometry), recipe,
            weights=path.name, root=bench_dir, progress=progress,
        )  # fmt: skip
    table = Table("bytes of a cell", "variance that is lost", title=f"{facts['cells']} cells")
    for length, lost in facts["unexplained"].items():
        table.add_row(str(length), f"{100 * lost:.1f} %")
    out.print(table)
    print_written("kept in", target, ", its card beside it")


@app.command("errors")
def fit_errors(
    context: typer.Context,
    boxes: Annotated[
        Boxes, typer.Argument(help="The detector whose boxes are fitted: the neural network or the surrogate.")
    ] = Boxes.torch,
    weights: WeightsOption = None,
    out_file: OutOption = None,
    towns: Annotated[
        int,
        typer.Option(
            help="With surrogate: number of towns. The network's boxes are those of the validation split.", min=4
        ),
    ] = 60,
    bench_seed: Annotated[int, typer.Option(help="With torch: seed of the benchmark.", min=0)] = 0,
    bench_dir: BenchOption = Path("runs/bench"),
) -> None:
    """Fit how uncertain the places of boxes are, by score and distance, so that drones can send covariances."""
    if boxes is Boxes.surrogate:
        refuse(context, ("bench_seed", "bench_dir"), "python -m research fit errors torch")
    else:
        refuse(context, ("towns",), "python -m research fit errors surrogate")
    from research.train import box_errors
    from sortie.perception.uncertainty import errors_text
    from sortie.scenarios.shipped import ERRORS, beside

    if boxes is Boxes.surrogate:
        from sortie.perception.surrogate.model import SHIPPED
        from sortie.scenarios.shipped import calibration_of

        path = SHIPPED if weights is None else calibration_of(weights)
    else:
        from sortie.perception.network.detector import named_weights

        path = named_weights(weights)
    target = out_file or beside(path, ERRORS)
    ensure_files(target)
    if boxes is Boxes.surrogate:
        from research.calibrate.errors import moments

        found = moments(path, "fit", towns)
        drawn = {"towns": towns}
    else:
        from research.benchmark.dataset import Benchmark, load_frames, make_split
        from research.train.boxes_alone import boxes_alone, moments_of
        from sortie.perception.network.checkpoint import load_weights
        from sortie.scenarios.schema import Perception

        net = load_weights(path)
        split = make_split(Benchmark(bench_seed, geometry=net.config.geometry), "validation", bench_dir)
        frames = load_frames(split)
        found = moments_of(frames, boxes_alone(net, frames, Perception().score_threshold))
        drawn = {"bench-seed": bench_seed}
    model = box_errors.fit(found)
    fitted = box_errors.calibration(model, found)
    given = {"weights": weights, "out": out_file} | drawn
    flags = [part for k, v in given.items() if v is not None for part in (f"--{k}", str(v))]
    command = shlex.join(["python", "-m", "research", "fit", "errors", boxes.value, *flags])
    made = {"command": command, "boxes_of": path.name, "boxes": fitted.boxes}
    write_text(target, errors_text(model, made))
    out.print(
        f"{fitted.boxes} boxes: {100 * fitted.within[0]:.1f} % of the errors within one standard deviation, "
        f"{100 * fitted.within[1]:.1f} % within two; {100 * model.common:.0f} % of a variance is common to several drones"
    )
    print_written("kept in", target)
