"""The bird's-eye grids: level, aligned with the drone's heading, the drone in the middle. Free of torch.

x points forward along rows, y left along columns, row 0 the rearmost and column 0 the rightmost. Three
resolutions cover the same square: the image that the encoder sees, the cells that are exchanged (UAV3D's
64 × 64 × 80), and the grid of the detection head.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

IMAGE_PX = 256
CELLS = 64
CHANNELS = 80
HEAD_PX = 128


@dataclass(frozen=True, slots=True)
class Geometry:
    """How far the grids reach, in metres from the drone to each edge."""

    half_extent_m: float = 102.4

    @property
    def image_m(self) -> float:
        """Side of an image pixel: 0.8 m in UAV3D's geometry."""
        return 2 * self.half_extent_m / IMAGE_PX

    @property
    def cell_m(self) -> float:
        """Side of an exchanged cell: 3.2 m in UAV3D's geometry."""
        return 2 * self.half_extent_m / CELLS

    @property
    def head_m(self) -> float:
        """Side of a cell of the head: 1.6 m in UAV3D's geometry."""
        return 2 * self.half_extent_m / HEAD_PX


FULL = Geometry(102.4)
"""UAV3D's, and the default."""
SMALL = Geometry(51.2)
"""Half as far, twice as fine."""


def in_square(
    xy_m: NDArray[np.floating], poses: ArrayLike, half_extent_m: float = FULL.half_extent_m
) -> NDArray[np.bool_]:
    """Which places [n, 2] (ENU) lie in the squares of which poses [m, 3] (x, y, yaw): [n, m]; poses [n, 1, 3]: one for
    each place, [n, 1]."""
    x, y, yaw = np.moveaxis(np.asarray(poses, np.float64), -1, 0)
    dx, dy, c, s = xy_m[:, :1] - x, xy_m[:, 1:] - y, np.cos(yaw), np.sin(yaw)
    inside: NDArray[np.bool_] = (np.abs(c * dx + s * dy) < half_extent_m) & (np.abs(c * dy - s * dx) < half_extent_m)
    return inside
