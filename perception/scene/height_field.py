"""Lines of sight over the town: a coarse height field, and who sees over it. Free of torch."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sortie.perception.scene.town import Floats, Town, shadow_m

RES_M = 0.8
STEP_M = 1.0
"""Heights between which a ray is not looked at."""
CAR_TOP_M = 1.2
"""What of a car has to be seen over a roof or a hedge."""
TRUCK_TOP_M = 2.4
"""The same of a truck: three quarters of its height too."""


@cache
def loops() -> Any:
    """The compiled loops, imported and made ready at their first use: before a flight, whose drones may be real ones."""
    from sortie.perception.scene import sight_loops

    single, none, wide = np.zeros(0, np.float32), np.zeros(0), np.zeros((0, 1))
    states = np.zeros((0, 1, 16, 16), np.uint8)
    sight_loops.march(single, 1, single, single, single, single, 0.0, 0)
    sight_loops.hide(
        states, wide.astype(np.int64), wide, wide, wide, none, none, 0.0, single, single > 0, 1, 0.0, 0.0, 0.0, 0
    )
    return sight_loops


class HeightField:
    """Roofs and crowns of the town inside a scene's rectangle, on a 0.8 m raster; beyond it the land is flat."""

    def __init__(self, town: Town, rect: tuple[float, float, float, float]) -> None:
        """Args: `rect`: x_min, y_min, x_max, y_max, ENU metres."""
        x0, y0, x1, y1 = rect
        self.x0_m, self.y0_m = x0, y0
        self.columns, self.rows = int(np.ceil((x1 - x0) / RES_M)) + 2, int(np.ceil((y1 - y0) / RES_M)) + 2
        height = np.zeros((self.rows, self.columns), np.float32)
        blocks = town.blocks(x0, y0, x1, y1)
        buildings = np.concatenate([b.buildings for b in blocks])
        at = np.rint((buildings[:, :4] - (x0, y0, x0, y0)) / RES_M).astype(int).clip(0)
        for (left, low, right, high), top in zip(at.tolist(), buildings[:, 4].tolist(), strict=True):
            height[low:high, left:right] = top
        self._roofed = (height > 0.0).ravel()
        _plant(height, np.concatenate([b.trees for b in blocks]), x0, y0)
        self.top_m = float(height.max(initial=0.0))
        self._flat = height.ravel()
        self._sun = shadow_m(town.scene)
        loops()

    def seen(self, x_m: Floats, y_m: Floats, eye_m: Floats, top_m: float = CAR_TOP_M) -> NDArray[np.bool_]:
        """Whether points [n] at a height, a car's if not given, are seen from `eye_m` [n, 3]."""
        fall = np.maximum(eye_m[:, 2] - top_m, 1.0)
        return self._march(x_m, y_m, (eye_m[:, 0] - x_m) / fall, (eye_m[:, 1] - y_m) / fall, top_m)

    def lit(self, x_m: Floats, y_m: Floats) -> NDArray[np.bool_]:
        """Whether the sun reaches points [n] at a car's height."""
        sun_x, sun_y = (np.full(len(x_m), -along) for along in self._sun)
        return self._march(x_m, y_m, sun_x, sun_y)

    def open(self, x_m: Floats, y_m: Floats) -> NDArray[np.bool_]:
        """Whether points [n] lie on the ground, beneath no roof."""
        pixel = ((y_m - self.y0_m) / RES_M).astype(np.intp) * self.columns + ((x_m - self.x0_m) / RES_M).astype(np.intp)
        return np.asarray(~self._roofed.take(pixel, mode="clip"))

    def hide(self, states: NDArray[np.uint8], at: NDArray[np.int64], *lines: Any) -> None:
        """Set cells to 0 of which less than half of the open ground is in sight; arguments as for `sight_loops.hide`."""
        loops().hide(
            states,
            at,
            *lines,
            self._flat,
            self._roofed,
            self.columns,
            self.x0_m,
            self.y0_m,
            CAR_TOP_M,
            self._steps(CAR_TOP_M),
        )

    def _steps(self, from_m: float) -> int:
        """Steps that a ray takes from a height until it is above everything."""
        return int(np.ceil(max(self.top_m - from_m, 0.0) / STEP_M))

    def _march(
        self, x_m: Floats, y_m: Floats, slope_x: Floats, slope_y: Floats, from_m: float = CAR_TOP_M
    ) -> NDArray[np.bool_]:
        """Follow rays upwards from a height; slopes are metres sideways for each metre of height."""
        px, py = (x_m - self.x0_m) / RES_M, (y_m - self.y0_m) / RES_M
        each = (px, py, slope_x * (STEP_M / RES_M), slope_y * (STEP_M / RES_M))
        rays = [v.astype(np.float32) for v in each]
        clear: NDArray[np.bool_] = loops().march(self._flat, self.columns, *rays, float(from_m), self._steps(from_m))
        return clear


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
