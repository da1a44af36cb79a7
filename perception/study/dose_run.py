"""Measures the dose–response study; resumes frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sortie.perception.benchmark.dataset import SIZES, Benchmark, Frames, load_frames, make_split
from sortie.perception.evaluation.evaluate import evaluate, truth
from sortie.perception.evaluation.instrument import CarNetInstrument
from sortie.perception.evaluation.results import TAU
from sortie.perception.evaluation.scores import Bootstrap
from sortie.perception.geometry import CELLS, Geometry, to_local
from sortie.perception.network.checkpoint import load_weights
from sortie.perception.study.doses import DosePlan, DoseRow, FrameRange, row_of
from sortie.perception.study.run import SHIPPED

Progress = Callable[[str, int, int], None]


def measure(
    plan: DosePlan,
    folder: Path,
    root: Path,
    *,
    weights: Path = SHIPPED,
    frames: Sequence[FrameRange] | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> Iterator[DoseRow]:
    """Every network at every dose, one row after the other.

    Args:
        folder: finished frames are kept here, so that a run that was cut off goes on where it was.
        root: folder of benchmarks; splits that are missing are made.
        weights: the networks' folder.
        frames: in place of the plan's.
        progress: called with (stage, done, of).

    Raises:
        ValueError: frames beyond the test split, or weights that are not there.
    """
    tell = progress or (lambda stage, done, of: None)
    data = frames_of(plan.frames if frames is None else frames, root, tell)
    for network in plan.networks:
        for dose in plan.dose:
            instrument = CarNetInstrument(load_weights(weights / f"{network}.safetensors"), fusion_params=dose.params)
            found = evaluate(
                instrument,
                data,
                tuple(plan.conditions(dose)),
                regions=("full",),
                store=folder / "frames",
                workers=workers,
                progress=partial(tell, f"{network}, {dose.label}"),
            )
            weight = 0.0 if dose.unsent == "masked" else weight_on_zeros(instrument, data)
            yield row_of(plan, network, dose, weight, Bootstrap(found.at(TAU), dose.unsent, ways=dose.ways), len(data))


def frames_of(ranges: Sequence[FrameRange], root: Path, tell: Progress) -> Frames:
    """The frames of these ranges, one after the other."""
    scenes, each = SIZES["test"]
    files: list[Path] = []
    for r in ranges:
        if not 0 <= r.first <= r.last < scenes * each:
            raise ValueError(
                f"frames {r.first} to {r.last} of benchmark {r.bench_seed}: must lie in 0 to {scenes * each - 1}"
            )
        count, render = r.last // each + 1, partial(tell, f"rendering benchmark {r.bench_seed}")
        files += make_split(Benchmark(seed=r.bench_seed), "test", root, scenes=count, progress=render)[
            r.first // each :
        ]
    return load_frames(files)


def weight_on_zeros(instrument: CarNetInstrument, data: Frames) -> float:
    """The mean of `CarNetView.weight_on_zeros` over all cells with a car of all egos; each car counts once an ego."""
    grid = instrument.geometry, instrument.fused_cells

    def of_frame(f: int) -> NDArray[np.float64]:
        view, egos = instrument.look(data, f), range(data.est_pose.shape[1])
        return np.concatenate([view.weight_on_zeros(ego, cells_with_cars(data, f, ego, *grid)) for ego in egos])

    return float(np.concatenate([of_frame(f) for f in range(len(data))]).mean())


def cells_with_cars(data: Frames, f: int, ego: int, geometry: Geometry, n: int = CELLS) -> NDArray[np.int64]:
    """The cell (row by row, of n × n) of each car in an ego's square, [cars]."""
    cars, pose = truth(data, f, ego, geometry).table(), data.true_pose[f, ego]
    at = np.stack(to_local(cars[:, 0], cars[:, 1], pose))
    cell_m = 2 * geometry.half_extent_m / n
    row, column = np.clip((at + geometry.half_extent_m) // cell_m, 0, n - 1).astype(np.int64)
    out: NDArray[np.int64] = row * n + column
    return out
