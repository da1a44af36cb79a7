"""Who can see which car, by geometry: straight lines from a drone to points on roofs, past houses and trees.

Houses are boxes and crowns are domes, in closed form: nothing is rasterised, and no code is shared with the renderer
but the cameras' axes. It measures how hard a frame is without any network. A car that no drone sees still counts for AP.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sortie.perception.geometry import HALF_H, HALF_V, in_square
from sortie.perception.scene.render import AXES, rotation
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.town import Floats
from sortie.perception.scene.traffic import Cars
from sortie.perception.types import Capture

_ROOF = np.array([(0.0, 0.0), (0.3, 0.3), (0.3, -0.3), (-0.3, 0.3), (-0.3, -0.3)])
"""Points on a roof, as parts of its length and width."""
SEEN = 0.4
"""A car counts as seen from here on: two of its five points."""
DOME = 0.35
"""How much lower a crown is at its rim, as a part of its height (`town.Town`)."""


def visible(scene: SceneModel, capture: Capture, cars: Cars) -> Floats:
    """[n] part of each car's roof, 0 … 1, that one drone's cameras see: in a camera's field, and nothing in between.

    Cars hide nothing here.
    """
    if not len(cars):
        return np.zeros(0)
    along = _ROOF[None, :, 0] * cars.length_m[:, None]
    across = _ROOF[None, :, 1] * cars.width_m[:, None]
    cos, sin = np.cos(cars.yaw_rad)[:, None], np.sin(cars.yaw_rad)[:, None]
    x = cars.x_m[:, None] + cos * along - sin * across
    y = cars.y_m[:, None] + sin * along + cos * across
    z = np.broadcast_to(cars.height_m[:, None], x.shape)
    at = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    free = in_a_camera(capture, at)
    eye = np.asarray(capture.position_m)
    who = np.flatnonzero(free)
    if len(who):
        low, high = np.minimum(at[who].min(axis=0), eye) - 4.0, np.maximum(at[who].max(axis=0), eye) + 4.0
        blocks = scene.town.blocks(low[0], low[1], high[0], high[1])
        houses = np.concatenate([b.buildings for b in blocks])
        trees = np.concatenate([b.trees for b in blocks])
        free[who] = ~(past_houses(at[who], eye, houses) | past_trees(at[who], eye, trees))
    out: Floats = free.reshape(-1, len(_ROOF)).mean(axis=1)
    return out


def past_houses(at: Floats, eye: Floats, houses: Floats) -> NDArray[np.bool_]:
    """[n]: whether the line from each point [n, 3] to the eye [3] meets a house [m, 6] (`town.Block.buildings`).

    By slabs: the parts of the line over the house in x, in y and below its roof have to overlap.
    """
    step = eye - at
    with np.errstate(divide="ignore", invalid="ignore"):
        enter, leave = np.zeros((len(at), len(houses))), np.ones((len(at), len(houses)))
        for axis in (0, 1):
            a = (houses[None, :, axis] - at[:, None, axis]) / step[:, None, axis]
            b = (houses[None, :, axis + 2] - at[:, None, axis]) / step[:, None, axis]
            enter, leave = np.maximum(enter, np.minimum(a, b)), np.minimum(leave, np.maximum(a, b))
        leave = np.minimum(leave, (houses[None, :, 4] - at[:, None, 2]) / step[:, None, 2])
    return np.asarray((enter < leave).any(axis=1))


def past_trees(at: Floats, eye: Floats, trees: Floats) -> NDArray[np.bool_]:
    """[n]: the same of trees [m, 5] (`town.Block.trees`), solid below a paraboloid that is highest in the middle."""
    step = eye - at
    dx, dy = at[:, None, 0] - trees[None, :, 0], at[:, None, 1] - trees[None, :, 1]
    sx, sy, rise = step[:, None, 0], step[:, None, 1], step[:, None, 2]
    radius, top = trees[None, :, 2], trees[None, :, 3]
    # distance² from the trunk is a t² + 2 b t + c along the line, t from 0 at the point to 1 at the eye
    a, b, c = np.maximum(sx * sx + sy * sy, 1e-9), dx * sx + dy * sy, dx * dx + dy * dy
    root = b * b - a * (c - radius**2)
    half = np.sqrt(np.maximum(root, 0.0))
    first, last = np.clip((-b - half) / a, 0.0, 1.0), np.clip((-b + half) / a, 0.0, 1.0)
    # height above the crown is a parabola in t; its lowest part over the crown decides
    bend = DOME * top / radius**2
    t = np.clip(-(bend * 2 * b + rise) / (2 * bend * a), first, last)
    above = at[:, None, 2] + rise * t - top + bend * (a * t * t + 2 * b * t + c)
    return np.asarray(((root > 0) & (first < last) & (above < 0)).any(axis=1))


def in_a_camera(capture: Capture, points: Floats) -> NDArray[np.bool_]:
    """[n]: whether each world point [n, 3] is in the field of one of the drone's five cameras."""
    body = (points - np.asarray(capture.position_m)) @ rotation(capture.orientation_xyzw)
    seen = np.zeros(len(points), bool)
    for axes in AXES:
        right, down, ahead = (body @ axes.T).T
        seen |= (ahead > 0) & (np.abs(right) < HALF_H * ahead) & (np.abs(down) < HALF_V * ahead)
    return seen


def inside(capture: Capture, cars: Cars, half_extent_m: float) -> NDArray[np.bool_]:
    """[n]: whether each car's centre is in the drone's true square, the cars that AP counts."""
    return in_square(cars.table()[:, :2], [capture.true_pose], half_extent_m)[:, 0]
