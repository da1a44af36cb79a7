"""The paper's Evaluation on the benchmark: every condition that a claim needs, evaluated once, and every claim judged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from research.benchmark.dataset import SIZES, Benchmark, Frames, load_frames, make_split
from research.benchmark.scenes import draw_captures, draw_scene, model_of, scene_id
from research.paper.claims import conditions
from research.paper.measures import under
from research.paper.results import TableResults, TableSettings
from research.paper.ways import evaluate
from sortie.perception.errors import InputError
from sortie.perception.evaluation.harness import FleetFrames, Instrument, Region
from sortie.perception.geometry import FULL, Geometry
from sortie.perception.scene.render import Renderer


def measure(
    instrument: Instrument,
    frames: FleetFrames,
    settings: TableSettings,
    *,
    store: Path | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> TableResults:
    """Evaluate what the claims need, all instruments over the same features.

    Args:
        instrument, frames: a model and what it looks at.
        store: a folder for finished frames; a later call with the same arguments goes on from there.
        workers: frames worked on side by side; the numbers do not depend on it.
        progress: called with frames done and frames in all.
    """
    every = dict.fromkeys(
        under(c, unsent, settings.cells_by, settings.ways) for unsent in settings.unsent for c in conditions()
    )
    regions: tuple[Region, ...] = ("full", "mission", "ego")
    found = evaluate(instrument, frames, tuple(every), regions=regions, store=store, workers=workers, progress=progress)
    return TableResults(found, settings)


def bench_frames(
    seed: int,
    count: int | None,
    root: Path,
    progress: Callable[[int, int], None] | None = None,
    geometry: Geometry = FULL,
) -> Frames:
    """The first `count` frames (None: all) of the benchmark's test split, each of a scene of its own; made where they are
    missing.

    Raises:
        InputError: more frames than the split has.
    """
    scenes, per_scene = SIZES["test"]
    if count is not None and not 1 <= count <= scenes * per_scene:
        raise InputError(f"frames is {count}, must be 1 to the test split's {scenes * per_scene}")
    return load_frames(make_split(Benchmark(seed, geometry=geometry), "test", root, scenes=count, progress=progress))


def camera_views(seed: int, frame: int, geometry: Geometry = FULL) -> NDArray[np.uint8]:
    """[drone, camera, height, width, 3]: what the drones' cameras see in a frame of the test split, rendered anew."""
    bench, name = Benchmark(seed), scene_id(seed, "test", frame)
    scene = model_of(draw_scene(seed, "test", frame, bench.difficulty))
    captures = draw_captures(seed, "test", frame, 0, bench.difficulty, geometry.cameras)
    views: NDArray[np.uint8] = Renderer(scene, name).render(captures)
    return views
