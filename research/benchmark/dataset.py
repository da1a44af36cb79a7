"""Splits on disk: one npz file a scene, made in parallel, kept where they exist, and listed in the manifest with their hashes."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from research.benchmark import manifest
from research.benchmark.difficulty import Difficulty, Layout, Split
from research.benchmark.manifest import COLUMNS, BenchmarkError
from research.benchmark.scenes import DRONES, draw_captures, draw_scene, model_of, scene_id
from sortie.perception.errors import InputError
from sortie.perception.geometry import FULL, Geometry
from sortie.perception.network.bev import lift
from sortie.perception.scene.render import Renderer
from sortie.scenarios.replacing import replacing

FORMAT = 1
"""Of the files; a change of what a scene looks like raises it, so that old files are not taken for new ones."""
SIZES: dict[Split, tuple[int, int]] = {"train": (100, 12), "validation": (12, 6), "tau": (40, 1), "test": (240, 1)}
"""Scenes and frames a scene. The test split has a scene for every frame, as UAV3D's mini-validation."""
MOST: dict[Split, int] = {split: scenes for split, (scenes, _) in SIZES.items()} | {"train": 10_000}
"""Scenes that there are of a split: more may be learned from than the usual ones."""


@dataclass(frozen=True, slots=True)
class Frames:
    """n fleet-frames: `images` uint8 [n, 5, 4, px, px]; `true_pose`, `est_pose` [n, 5, 3] (x, y, yaw, ENU);
    `cars` [n, m, 5] (x, y, length, width, yaw; NaN-padded); `scene` [n] the scene's label."""

    images: NDArray[np.uint8]
    true_pose: NDArray[np.float64]
    est_pose: NDArray[np.float64]
    cars: NDArray[np.float64]
    scene: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.images)


@dataclass(frozen=True, slots=True)
class Benchmark:
    """Which benchmark: everything that its files follow from."""

    seed: int = 0
    difficulty: Difficulty = Difficulty()  # noqa: RUF009 (frozen)
    geometry: Geometry = FULL

    def parameters(self) -> dict[str, Any]:
        """All of it, as the manifest has it; the usual image goes without saying, as before there was another one."""
        every = asdict(self)
        if self.geometry.image_px == FULL.image_px:
            del every["geometry"]["image_px"]
        return every

    def key(self) -> str:
        """A short hash of all of it and of the files' format: what names the folder."""
        text = json.dumps({"format": FORMAT, **self.parameters()}, sort_keys=True)
        return hashlib.blake2b(text.encode(), digest_size=6).hexdigest()

    @classmethod
    def at(cls, folder: Path) -> Benchmark:
        """The one whose manifest lies in `folder`.

        Raises:
            BenchmarkError: no manifest, or one of another format or with other parameters than this version knows.
        """
        data, path = manifest.read(folder), folder / manifest.MANIFEST
        if data["format"] != FORMAT:
            raise BenchmarkError(f"{path}: format is {data['format']}, must be {FORMAT}: make it anew")
        try:
            stored = data["benchmark"]
            known = {f.name for f in fields(Difficulty)}
            if set(stored["difficulty"]) != known:
                raise InputError(f"difficulty has {sorted(set(stored['difficulty']) ^ known)} too many or too few")
            bench = cls(stored["seed"], _difficulty(stored["difficulty"]), Geometry(**stored["geometry"]))
        except (KeyError, TypeError, ValueError) as error:
            raise BenchmarkError(f"{path}: cannot be understood: {error}") from error
        if bench.key() != data["key"]:
            raise BenchmarkError(f"{path}: key is {data['key']}, must be {bench.key()}: its parameters were changed")
        return bench

    def folder(self, root: Path) -> Path:
        """Where its splits lie under `root`."""
        image = "" if self.geometry.image_px == FULL.image_px else f"-{self.geometry.image_px}px"
        return root / f"seed{self.seed}-{self.difficulty.density}-{self.geometry.half_extent_m:g}m{image}-{self.key()}"


def _difficulty(stored: dict[str, Any]) -> Difficulty:
    """From JSON, which knows lists but no tuples."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return Layout(**{k: plain(v) for k, v in value.items()})
        return tuple(value) if isinstance(value, list) else value

    return Difficulty(**{k: plain(v) for k, v in stored.items()})


def make_scene_file(bench: Benchmark, split: Split, index: int, frames: int, path: Path) -> Path:
    """Render `frames` frames of a split's scene into one file, unless it is there already."""
    if path.exists():
        return path
    name = scene_id(bench.seed, split, index)
    config = draw_scene(bench.seed, split, index, bench.difficulty)
    scene = model_of(config)
    renderer = Renderer(scene, name)
    px = bench.geometry.image_px
    images = np.empty((frames, DRONES, 4, px, px), np.uint8)
    true_pose, est_pose = np.empty((frames, DRONES, 3)), np.empty((frames, DRONES, 3))
    cars = []
    for f in range(frames):
        captures = draw_captures(bench.seed, split, index, f, bench.difficulty, bench.geometry.cameras)
        images[f] = lift(renderer.render(captures), captures, bench.geometry).numpy()
        true_pose[f] = [c.true_pose for c in captures]
        est_pose[f] = [c.est_pose for c in captures]
        cars.append(scene.cars_at(captures[0].t_s).table())
    table = np.full((frames, max(len(c) for c in cars), 5), np.nan)
    for row, c in zip(table, cars, strict=True):
        row[: len(c)] = c
    with replacing(path) as part, part.open("wb") as file:
        np.savez(file, images=images, true_pose=true_pose, est_pose=est_pose, cars=table)
    return path


def _make(bench: Benchmark, split: Split, index: int, frames: int, path: Path) -> tuple[str, dict[str, Any]]:
    """The scene's file, and what the manifest says of it."""
    make_scene_file(bench, split, index, frames, path)
    config = draw_scene(bench.seed, split, index, bench.difficulty).model_dump()
    return path.name, {
        "index": index,
        "frames": frames,
        "sha256": manifest.content_hash(path),
        "scene": config,
    }


def start_worker() -> None:
    """For a worker process: one thread each, as there are as many workers as cores."""
    torch.set_num_threads(1)


def make_split(
    bench: Benchmark,
    split: Split,
    root: Path,
    *,
    scenes: int | range | None = None,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """The files of a split, made in parallel where they are missing; a run that was cut off goes on where it was.

    Args:
        root: folder of benchmarks; this one's own lies under it (`Benchmark.folder`), its manifest beside the splits.
        scenes: only the first so many, or those of a range.
        workers: processes; left out, one a core.
        progress: called with scenes done and scenes to make.

    Raises:
        InputError: scenes that the split does not have, or none.
        BenchmarkError: a file on disk is broken, or a worker was killed.
    """
    count, frames = SIZES[split]
    which = scenes if isinstance(scenes, range) else range(count if scenes is None else scenes)
    if not which or which[0] < 0 or which[-1] >= MOST[split]:
        raise InputError(f"scenes is {scenes}, must be 1 to the {MOST[split]} of the {split} split")
    folder = bench.folder(root)
    paths = {k: folder / split / f"scene_{scene_id(bench.seed, split, k)}_{frames}.npz" for k in which}
    known = manifest.listed(folder, split)
    todo = [k for k, path in paths.items() if not path.exists() or path.name not in known]
    if todo:
        entries: list[tuple[str, dict[str, Any]]] = []
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(workers or os.cpu_count(), mp_context=context, initializer=start_worker)
        try:
            jobs = [pool.submit(_make, bench, split, k, frames, paths[k]) for k in todo]
            for done, job in enumerate(as_completed(jobs), 1):
                entries.append(job.result())
                if progress is not None:
                    progress(done, len(jobs))
        except BrokenProcessPool as error:
            raise BenchmarkError(f"{folder}: a worker was killed; what is finished is kept, run it again") from error
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            if entries:
                header = {"format": FORMAT, "key": bench.key(), "benchmark": bench.parameters()}
                manifest.add(folder, header, split, entries)
    return list(paths.values())


def load_frames(paths: Sequence[Path]) -> Frames:
    """All frames of the files, in order, in memory (1.3 MB a fleet-frame, 5.2 MB of sharp images; twice that while they are put together).

    Raises:
        InputError: no files.
        BenchmarkError: a file cannot be read.
    """
    if not paths:
        raise InputError("load_frames needs at least one file")
    parts = [manifest.read_arrays(path) for path in paths]
    most = max(p["cars"].shape[1] for p in parts)
    for p in parts:
        p["cars"] = np.pad(p["cars"], ((0, 0), (0, most - p["cars"].shape[1]), (0, 0)), constant_values=np.nan)
    columns = {k: np.concatenate([p[k] for p in parts]) for k in COLUMNS}
    scene = np.repeat([int(p.stem.split("_")[1]) for p in paths], [len(p["images"]) for p in parts])
    return Frames(columns["images"], columns["true_pose"], columns["est_pose"], columns["cars"], scene)
