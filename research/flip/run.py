"""Train the study's networks and measure them: resumable job by job, and within a job."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from research.benchmark.dataset import Benchmark, load_frames, make_split
from research.benchmark.difficulty import Density, Difficulty
from research.flip.measure import F1, StudyRow, optimal_f1, rows_of
from research.flip.networks import config_of
from research.flip.plan import MeasuredGrid, StudyPlan, Variant
from research.paper.instrument import CPU, CarNetInstrument
from research.paper.measures import under
from research.paper.ways import FULL_SHARING, SINGLE, CellsBy, Sharing, evaluate
from research.train.train import TrainResult, train
from sortie.perception.errors import InputError
from sortie.perception.evaluation.harness import FLOOR, Evaluation

log_to_nowhere = logging.getLogger("sortie.study")
Progress = Callable[[str, int, int], None]
SHIPPED = Path(__file__).parent / "weights"
"""Networks that come with the project, so that the study can be measured without training."""
DEFAULT_DENSITY: tuple[Density, ...] = ("default",)


def weights_of(job: str, *folders: Path) -> Path | None:
    """The job's weights in the first folder that has them."""
    return next((p for f in folders if (p := f / f"{job}.safetensors").is_file()), None)


def chosen(planned: Iterable[str], networks: Sequence[str] | None) -> Sequence[str]:
    """The networks that were asked for, all that are planned if None.

    Raises:
        InputError: one that is not in the plan.
    """
    planned = list(planned)
    for name in networks or ():
        if name not in planned:
            raise InputError(f"{name} is not in the plan, must be one of {', '.join(planned)}")
    return planned if networks is None else networks


def train_job(
    plan: StudyPlan,
    job: str,
    folder: Path,
    root: Path,
    *,
    shipped: Path | None = None,
    progress: Progress | None = None,
    log: logging.Logger = log_to_nowhere,
) -> TrainResult | None:
    """Train one network of the plan into `folder`, from its checkpoint if it has one; None if its weights are there.

    Raises:
        InputError: a job that is not in the plan, or one that begins from weights that are not there.
    """
    by_name = {v.job(s): (v, s) for v, s in plan.jobs()}
    variant, seed = by_name[chosen(by_name, [job])[0]]
    folders = [folder] if shipped is None else [folder, shipped]
    if weights_of(job, *folders) is not None:
        return None
    begins = variant.begins(seed)
    warm_start = weights_of(begins, *folders) if begins else None
    if begins and warm_start is None:
        raise InputError(f"{job} begins from {begins}, which has no weights in {folder}")
    log.info("training %s: %s", job, variant.reason)
    return train(
        folder / f"{job}.safetensors",
        variant.recipe_for(seed),
        config_of(variant.model),
        root=root,
        work=folder / job,
        warm_start=warm_start,
        progress=progress,
        log=log,
    )


def measure(
    plan: StudyPlan,
    folder: Path,
    root: Path,
    *,
    shipped: Path | None = None,
    frames: int = 80,
    networks: Sequence[str] | None = None,
    workers: int = 1,
    device: torch.device = CPU,
    progress: Progress | None = None,
) -> Iterator[tuple[str, list[StudyRow]]]:
    """Rows of every network that has weights, or of those in `networks`, one after the other; what has none gives no rows.

    Finished frames are kept in `folder`, so that a run that was cut off goes on where it was.

    Raises:
        InputError: a network that is not in the plan.
    """
    tell = progress or (lambda stage, done, of: None)
    folders = [folder] if shipped is None else [folder, shipped]
    wanted = chosen([variant.job(seed) for variant, seed in plan.jobs()], networks)
    for variant, seed in plan.jobs():
        job = variant.job(seed)
        weights = weights_of(job, *folders)
        if weights is None or job not in wanted:
            continue
        instrument = CarNetInstrument.load(weights, device)
        first = variant is plan.variants[0] and seed == variant.seeds[0]
        tau_f1 = _f1(instrument, root, folder, workers, partial(tell, f"{job}: tau split"))
        rows: list[StudyRow] = []
        for density in plan.measured.densities if first else DEFAULT_DENSITY:
            bench = Benchmark(difficulty=replace(Difficulty(), density=density))
            data = load_frames(make_split(bench, "test", root, scenes=frames))
            every = tuple(conditions(plan.measured, variant, density))
            found = evaluate(
                instrument,
                data,
                every,
                regions=("full",),
                store=folder / "frames",
                workers=workers,
                progress=partial(tell, f"{job}: {density}"),
            )
            rows += rows_of(plan.measured, variant, seed, density, found, tau_f1)
        yield job, rows


def conditions(measured: MeasuredGrid, variant: Variant, density: Density) -> Iterator[Sharing]:
    """Everything that is evaluated of a network; cells by norm only for variants from scratch at the default density."""
    yield from (SINGLE, FULL_SHARING)
    ranks: tuple[CellsBy, ...] = measured.cells_by
    if variant.begins_from or density != "default":
        ranks = ranks[:1]
    for unsent in measured.unsent:
        for cells_by in ranks:
            for c in measured.conditions():
                yield under(c, unsent, cells_by)


def _f1(
    instrument: CarNetInstrument, root: Path, folder: Path, workers: int, progress: Callable[[int, int], None]
) -> F1:
    """The F1-optimal threshold at full sharing on the tau split, whose scenes are in no other."""
    data = load_frames(make_split(Benchmark(), "tau", root))
    found: Evaluation = evaluate(
        instrument,
        data,
        (FULL_SHARING,),
        regions=("full",),
        store=folder / "frames",
        workers=workers,
        progress=progress,
    )
    return optimal_f1(found.matched(FULL_SHARING), np.arange(FLOOR, 0.9, 0.01))
