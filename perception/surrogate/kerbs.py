"""How near cars stand to one another. Free of torch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sortie.perception.scene.height_field import RES_M
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.town import Floats

NEAR_M = 8.0


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
