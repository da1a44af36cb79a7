"""What five cameras on a drone see: rays against the town's height field, on a CPU, a few milliseconds a camera.

Each drone carries the cameras of UAV3D: front, left, right and back pitched 45° down and one that looks
straight down, 70° horizontal field of view, 16:9, rendered at 160 × 90. They are fixed to the body, so a bank
moves the view. `rays.py` walks the rays. The scenery is static; the moving cars of a moment are stamped into the rasters,
and lifted out after.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from perception.rays import COARSE, FAR, FAR_REACH, REACH, see
from perception.scene import SceneModel
from perception.town import RES_M, TILE_M, Bytes, FloatMap, Floats
from perception.traffic import Cars
from perception.types import Capture
from scenarios.streams import stream

CAMERAS = ("front", "left", "right", "back", "nadir")
WIDTH_PX, HEIGHT_PX = 160, 90
VIEWS_SHAPE = (len(CAMERAS), HEIGHT_PX, WIDTH_PX, 3)
HALF_H = float(np.tan(np.radians(35.0)))
"""Tangent of half the horizontal field of view."""
HALF_V = HALF_H * HEIGHT_PX / WIDTH_PX
MAX_REACH_M = 170.0
RES = np.float32(RES_M)


def rotation(xyzw: Sequence[float]) -> Floats:
    """The matrix [3, 3] that takes body (FLU) vectors to world (ENU), from a unit quaternion x, y, z, w."""
    x, y, z, w = np.asarray(xyzw, dtype=np.float64) / np.linalg.norm(xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def tilt(xyzw: Sequence[float]) -> Floats:
    """The attitude without its heading: body to the level, heading-aligned frame, [3, 3]."""
    r = rotation(xyzw)
    yaw = np.arctan2(r[1, 0], r[0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    level = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(level @ r)


def _camera_axes() -> Floats:
    """[5, 3, 3]: rows are each camera's right, down and forward axes in the body frame (FLU)."""
    out = []
    for azimuth in (0.0, 90.0, -90.0, 180.0):
        a = np.radians(azimuth)
        ahead = np.array([np.cos(a), np.sin(a), 0.0])
        right = np.array([np.sin(a), -np.cos(a), 0.0])
        forward = (ahead + np.array([0.0, 0.0, -1.0])) / np.sqrt(2)
        out.append([right, np.cross(forward, right), forward])
    out.append([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return np.array(out)


AXES = _camera_axes()


def _ray_table() -> Floats:
    """Body-frame directions of every pixel, [5 · 90 · 160, 3], not normalised."""
    u = (np.arange(WIDTH_PX) + 0.5) / WIDTH_PX * 2 - 1
    v = (np.arange(HEIGHT_PX) + 0.5) / HEIGHT_PX * 2 - 1
    vv, uu = np.meshgrid(v * HALF_V, u * HALF_H, indexing="ij")
    local = np.stack([uu, vv, np.ones_like(uu)], axis=-1).reshape(-1, 3)
    return np.concatenate([local @ axes for axes in AXES])


_RAYS = _ray_table().astype(np.float32)


class Window:
    """Rasters of a whole number of tiles: static scenery with parked cars, and room for the moving ones."""

    def __init__(self, scene: SceneModel, ix: range, iy: range) -> None:
        self.x0_m, self.y0_m = ix.start * TILE_M, iy.start * TILE_M
        tiles = [[scene.town.tile(i, j) for i in ix] for j in iy]
        self.height = np.concatenate([np.concatenate([t.height_m for t in row], axis=1) for row in tiles])
        self.colour = np.concatenate([np.concatenate([t.albedo for t in row], axis=1) for row in tiles])
        self.light = np.concatenate([np.concatenate([t.light for t in row], axis=1) for row in tiles])
        for patch in stamps(scene.parked_cars, self):
            patch.put(self)
        self.coarse = _grown(_blocks(self.height, COARSE), 1)
        self.far = _grown(_blocks(self.coarse, FAR // COARSE), FAR_REACH)
        """Of scenery alone: it is asked above all cars."""
        self.top_m = float(self.height.max())

    def pixel(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Where a place is, in pixels from the raster's edge (column, row)."""
        return (x_m - self.x0_m) / RES_M, (y_m - self.y0_m) / RES_M

    @contextmanager
    def with_cars(self, cars: Cars) -> Iterator[None]:
        """The window with `cars` in it, for the time of the block."""
        undo = []
        for patch in stamps(cars, self):
            undo.append((patch.at, self.height[patch.at].copy(), self.colour[patch.at].copy()))
            patch.put(self)
        coarse = self.coarse.copy()
        for at, _, _ in undo:
            reach = tuple(slice(max(s.start // COARSE - 1, 0), (s.stop - 1) // COARSE + 2) for s in at)
            self.coarse[reach] = np.maximum(self.coarse[reach], self.height[at].max())
        try:
            yield
        finally:
            for at, height, colour in reversed(undo):
                self.height[at] = height
                self.colour[at] = colour
            self.coarse[...] = coarse


def _blocks(height: FloatMap, pixels: int) -> FloatMap:
    """The highest of each block."""
    rows, columns = (n // pixels for n in height.shape)
    return np.asarray(height.reshape(rows, pixels, columns, pixels).max(axis=(1, 3)))


def _grown(blocks: FloatMap, reach: int) -> FloatMap:
    """The highest within so many blocks."""
    padded = np.pad(blocks, reach)
    for axis in (0, 1):
        padded = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=axis).max(axis=-1)
    return np.ascontiguousarray(padded)


@dataclass(frozen=True, slots=True)
class _Patch:
    at: tuple[slice, slice]
    height: FloatMap
    colour: Bytes

    def put(self, window: Window) -> None:
        """Raise the window to the patch where the patch is higher (a canopy over a car keeps hiding it)."""
        over = self.height > window.height[self.at]
        lit = self.colour * window.light[self.at][..., None]
        window.height[self.at] = np.where(over, self.height, window.height[self.at])
        window.colour[self.at] = np.where(over[..., None], lit, window.colour[self.at]).astype(np.uint8)


def stamps(cars: Cars, window: Window) -> Iterator[_Patch]:
    """Each car as a small raster: bonnet and boot at 0.62 of its height, a cabin with dark glass at its ends."""
    rows, columns = window.height.shape
    reach = 0.5 * np.hypot(cars.length_m, cars.width_m)
    px, py = (cars.x_m - window.x0_m) / RES_M, (cars.y_m - window.y0_m) / RES_M
    x0, x1 = np.floor(px - reach / RES_M).astype(int), np.ceil(px + reach / RES_M).astype(int)
    y0, y1 = np.floor(py - reach / RES_M).astype(int), np.ceil(py + reach / RES_M).astype(int)
    cos, sin = np.cos(cars.yaw_rad), np.sin(cars.yaw_rad)
    for k in np.flatnonzero((x0 >= 0) & (y0 >= 0) & (x1 <= columns) & (y1 <= rows)):
        dx = (np.arange(x0[k], x1[k]) + 0.5 - px[k])[None, :] * RES_M
        dy = (np.arange(y0[k], y1[k]) + 0.5 - py[k])[:, None] * RES_M
        u = (cos[k] * dx + sin[k] * dy) / cars.length_m[k]  # −0.5 … 0.5 from tail to nose
        v = (cos[k] * dy - sin[k] * dx) / cars.width_m[k]
        body = (np.abs(u) < 0.5) & (np.abs(v) < 0.5)
        cabin = (u > -0.42) & (u < 0.24)
        glass = cabin & ((u > 0.12) | (u < -0.34))
        top = np.float32(cars.height_m[k])
        height = np.where(body, np.where(cabin, top, 0.62 * top), np.float32(-1.0)).astype(np.float32)
        colour = np.broadcast_to(cars.colour[k], (*u.shape, 3)).copy()
        colour[glass] = (30, 34, 42)
        yield _Patch((slice(int(y0[k]), int(y1[k])), slice(int(x0[k]), int(x1[k]))), height, colour)


class Renderer:
    """Renders captures of one scene; keeps the rasters of the last window."""

    def __init__(self, scene: SceneModel, seed: int) -> None:
        self.scene = scene
        self.seed = seed
        self._window: Window | None = None
        self._span: tuple[range, range] = (range(0), range(0))

    def render(
        self, captures: Sequence[Capture], each: Callable[..., Iterable[None]] = map, into: Bytes | None = None
    ) -> Bytes:
        """Camera images of all captures, uint8 [n, 5, 90, 160, 3], in the order of `CAMERAS`.

        `each` runs a function over captures, `map` or a pool's `map`; the images are the same. They are written `into`
        an array of that shape, where one is given, each whole when its function is done.
        """
        out = np.empty((len(captures), *VIEWS_SHAPE), np.uint8) if into is None else into
        if not captures:
            return out
        window = self._window_over(captures)
        gain = np.float32(self.scene.config.brightness)
        for t_s in dict.fromkeys(c.t_s for c in captures):
            here = [i for i, c in enumerate(captures) if c.t_s == t_s]
            with window.with_cars(self.scene.moving_cars(t_s)):

                def one(i: int) -> None:
                    c = captures[i]
                    turn = rotation(c.orientation_xyzw).T.astype(np.float32)
                    eye = tuple(np.float32(v) for v in (*window.pixel(*c.position_m[:2]), c.position_m[2]))
                    top_m = min(window.top_m, c.position_m[2] - 1.0)
                    rasters = (window.height, window.coarse, window.far, window.colour)
                    see(_RAYS, turn, eye, RES, top_m, *rasters, gain, _noise(self.seed, c), out[i].reshape(-1, 3))

                for _ in each(one, here):
                    pass
        return out

    def _window_over(self, captures: Sequence[Capture]) -> Window:
        where = np.array([c.position_m for c in captures])
        reach = np.minimum(where[:, 2] * REACH, MAX_REACH_M) + 1.0
        ix, iy = (
            range(
                int(np.floor((where[:, a] - reach).min() / TILE_M)),
                int(np.floor((where[:, a] + reach).max() / TILE_M)) + 1,
            )
            for a in (0, 1)
        )
        old_x, old_y = self._span
        inside = bool(old_x) and ix.start in old_x and ix[-1] in old_x and iy.start in old_y and iy[-1] in old_y
        if self._window is None or not inside:
            self._window, self._span = Window(self.scene, ix, iy), (ix, iy)
        return self._window


def _noise(seed: int, capture: Capture) -> Bytes:
    """Uniform sensor noise, uint8 [rays, 3] of 0 … 15 levels (8 is none), keyed by drone and millisecond."""
    rng = stream(seed, 0, (capture.drone, max(round(capture.t_s * 1e3), 0)), "camera.noise")
    return np.asarray(np.frombuffer(rng.bytes(_RAYS.size), np.uint8) & np.uint8(15)).reshape(_RAYS.shape)
