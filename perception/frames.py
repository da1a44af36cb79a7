"""Labelled frames for training and validation: five drones over a town of their own, rendered once and kept on disk.

One file a scene (`scene_<seed>.npz`, no pickles). Training and validation scenes have other seeds than each
other, drawn far from the small numbers that people write into scenarios.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from perception.bev import lift
from perception.geometry import IMAGE_PX as BEV_PX
from perception.render import Renderer
from perception.scene import SceneModel
from perception.types import Capture
from scenarios.schema import Scene
from scenarios.streams import stream

DRONES = 5
TRAIN_SEED, VALIDATION_SEED = 1_000_000, 2_000_000
PER_SCENE = 12
"""Training frames from each town."""
AREA_M = 60.0
POSE_ERROR_M, HEADING_ERROR_DEG = 0.2, 0.5
"""As the schema's defaults of fleet.motion."""
_CROSS = np.array([(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1)], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Frames:
    """n fleet-frames: `images` uint8 [n, 5, 4, 256, 256]; `true_pose`, `est_pose` [n, 5, 3] (x, y, yaw, ENU);
    `cars` [n, m, 5] (x, y, length, width, yaw; NaN-padded); `scene` [n] the scene's seed."""

    images: NDArray[np.uint8]
    true_pose: NDArray[np.float64]
    est_pose: NDArray[np.float64]
    cars: NDArray[np.float64]
    scene: NDArray[np.int64]


def random_scene(seed: int) -> Scene:
    """A town with random knobs around the schema's defaults."""
    u = stream(seed, 0, (), "train.scene").random(7)
    return Scene(
        seed=seed,
        block_m=60 + 45 * u[0],
        building_density=0.3 + 0.5 * u[1],
        building_height_m=6 + 8 * u[2],
        tree_density=0.3 + 0.4 * u[3],
        parked_density=0.2 + 0.4 * u[4],
        moving_cars_per_km=6 + 10 * u[5],
        moving_speed_mps=4 + 8 * u[6],
    )


def random_captures(seed: int, frame: int) -> list[Capture]:
    """A jittered cross of five drones about 20 m apart and 60 m up, with some attitude and pose error."""
    rng = stream(seed, 0, frame, "train.fleet")
    t_s = float(np.round(rng.uniform(0, 300), 3))
    centre = rng.uniform(-AREA_M, AREA_M, 2)
    heading, spacing, altitude = rng.uniform(-np.pi, np.pi), rng.uniform(14, 28), rng.uniform(54, 66)
    c, s = np.cos(heading), np.sin(heading)
    slots = centre + spacing * _CROSS @ np.array([[c, s], [-s, c]])
    out = []
    for drone, slot in enumerate(slots):
        x, y = slot + rng.normal(0, 0.6, 2)
        z, yaw = altitude + rng.normal(0, 0.6), heading + rng.normal(0, np.radians(1.5))
        roll, pitch = rng.normal(0, np.radians(4.0), 2)
        quaternion = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat()
        ex, ey, ez = rng.normal(0, POSE_ERROR_M, 3)
        est_yaw = yaw + rng.normal(0, np.radians(HEADING_ERROR_DEG))
        q = (float(quaternion[0]), float(quaternion[1]), float(quaternion[2]), float(quaternion[3]))
        out.append(
            Capture(
                drone,
                t_s,
                (float(x), float(y), float(z)),
                q,
                (float(x + ex), float(y + ey), float(z + ez)),
                float(est_yaw),
            )
        )
    return out


def make_scene_file(seed: int, count: int, path: Path) -> Path:
    """Render `count` frames of scene `seed` into one file, unless it is there already."""
    if path.exists():
        return path
    scene = SceneModel(random_scene(seed), None, (-AREA_M, -AREA_M, AREA_M, AREA_M))
    renderer = Renderer(scene, seed)
    images = np.empty((count, DRONES, 4, BEV_PX, BEV_PX), np.uint8)
    true_pose, est_pose = np.empty((count, DRONES, 3)), np.empty((count, DRONES, 3))
    cars = []
    for f in range(count):
        captures = random_captures(seed, f)
        images[f] = lift(renderer.render(captures), captures).numpy()
        true_pose[f] = [(*c.position_m[:2], c.true_yaw_rad) for c in captures]
        est_pose[f] = [(*c.est_position_m[:2], c.est_yaw_rad) for c in captures]
        at = scene.cars_at(captures[0].t_s)
        cars.append(np.stack([at.x_m, at.y_m, at.length_m, at.width_m, at.yaw_rad], axis=1))
    table = np.full((count, max(len(c) for c in cars), 5), np.nan)
    for row, c in zip(table, cars, strict=True):
        row[: len(c)] = c
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.stem}.{os.getpid()}.part.npz")
    np.savez(part, images=images, true_pose=true_pose, est_pose=est_pose, cars=table)
    part.replace(path)
    return path


def _start_worker() -> None:
    torch.set_num_threads(1)


def make_frames(
    folder: Path,
    first_seed: int,
    scenes: int,
    per_scene: int,
    progress: Callable[[int, int], None] | None = None,
    workers: int | None = None,
) -> list[Path]:
    """Files of `scenes` scenes with `per_scene` frames each, made in parallel; those that exist are kept."""
    seeds = [first_seed + k for k in range(scenes)]
    paths = [folder / f"scene_{seed}_{per_scene}.npz" for seed in seeds]
    todo = [(s, p) for s, p in zip(seeds, paths, strict=True) if not p.exists()]
    if todo:
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers or os.cpu_count(), mp_context=context, initializer=_start_worker) as pool:
            jobs = [pool.submit(make_scene_file, s, per_scene, p) for s, p in todo]
            for done, job in enumerate(as_completed(jobs), 1):
                job.result()
                if progress is not None:
                    progress(done, len(jobs))
    return paths


def load_frames(paths: Sequence[Path]) -> Frames:
    """All frames of the files, in order, in memory (1.3 MB a fleet-frame)."""
    if not paths:
        raise ValueError("load_frames needs at least one file")
    parts = []
    for path in paths:
        with np.load(path, allow_pickle=False) as file:
            parts.append({k: file[k] for k in ("images", "true_pose", "est_pose", "cars")})
    most = max(p["cars"].shape[1] for p in parts)
    for p in parts:
        p["cars"] = np.pad(p["cars"], ((0, 0), (0, most - p["cars"].shape[1]), (0, 0)), constant_values=np.nan)
    columns = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
    scene = np.repeat([int(p.stem.split("_")[1]) for p in paths], [len(p["images"]) for p in parts])
    return Frames(columns["images"], columns["true_pose"], columns["est_pose"], columns["cars"], scene)
