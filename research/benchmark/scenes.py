"""Draw scene k of a split and the fleet's poses in each of its frames; nothing is rendered."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from research.benchmark.difficulty import DENSITIES, Difficulty, Range, Split
from sortie.perception.geometry import USUAL, Cameras
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Capture
from sortie.scenarios.formation import slots
from sortie.scenarios.schema import Scene, Target
from sortie.scenarios.streams import stream

DRONES = 5
AREA_M = 60.0
"""The fleet's centre lies within ± this of the scene's origin."""
SPLITS: dict[Split, int] = {"train": 1, "validation": 2, "tau": 3, "test": 4}
"""A number each, in the keys of the streams."""


def scene_id(seed: int, split: Split, index: int) -> int:
    """One number for a scene, different over benchmark seeds, splits and indices: its town's seed, and its label."""
    return (seed * len(SPLITS) + SPLITS[split] - 1) * 100_000 + index + 1_000_000


def draw_scene(seed: int, split: Split, index: int, difficulty: Difficulty) -> Scene:
    """The town, cars and light of scene `index`; its styles go round."""
    layout, cars = difficulty.layout(split), DENSITIES[difficulty.density]
    name = scene_id(seed, split, index)
    u = iter(stream(name, 0, (), "bench.scene").random(16).tolist())

    def within(span: Range) -> float:
        return float(span[0] + (span[1] - span[0]) * next(u))

    return Scene(
        seed=name,
        style=layout.styles[index % len(layout.styles)],
        block_m=within(layout.block_m),
        building_density=within(difficulty.building_density),
        building_height_m=within(difficulty.building_height_m),
        tree_density=within(difficulty.tree_density),
        parked_density=within(cars.parked_density),
        moving_cars_per_km=within(cars.moving_cars_per_km),
        moving_speed_mps=within(difficulty.moving_speed_mps),
        sun_azimuth_deg=within((0.0, 360.0)),
        sun_elevation_deg=within(difficulty.sun_elevation_deg),
        overcast=within(difficulty.overcast),
        brightness=within(difficulty.brightness),
    )


def model_of(config: Scene, target: Target | None = None) -> SceneModel:
    """The scene model of a drawn town, large enough for every fleet over it."""
    return SceneModel(config, target, (-AREA_M, -AREA_M, AREA_M, AREA_M))


def draw_captures(
    seed: int, split: Split, index: int, frame: int, difficulty: Difficulty, cameras: Cameras = USUAL
) -> list[Capture]:
    """Five drones in a jittered cross over the scene, any heading, with some attitude and pose error."""
    d = difficulty
    rng = stream(scene_id(seed, split, index), 0, frame, "bench.fleet")
    t_s = float(np.round(rng.uniform(0, 300), 3))
    centre = rng.uniform(-AREA_M, AREA_M, 2)
    heading, spacing, altitude = rng.uniform(-np.pi, np.pi), rng.uniform(*d.spacing_m), rng.uniform(*d.altitude_m)
    c, s = np.cos(heading), np.sin(heading)
    places = centre + slots("cross", DRONES, spacing) @ np.array([[c, s], [-s, c]])
    out = []
    for drone, slot in enumerate(places):
        x, y, z = np.array([*slot, altitude]) + d.slot_sigma_m * rng.normal(size=3)
        yaw = heading + np.radians(d.yaw_sigma_deg) * rng.normal()
        pitch, roll = np.radians(d.tilt_sigma_deg) * rng.normal(size=2)
        qx, qy, qz, qw = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat().tolist()
        ex, ey, ez = np.array([x, y, z]) + d.position_error_sigma_m * rng.normal(size=3)
        est_yaw = yaw + np.radians(d.heading_error_sigma_deg) * rng.normal()
        est = (float(ex), float(ey), float(ez))
        at = (float(x), float(y), float(z))
        out.append(Capture(drone, t_s, at, (qx, qy, qz, qw), est, float(est_yaw), cameras=cameras))
    return out
