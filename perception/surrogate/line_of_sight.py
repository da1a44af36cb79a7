"""Lines of sight over the town: a coarse height field, and who sees over it. Free of torch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.town import Floats, shadow_m

RES_M = 0.8
STEP_M = 1.0
"""Heights between which a ray is not looked at."""
CAR_TOP_M = 1.2
"""What of a car has to be seen over a roof or a hedge."""
NEAR_M = 8.0
_RAYS = 16384


class HeightField:
    """Roofs and crowns of the town inside a scene's rectangle, on a 0.8 m raster; beyond it the land is flat."""

    def __init__(self, scene: SceneModel) -> None:
        x0, y0, x1, y1 = scene.rect
        self.x0_m, self.y0_m = x0, y0
        self.columns, self.rows = int(np.ceil((x1 - x0) / RES_M)) + 2, int(np.ceil((y1 - y0) / RES_M)) + 2
        height = np.zeros((self.rows, self.columns), np.float32)
        blocks = scene.town.blocks(x0, y0, x1, y1)
        buildings = np.concatenate([b.buildings for b in blocks])
        at = np.rint((buildings[:, :4] - (x0, y0, x0, y0)) / RES_M).astype(int).clip(0)
        for (left, low, right, high), top in zip(at.tolist(), buildings[:, 4].tolist(), strict=True):
            height[low:high, left:right] = top
        _plant(height, np.concatenate([b.trees for b in blocks]), x0, y0)
        self.top_m = float(height.max(initial=0.0))
        self._flat = height.ravel()
        self._sun = shadow_m(scene.config)

    def seen(self, x_m: Floats, y_m: Floats, eye_m: Floats) -> NDArray[np.bool_]:
        """Whether points [n] at a car's height are seen from `eye_m` [n, 3]."""
        fall = np.maximum(eye_m[:, 2] - CAR_TOP_M, 1.0)
        return self._march(x_m, y_m, (eye_m[:, 0] - x_m) / fall, (eye_m[:, 1] - y_m) / fall)

    def lit(self, x_m: Floats, y_m: Floats) -> NDArray[np.bool_]:
        """Whether the sun reaches points [n] at a car's height."""
        return self._march(x_m, y_m, *(np.full(len(x_m), -along) for along in self._sun))

    def _march(self, x_m: Floats, y_m: Floats, slope_x: Floats, slope_y: Floats) -> NDArray[np.bool_]:
        """Follow rays upwards; slopes are metres sideways for each metre of height. Rays go in groups that fit the cache."""
        steps = int(np.ceil(max(self.top_m - CAR_TOP_M, 0.0) / STEP_M))
        clear = np.ones(len(x_m), bool)
        for at in range(0, len(x_m), _RAYS):
            some = slice(at, at + _RAYS)
            sx, sy = (
                (slope_x[some] * (STEP_M / RES_M)).astype(np.float32),
                (slope_y[some] * (STEP_M / RES_M)).astype(np.float32),
            )
            px = ((x_m[some] - self.x0_m) / RES_M).astype(np.float32) - 0.5 * sx
            py = ((y_m[some] - self.y0_m) / RES_M).astype(np.float32) - 0.5 * sy
            for k in range(steps):
                px += sx
                py += sy
                pixel = py.astype(np.intp)
                pixel *= self.columns
                pixel += px.astype(np.intp)
                clear[some] &= self._flat.take(pixel, mode="clip") < CAR_TOP_M + (k + 0.5) * STEP_M
        return clear


class Kerbs:
    """How near parked cars are, on a raster of its own: 1 at one's middle, 0 from 8 m on."""

    def __init__(self, scene: SceneModel) -> None:
        x0, y0, x1, y1 = scene.rect
        self.x0_m, self.y0_m = x0, y0
        self.columns, self.rows = int((x1 - x0) / RES_M) + 2, int((y1 - y0) / RES_M) + 2
        cars = scene.parked_cars  # all inside
        reach = int(NEAR_M / RES_M)
        span = np.arange(-reach, reach + 1)
        about = np.maximum(0.0, 1.0 - RES_M * np.hypot(span[:, None], span) / NEAR_M).astype(np.float32)
        rim = 2 * reach  # for cars at the edge
        near = np.zeros((self.rows + rim, self.columns + rim), np.float32)
        low, left = ((cars.y_m - y0) / RES_M).astype(int), ((cars.x_m - x0) / RES_M).astype(int)
        for k, j in zip(low.tolist(), left.tolist(), strict=True):
            window = near[k : k + len(span), j : j + len(span)]
            np.maximum(window, about, out=window)
        self._flat = near[reach:-reach, reach:-reach].ravel()
        gap_m = np.hypot(*next_of(np.stack([cars.x_m, cars.y_m], axis=1)).T)
        self.parked = np.maximum(0.0, 1.0 - gap_m / NEAR_M).astype(np.float32)
        """Each parked car's nearness to the next one."""

    def near(self, x_m: Floats, y_m: Floats) -> NDArray[np.float32]:
        """How near points [n] are to a parked car."""
        row, column = ((y_m - self.y0_m) / RES_M).astype(np.intp), ((x_m - self.x0_m) / RES_M).astype(np.intp)
        return self._flat.take(row * self.columns + column, mode="clip")


def next_of(xy: Floats) -> Floats:
    """From every point to the one next to it [n, 2]; inf where there is none."""
    if len(xy) < 2:
        return np.full(xy.shape, np.inf)
    return np.asarray(xy[cKDTree(xy).query(xy, k=2)[1][:, 1]] - xy)


def _plant(height: NDArray[np.float32], trees: Floats, x0_m: float, y0_m: float) -> None:
    """Raise the field to the trees' domes (x, y, radius, height, tone), in place."""
    x, y, radius, top, _ = trees.T[..., None]
    reach = int(np.ceil(radius.max(initial=0.0) / RES_M)) + 1
    span = np.arange(-reach, reach + 1)
    column, row = (np.floor((at - low) / RES_M).astype(int) + span for at, low in ((x, x0_m), (y, y0_m)))
    across, along = ((low + (k + 0.5) * RES_M - at) ** 2 for k, at, low in ((column, x, x0_m), (row, y, y0_m)))
    part = (across[:, None, :] + along[:, :, None]) / radius[..., None] ** 2
    inside = part < 1.0
    inside &= ((row >= 0) & (row < height.shape[0]))[:, :, None]
    inside &= ((column >= 0) & (column < height.shape[1]))[:, None, :]
    dome = (top[..., None] * (1.0 - 0.35 * part)).astype(np.float32)
    pixel = (row * height.shape[1])[:, :, None] + column[:, None, :]
    np.maximum.at(height.reshape(-1), pixel[inside], dome[inside])
