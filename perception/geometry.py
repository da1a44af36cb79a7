"""The bird's-eye grids, the cameras' view angles, and the change between world and drone frames. Free of torch.

A grid is level and aligned with the drone's heading, with the drone in the middle.

x points forward along rows, y left along columns, row 0 the rearmost and column 0 the rightmost. Three
resolutions cover the same square: the image that the encoder sees, the cells that are exchanged (UAV3D's
64 × 64 × 80), and the grid of the detection head.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

IMAGE_PX = 256
CELLS = 64
CHANNELS = 80
HEAD_PX = 128
WIDTH_PX, HEIGHT_PX = 160, 90
"""A camera image."""
HALF_H = float(np.tan(np.radians(35.0)))
"""Tangent of half the cameras' horizontal field of view."""
HALF_V = HALF_H * HEIGHT_PX / WIDTH_PX
FOCAL_PX = 0.5 * WIDTH_PX / HALF_H
"""The cameras' focal length in pixels."""


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


def to_local(x_m: Any, y_m: Any, pose: Any) -> tuple[Any, Any]:
    """World coordinates in a drone's level frame, as (forward, left); `pose` is x, y, yaw: numbers or arrays that broadcast."""
    dx, dy, c, s = x_m - pose[0], y_m - pose[1], np.cos(pose[2]), np.sin(pose[2])
    return c * dx + s * dy, c * dy - s * dx


def to_world(forward_m: Any, left_m: Any, pose: Any) -> tuple[Any, Any]:
    """Points of a drone's level frame in world coordinates, as (x, y); the inverse of `to_local`."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return pose[0] + c * forward_m - s * left_m, pose[1] + s * forward_m + c * left_m


def camera_margins(x: Any, y: Any, z: Any) -> tuple[Any, Any]:
    """How far inside a picture a direction lies: 1 in the middle, 0 at the edge, negative outside.

    Args:
        x, y, z: the direction in the body frame (FLU), numbers or arrays.

    Returns:
        The margin in the camera that looks straight down, and in that of the four pitched cameras which faces the
        direction. A direction that another pitched camera sees is in the facing one, too.
    """
    depth, across, along = np.maximum(-z, 0.1), np.abs(y), np.abs(x)
    down = 1.0 - np.maximum(across / HALF_H, along / HALF_V) / depth
    ahead, right = np.maximum(along, across), np.minimum(along, across)
    forward = np.maximum((ahead - z) / np.sqrt(2.0), 0.1)
    u, v = right / (forward * HALF_H), np.abs(-ahead - z) / (np.sqrt(2.0) * forward * HALF_V)
    return down, 1.0 - np.maximum(u, v)


def camera_depth_m(x: Any, y: Any, z: Any) -> Any:
    """How far points lie in front of the camera that shows them largest, along its axis; infinite where none shows them.

    Args:
        x, y, z: the points in the body frame (FLU), metres, arrays.
    """
    down, side = camera_margins(x, y, z)
    ahead = (np.maximum(np.abs(x), np.abs(y)) - z) / np.sqrt(2.0, dtype=np.float32)
    return np.minimum(np.where(down > 0.0, -z, np.inf), np.where(side > 0.0, ahead, np.inf))


def in_square(
    xy_m: NDArray[np.floating], poses: ArrayLike, half_extent_m: float = FULL.half_extent_m
) -> NDArray[np.bool_]:
    """[n, m] bool: which places [n, 2] (ENU) lie in the square of which pose [m, 3] (x, y, yaw).

    With poses [n, 1, 3] each place has a pose of its own, and the answer is [n, 1].
    """
    forward, left = to_local(xy_m[:, :1], xy_m[:, 1:], np.moveaxis(np.asarray(poses, np.float64), -1, 0))
    inside: NDArray[np.bool_] = (np.abs(forward) < half_extent_m) & (np.abs(left) < half_extent_m)
    return inside
