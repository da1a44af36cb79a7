"""`python -m research bench`: make the benchmark's scenes, draw a frame, verify the files, count what the scenes contain."""

from __future__ import annotations

from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from research.benchmark.difficulty import Difficulty
from research.benchmark.manifest import problems, read
from sortie.perception.geometry import Geometry
from sortie.scenarios.exit_codes import FAILED
from sortie.scenarios.report_text import points
from sortie.sim.cli.console import out, print_failure, print_written, stages
from sortie.sim.cli.options import ImagePx, ImagePxOption
from sortie.sim.folders import RunError

app = typer.Typer(no_args_is_help=True, help="The benchmark: seeded splits of procedural scenes.")


class SplitName(StrEnum):
    train = "train"
    validation = "validation"
    tau = "tau"
    test = "test"


class DensityName(StrEnum):
    sparse = "sparse"
    default = "default"
    dense = "dense"


class RangeName(StrEnum):
    full = "102.4"
    small = "51.2"


FolderArgument = Annotated[Path, typer.Argument(help="The benchmark's folder, the one with manifest.json.")]


@app.command()
def make(
    out_dir: Annotated[Path, typer.Option("--out", help="Folder of benchmarks; each has its own folder in it.")] = Path(
        "runs/bench"
    ),
    seed: Annotated[int, typer.Option(help="Seed of the benchmark; another seed makes other scenes.", min=0)] = 0,
    split: Annotated[
        list[SplitName] | None, typer.Option(help="Make only this split. Repeat the option for several.")
    ] = None,
    range_: Annotated[RangeName, typer.Option("--range", help="How far the grids reach, ± metres.")] = RangeName.full,
    image_px: ImagePxOption = ImagePx.usual,
    density: Annotated[DensityName, typer.Option(help="How many cars.")] = DensityName.default,
    scenes: Annotated[
        int | None, typer.Option(help="Make only this many scenes of each split, from the first.", min=1)
    ] = None,
    workers: Annotated[int | None, typer.Option(help="Number of processes; default: one per core.", min=1)] = None,
) -> None:
    """Render the splits. Finished scenes are kept, and an interrupted run continues."""
    from research.benchmark.dataset import MOST, SIZES, Benchmark, make_split

    bench = Benchmark(seed, Difficulty(density=density.value), Geometry(float(range_.value), int(image_px.value)))
    with stages() as report:
        for name in dict.fromkeys(s.value for s in split) if split else SIZES:
            count = min(scenes or SIZES[name][0], MOST[name])
            make_split(bench, name, out_dir, scenes=count, workers=workers, progress=partial(report, f"{name} scenes"))
    folder = bench.folder(out_dir)
    table = Table("split", "scenes", "fleet-frames", title=f"seed {seed}, {density.value}, ±{range_.value} m")
    for name, files in read(folder)["splits"].items():
        table.add_row(name, f"{len(files)}", f"{sum(f['frames'] for f in files.values())}")
    out.print(table)
    print_written("kept in", folder, f", see a frame with: python -m research bench show {folder} test 0")


@app.command()
def show(
    folder: FolderArgument,
    split: Annotated[SplitName, typer.Argument(help="The split.")],
    index: Annotated[int, typer.Argument(help="The scene's number in the split.", min=0)],
    frame: Annotated[int, typer.Option(help="The frame's number in the scene.", min=0)] = 0,
    out_file: Annotated[Path | None, typer.Option("--out", help="The PNG file; default: beside the splits.")] = None,
) -> None:
    """Draw a frame: five drones' views, their bird's-eye images, and who sees which car. Needs the extra `report`."""
    from research.benchmark.contact_sheet import draw, save
    from research.benchmark.dataset import MOST, SIZES, Benchmark

    bench = Benchmark.at(folder)
    count, (_, frames) = MOST[split.value], SIZES[split.value]
    if index >= count:
        raise RunError(f"scene is {index}, must be 0 to {count - 1} in the {split.value} split")
    if frame >= frames:
        raise RunError(f"frame is {frame}, must be 0 to {frames - 1} in the {split.value} split")
    path = out_file or folder / "sheets" / f"{split.value}_{index}_{frame}.png"
    save(draw(bench, split.value, index, frame), path)
    print_written("drawn in", path)


@app.command()
def verify(folder: FolderArgument) -> None:
    """Compare every file with the manifest. Exit code 1 if one is missing or differs."""
    with stages() as report:
        from research.benchmark.dataset import Benchmark

        Benchmark.at(folder)
        found = problems(folder, partial(report, "files"))
    for line in found:
        print_failure(line)
    if found:
        raise typer.Exit(FAILED)
    count = sum(len(files) for files in read(folder)["splits"].values())
    out.print(f"{count} files, all as the manifest says")


@app.command()
def survey(
    seed: Annotated[int, typer.Option(help="The benchmark's seed.", min=0)] = 0,
    density: Annotated[DensityName, typer.Option(help="How many cars.")] = DensityName.default,
    range_: Annotated[RangeName, typer.Option("--range", help="How far the grids reach, ± metres.")] = RangeName.full,
    scenes: Annotated[int, typer.Option(help="How many scenes of each split.", min=1)] = 12,
) -> None:
    """Count cars, visible cars and houses by split and style. Nothing is rendered."""
    from research.benchmark.dataset import SIZES, Benchmark
    from research.benchmark.survey import by_style
    from research.benchmark.survey import survey as survey_scene

    bench = Benchmark(seed, Difficulty(density=density.value), Geometry(float(range_.value)))
    table = Table("split", "style", "scenes", "cars a view", "seen alone", "by the fleet", "built", "height m", "lot m")
    with stages() as report:
        for split in SIZES:
            done = partial(report, f"{split} scenes")
            rows = []
            for k in range(min(scenes, SIZES[split][0])):
                rows.append(survey_scene(bench, split, k))
                done(k + 1, scenes)
            for style, n, mean in by_style(rows):
                table.add_row(
                    split, style, f"{n}", f"{mean.cars:.1f}", f"{mean.alone:.2f}", f"{mean.fleet:.2f}",
                    f"{mean.built:.2f}", f"{mean.height_m:.1f}", f"{mean.lot_m:.1f}",
                )  # fmt: skip
    out.print(table)


@app.command()
def difficulty(
    weights: Annotated[Path | None, typer.Option(help="A safetensors file; default: the shipped weights.")] = None,
    scenes: Annotated[int, typer.Option(help="Number of scenes that each row is measured on.", min=2)] = 12,
    store: Annotated[Path, typer.Option(help="Folder for finished scenes.")] = Path("runs/difficulty"),
    workers: Annotated[int | None, typer.Option(help="Number of processes; default: one per core.", min=1)] = None,
) -> None:
    """Measure how each parameter of the difficulty changes AP. An interrupted run continues."""
    with stages() as report:
        from research.paper.difficulty_effects import measure
        from sortie.perception.network.detector import named_weights

        used = named_weights(weights)
        effects = measure(used, store, scenes=scenes, workers=workers, progress=partial(report, "scenes"))
    title = f"AP@0.5 without a threshold, {scenes} scenes, {used.name}; change of AP sharing all, paired by scene, 95 %"
    table = Table("parameter", "moved to", "AP alone", "AP sharing all", "change, points", title=title)
    for e in effects:
        change = "" if e.change is None else points((e.change.delta, e.change.low, e.change.high), "+.1f")
        table.add_row(e.move.parameter, e.move.value, f"{e.gain.ap_a:.3f}", f"{e.gain.ap_b:.3f}", change)
    out.print(table)
