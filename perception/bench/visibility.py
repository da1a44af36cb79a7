"""Who can see which car, by geometry: straight lines from a drone to points on roofs, past houses, trees and other cars.

The renderer walks rays down from the cameras; this walks up from the cars, apart from it. It says how hard a frame
is before any network looks: a car that no drone sees is still asked for by AP.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from perception.render import AXES, HALF_H, HALF_V, MAX_REACH_M, REACH, Window, rotation
from perception.scene import SceneModel
from perception.town import RES_M, TILE_M, Floats
from perception.traffic import Cars
from perception.types import Capture

_ROOF = np.array([(0.0, 0.0), (0.3, 0.3), (0.3, -0.3), (-0.3, 0.3), (-0.3, -0.3)])
"""Points on a roof, as parts of its length and width."""
_STEP_M = 0.2
SEEN = 0.4
"""A car counts as seen from here on: two of its five points."""


def window_over(scene: SceneModel, captures: Sequence[Capture]) -> Window:
    """The scenery and parked cars under a fleet, as far as its cameras reach."""
    where = np.array([c.position_m for c in captures])
    reach = np.minimum(where[:, 2] * REACH, MAX_REACH_M) + 1.0
    low, high = (where[:, :2] - reach[:, None]).min(axis=0), (where[:, :2] + reach[:, None]).max(axis=0)
    ix, iy = (range(int(np.floor(low[a] / TILE_M)), int(np.floor(high[a] / TILE_M)) + 1) for a in (0, 1))
    return Window(scene, ix, iy)


def visible(window: Window, capture: Capture, cars: Cars) -> Floats:
    """[n] part of each car's roof, 0 … 1, that one drone's cameras see: in a camera's field, and nothing in between.

    Moving cars hide nothing here.
    """
    eye = np.asarray(capture.position_m)
    along = _ROOF[None, :, 0] * cars.length_m[:, None]
    across = _ROOF[None, :, 1] * cars.width_m[:, None]
    cos, sin = np.cos(cars.yaw_rad)[:, None], np.sin(cars.yaw_rad)[:, None]
    x = cars.x_m[:, None] + cos * along - sin * across
    y = cars.y_m[:, None] + sin * along + cos * across
    z = np.broadcast_to(cars.height_m[:, None], x.shape)
    at = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    free = in_a_camera(capture, at)
    rows, columns = window.height.shape
    for top in np.arange(_STEP_M, window.top_m, _STEP_M):
        height = at[:, 2] + top
        part = top / (eye[2] - at[:, 2])
        px = (at[:, 0] + part * (eye[0] - at[:, 0]) - window.x0_m) / RES_M
        py = (at[:, 1] + part * (eye[1] - at[:, 1]) - window.y0_m) / RES_M
        column = np.clip(px.astype(int), 0, columns - 1)
        row = np.clip(py.astype(int), 0, rows - 1)
        free &= window.height[row, column] <= height
    out: Floats = free.reshape(-1, len(_ROOF)).mean(axis=1)
    return out


def in_a_camera(capture: Capture, points: Floats) -> NDArray[np.bool_]:
    """[n]: whether each world point [n, 3] is in the field of one of the drone's five cameras."""
    body = (points - np.asarray(capture.position_m)) @ rotation(capture.orientation_xyzw)
    seen = np.zeros(len(points), bool)
    for axes in AXES:
        right, down, ahead = (body @ axes.T).T
        seen |= (ahead > 0) & (np.abs(right) < HALF_H * ahead) & (np.abs(down) < HALF_V * ahead)
    return seen


def inside(capture: Capture, cars: Cars, half_extent_m: float) -> NDArray[np.bool_]:
    """[n]: whether each car's centre is in the drone's true square, which is where AP asks for cars."""
    dx, dy = cars.x_m - capture.position_m[0], cars.y_m - capture.position_m[1]
    c, s = np.cos(capture.true_yaw_rad), np.sin(capture.true_yaw_rad)
    ahead, left = c * dx + s * dy, c * dy - s * dx
    near: NDArray[np.bool_] = (np.abs(ahead) <= half_extent_m) & (np.abs(left) <= half_extent_m)
    return near
