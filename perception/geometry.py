"""The bird's-eye grids, the cameras' view angles, and the change between world and drone frames. Free of torch.

A grid is level and aligned with the drone's heading, with the drone in the middle.

x points forward along rows, y left along columns, row 0 the rearmost and column 0 the rightmost. Three
resolutions cover the same square: the image that the encoder sees, the cells that are exchanged (UAV3D's
64 × 64 × 80), and the grid of the detection head. A sharp image has twice the usual pixels along each side.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

IMAGE_PX, SHARP_PX = 256, 512
"""Pixels along a side of the image: of the usual one, and of a sharp one."""
CELLS = 64
CHANNELS = 80
HEAD_PX = 128


class Lens(NamedTuple):
    """What of cameras decides where a direction lies in their pictures; numbers, or arrays of many drones."""

    half_h: Any
    """Tangent of half the horizontal field of view."""
    half_v: Any
    ahead: Any
    """√2 times the cosine and the sine of the pitch: 1 and 1 at 45°."""
    down: Any


class Cameras(NamedTuple):
    """A drone's five cameras: front, left, right and back, pitched down, and one that looks straight down. UAV3D's by default."""

    field_of_view_deg: float = 70.0
    """Horizontal, of each camera."""
    pitch_deg: float = 45.0
    width_px: int = 160
    """Of a picture, which is 16:9."""

    @property
    def height_px(self) -> int:
        """Height of a picture."""
        return self.width_px * 9 // 16

    @property
    def focal_px(self) -> float:
        """Focal length in pixels."""
        return 0.5 * self.width_px / float(self.lens.half_h)

    @property
    def lens(self) -> Lens:
        """The same as tangents."""
        return _lens(self)


@lru_cache(maxsize=64)
def _lens(cameras: Cameras) -> Lens:
    half_h = float(np.tan(np.radians(cameras.field_of_view_deg / 2)))
    half_v = half_h * cameras.height_px / cameras.width_px
    pitch = np.radians(cameras.pitch_deg)
    # rounded, so that 45° are exactly 1 and 1
    ahead, down = (round(float(np.sqrt(2.0) * part), 12) for part in (np.cos(pitch), np.sin(pitch)))
    return Lens(half_h, half_v, ahead, down)


USUAL = Cameras()
"""The cameras of which the shipped networks have learned."""
WIDTH_PX, HEIGHT_PX = USUAL.width_px, USUAL.height_px
HALF_H, HALF_V = USUAL.lens.half_h, USUAL.lens.half_v
FOCAL_PX = USUAL.focal_px


@dataclass(frozen=True, slots=True)
class Geometry:
    """How far the grids reach, in metres from the drone to each edge."""

    half_extent_m: float = 102.4
    image_px: int = IMAGE_PX
    """Pixels along a side of the image."""

    @property
    def image_m(self) -> float:
        """Side of an image pixel: 0.8 m in UAV3D's geometry, 0.4 m of a sharp image."""
        return 2 * self.half_extent_m / self.image_px

    @property
    def cameras(self) -> Cameras:
        """The cameras that an image is learned from: the usual ones, for a sharp image with 320 × 180 pixels."""
        return USUAL._replace(width_px=USUAL.width_px * self.image_px // IMAGE_PX)

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


def camera_margins(x: Any, y: Any, z: Any, lens: Lens = USUAL.lens) -> tuple[Any, Any]:
    """How far inside a picture a direction lies: 1 in the middle, 0 at the edge, negative outside.

    Args:
        x, y, z: the direction in the body frame (FLU), numbers or arrays.
        lens: the cameras', numbers or arrays that broadcast.

    Returns:
        The margin in the camera that looks straight down, and in that of the four pitched cameras which faces the
        direction. The lift asks no other one. By the usual cameras, none of the others sees what the facing one does not.
    """
    depth, across, along = np.maximum(-z, 0.1), np.abs(y), np.abs(x)
    down = 1.0 - np.maximum(across / lens.half_h, along / lens.half_v) / depth
    ahead, right = np.maximum(along, across), np.minimum(along, across)
    forward = np.maximum((lens.ahead * ahead - lens.down * z) / np.sqrt(2.0), 0.1)
    u = right / (forward * lens.half_h)
    v = np.abs(-lens.down * ahead - lens.ahead * z) / (np.sqrt(2.0) * forward * lens.half_v)
    return down, 1.0 - np.maximum(u, v)


def in_square(
    xy_m: NDArray[np.floating], poses: ArrayLike, half_extent_m: float = FULL.half_extent_m
) -> NDArray[np.bool_]:
    """[n, m] bool: which places [n, 2] (ENU) lie in the square of which pose [m, 3] (x, y, yaw).

    With poses [n, 1, 3] each place has a pose of its own, and the answer is [n, 1].
    """
    forward, left = to_local(xy_m[:, :1], xy_m[:, 1:], np.moveaxis(np.asarray(poses, np.float64), -1, 0))
    inside: NDArray[np.bool_] = (np.abs(forward) < half_extent_m) & (np.abs(left) < half_extent_m)
    return inside
