"""Scenes and captures that the perception tests share."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture
from sortie.scenarios.schema import Scene, Target

EMPTY = Scene(building_density=0, tree_density=0, parked_density=0, moving_cars_per_km=0)
"""Roads and grass alone."""


def only_target(x_m: float, y_m: float, scene: Scene = EMPTY) -> SceneModel:
    """A town without cars but for the red target, which stands still."""
    return SceneModel(scene, Target(waypoints_m=((x_m, y_m),)), (-50.0, -50.0, 50.0, 50.0))


def capture(
    x_m: float = 0.0,
    y_m: float = 0.0,
    z_m: float = 60.0,
    yaw: float = 0.0,
    pitch: float = 0.0,
    roll: float = 0.0,
    *,
    drone: int = 0,
    t_s: float = 5.0,
    est: tuple[float, float, float, float] | None = None,
) -> Capture:
    """By Euler angles (rad; intrinsic yaw, pitch, roll of FLU in ENU); `est` is x, y, z, yaw, by default the truth."""
    q = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat()
    ex, ey, ez, eyaw = est or (x_m, y_m, z_m, yaw)
    return Capture(drone, t_s, (x_m, y_m, z_m), (q[0], q[1], q[2], q[3]), (ex, ey, ez), eyaw)


def cross(x_m: float, y_m: float, yaw: float, t_s: float = 5.0) -> list[Capture]:
    """Five drones in a cross, 20 m apart, at 60 m, with the truth as their estimate."""
    slots = ((0, 0), (20, 0), (0, 20), (-20, 0), (0, -20))
    return [capture(x_m + dx, y_m + dy, yaw=yaw, drone=i, t_s=t_s) for i, (dx, dy) in enumerate(slots)]


def boxes_at(*rows: tuple[float, ...]) -> Boxes:
    """Cars of 4.5 m × 1.9 m by x, y, score and, if it is not east, heading."""
    table = np.array([(x, y, 4.5, 1.9, yaw[0] if yaw else 0.0, score) for x, y, score, *yaw in rows])
    return Boxes.placed(table.reshape(-1, 6), (0.0, 0.0, 0.0))


def same(a: Boxes, b: Boxes) -> bool:
    """Whether two lists of boxes are equal to the bit."""
    return len(a) == len(b) and all(np.array_equal(getattr(a, f), getattr(b, f)) for f in Boxes.__slots__)
