"""Recordings that tests of several rooms use: what a made model sees of a scenario's flight, and small ones out of nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sortie.fleet.flight.motion import fly
from sortie.perception.recordings.exchange import moved
from sortie.perception.recordings.writing import write_recording
from sortie.perception.scene.scene_model import SceneModel
from sortie.scenarios.schema import Scenario

REACH_M = 45.0


def record_flight(scenario: Scenario, path: Path, *, lower: float = 0.0, features: bool = True, every: int = 1) -> Path:
    """A model that finds every car within 45 m, better the nearer, recorded along the scenario's own flight.

    Features: channel 0 holds the score of the car centred in a cell, the others nothing. `every`: of so many frames
    one is recorded.
    """
    motion = fly(scenario.fleet, scenario.duration_s, scenario.frame_s, scenario.seed)
    scene = SceneModel(scenario.perception.scene, scenario.mission.target, motion.bounds_m())
    pose = np.concatenate([motion.position_m[..., :2], motion.yaw_rad[..., None]], axis=-1)
    est = np.concatenate([motion.est_position_m[..., :2], motion.est_yaw_rad[..., None]], axis=-1)
    pose, est, times_s = pose[::every], est[::every], motion.time_s[::every]
    boxes, truth = [], []
    for f, t_s in enumerate(times_s):
        cars = scene.cars_at(float(t_s))
        table = np.stack([cars.x_m, cars.y_m, cars.length_m, cars.width_m, cars.yaw_rad, np.ones(len(cars))], axis=1)
        truth.append(table[:, :5])
        seen = []
        for own in pose[f]:
            local = moved(table, (0.0, 0.0, 0.0), own)
            away = np.hypot(*local[:, :2].T)
            local[:, 5] = np.clip(0.95 - away / 100 - lower, 0, 1)
            seen.append(local[away < REACH_M])
        boxes.append(seen)
    maps = [np.stack([score_map(b) for b in frame]) for frame in boxes] if features else None
    return write_recording(
        path, t_s=times_s, pose=pose, est_pose=est, boxes=boxes, truth=truth, cell_m=3.2, features=maps
    )


def score_map(boxes: np.ndarray, channels: int = 80) -> np.ndarray:
    """[C, 64, 64]: channel 0 the highest score of the boxes centred in a cell of 3.2 m."""
    out = np.zeros((channels, 64, 64), np.float16)
    row, column = np.floor((boxes[:, :2] + 102.4) / 3.2).astype(int).T
    np.maximum.at(out[0], (row, column), boxes[:, 5].astype(np.float16))
    return out


def small(path: Path, **changes: Any) -> Path:
    """Two frames of two drones 10 m apart, headings alike; a car 8 m ahead of drone 0, one 20 m to the left of drone 1."""
    pose = np.array([[(0, 0, 0), (10, 0, 0)], [(1, 0, 0), (11, 0, 0)]], float)
    cars = np.array([(8, 0, 4.5, 1.9, 0.1), (10, 20, 4.5, 1.9, 0.2)])
    boxes = []
    for frame in pose:
        rows = [np.append(cars[k] - [*frame[k, :2], 0, 0, 0], 0.9 - 0.1 * k)[None] for k in range(2)]
        boxes.append(rows)
    arrays: dict[str, Any] = dict(
        t_s=[0.0, 0.1], pose=pose, boxes=boxes, truth=[cars, cars], cell_m=3.2,
        features=[np.stack([score_map(b, 3) for b in frame]) for frame in boxes],
    )  # fmt: skip
    return write_recording(path, **(arrays | changes))
