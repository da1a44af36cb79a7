"""What each parameter of the difficulty does to AP: one is moved at a time, the scenes stay as they are otherwise.

Scene k of every row has the same streams, so rows differ in the parameter alone and differences are paired by scene.
The scenes are a benchmark of their own (seed 7), so that nobody looks at the test split in passing.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from research.benchmark.dataset import FORMAT, Frames, start_worker
from research.benchmark.difficulty import Difficulty
from research.benchmark.scenes import draw_captures, draw_scene, model_of, scene_id
from research.paper.instrument import CarNetInstrument
from research.paper.ways import FULL_SHARING, SINGLE, Sharing, evaluate
from sortie.perception.code_digest import boxes_digest
from sortie.perception.metrics.ap import Matched
from sortie.perception.metrics.bootstrap import Difference, compare
from sortie.perception.network.bev import lift
from sortie.perception.scene.render import Renderer
from sortie.perception.scene.scene_model import SceneModel
from sortie.scenarios.replacing import replacing

SEED = 7
SCENES = 12
CONDITIONS: tuple[Sharing, ...] = (SINGLE, FULL_SHARING)


@dataclass(frozen=True, slots=True)
class ParameterShift:
    """One parameter moved."""

    parameter: str
    value: str
    difficulty: Difficulty


def _moved(name: str, value: Any) -> Difficulty:
    return replace(Difficulty(), **{name: value})


def moves() -> list[ParameterShift]:
    """The default first, then every parameter at the ends of its range, or well beyond for the errors and the fleet."""
    d = Difficulty()
    out = [
        ParameterShift("as it is", "", d),
        ParameterShift("density", "sparse", replace(d, density="sparse")),
        ParameterShift("density", "dense", replace(d, density="dense")),
        ParameterShift("unseen", "as seen in training", replace(d, unseen=d.seen)),
    ]
    for name, ends, unit in (
        ("building_density", d.building_density, ""),
        ("building_height_m", d.building_height_m, " m"),
        ("tree_density", d.tree_density, ""),
        ("sun_elevation_deg", d.sun_elevation_deg, "°"),
        ("overcast", d.overcast, ""),
        ("brightness", d.brightness, ""),
        ("spacing_m", (10.0, 40.0), " m"),
        ("altitude_m", (45.0, 80.0), " m"),
    ):
        out += [ParameterShift(name, f"{end:g}{unit}", _moved(name, (end, end))) for end in ends]
    for name, values, unit in (
        ("slot_sigma_m", (0.0, 3.0), " m"),
        ("yaw_sigma_deg", (0.0, 45.0), "°"),
        ("tilt_sigma_deg", (0.0, 10.0), "°"),
        ("position_error_sigma_m", (0.0, 0.5), " m"),
        ("heading_error_sigma_deg", (0.0, 1.0), "°"),
    ):
        out += [ParameterShift(name, f"{value:g}{unit}", _moved(name, value)) for value in values]
    return out


@dataclass(frozen=True, slots=True)
class Effect:
    """What a move did."""

    move: ParameterShift
    gain: Difference
    """AP alone (a) and with all five sharing all (b)."""
    change: Difference | None
    """AP under full sharing: as it is (a), moved (b); None for the first row."""


def measure(
    weights: Path,
    store: Path,
    *,
    scenes: int = SCENES,
    workers: int | None = None,
    rows: Sequence[ParameterShift] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Effect]:
    """Render and evaluate every move on the same scenes; finished scenes are kept in `store`, a later call goes on.

    Args: `rows`, the moves, the first of which the others are compared with; all by default.

    About 45 CPU seconds a scene.

    Raises:
        InputError: weights that are missing or do not fit.
    """
    rows = moves() if rows is None else rows
    setup = {"code": boxes_digest(), "format": FORMAT, "seed": SEED, "moves": [asdict(m) for m in rows]}
    mark = CarNetInstrument.load(weights).fingerprint + json.dumps(setup, sort_keys=True)
    folder = store / hashlib.blake2b(mark.encode(), digest_size=6).hexdigest()
    paths = [folder / f"scene_{k}.npz" for k in range(scenes)]
    todo = [k for k, path in enumerate(paths) if not path.exists()]
    if todo:
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(workers or os.cpu_count(), mp_context=context, initializer=start_worker)
        try:
            jobs = [pool.submit(evaluate_scene, weights, k, rows, paths[k]) for k in todo]
            for done, job in enumerate(as_completed(jobs), 1):
                job.result()
                if progress is not None:
                    progress(done, len(jobs))
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
    kept = [_read(path, len(rows)) for path in paths]
    units = [[[m for scene in kept for m in scene[r][c]] for c in range(len(CONDITIONS))] for r in range(len(rows))]
    label = np.repeat(np.arange(scenes), len(kept[0][0][0]))
    return [
        Effect(move, compare(alone, shared, label), compare(units[0][1], shared, label) if r else None)
        for r, (move, (alone, shared)) in enumerate(zip(rows, units, strict=True))
    ]


def evaluate_scene(weights: Path, index: int, rows: Sequence[ParameterShift], path: Path) -> None:
    """One scene under every move, one frame each; towns that moves share are drawn once."""
    instrument = CarNetInstrument.load(weights)
    towns: dict[str, SceneModel] = {}
    renderers: dict[str, Renderer] = {}
    arrays: dict[str, Any] = {}
    with torch.inference_mode():
        for r, move in enumerate(rows):
            config = draw_scene(SEED, "test", index, move.difficulty)
            key = config.model_dump_json()
            if key not in towns:
                towns[key] = model_of(config)
                renderers[key] = Renderer(towns[key], scene_id(SEED, "test", index))
            captures = draw_captures(SEED, "test", index, 0, move.difficulty, instrument.geometry.cameras)
            frames = Frames(
                images=lift(renderers[key].render(captures), captures, instrument.geometry).numpy()[None],
                true_pose=np.array([[c.true_pose for c in captures]]),
                est_pose=np.array([[c.est_pose for c in captures]]),
                cars=towns[key].cars_at(captures[0].t_s).table()[None],
                scene=np.array([index]),
            )
            result = evaluate(instrument, frames, CONDITIONS, regions=("full",))
            for c, condition in enumerate(CONDITIONS):
                for e, unit in enumerate(result.matched(condition)):
                    arrays |= {f"{r}.{c}.{e}.{f}": getattr(unit, f) for f in Matched.__slots__}
    with replacing(path) as part, part.open("wb") as file:
        np.savez(file, **arrays)


def _read(path: Path, rows: int) -> list[list[list[Matched]]]:
    """[rows][conditions][egos]"""
    with np.load(path, allow_pickle=False) as file:
        egos = sum(name.startswith("0.0.") and name.endswith(".truths") for name in file.files)

        def unit(key: str) -> Matched:
            return Matched(file[f"{key}.score"], file[f"{key}.hit"], int(file[f"{key}.truths"]))

        return [[[unit(f"{r}.{c}.{e}") for e in range(egos)] for c in range(len(CONDITIONS))] for r in range(rows)]
