"""What five cameras on a drone see: rays against the town's height field, on a CPU, a few milliseconds a camera.

Each drone carries the cameras of UAV3D, unless its make has others: front, left, right and back pitched 45° down and
one that looks straight down, 70° horizontal field of view, 16:9, rendered at 160 × 90. They are fixed to the body, so a
bank moves the view. `rays.py` walks the rays. The scenery is static; the moving cars of a moment are stamped into the rasters,
and lifted out after.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sortie.perception.geometry import USUAL, Cameras
from sortie.perception.scene.rays import COARSE, FAR, FAR_REACH, REACH, see
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.stamping import raised, restore, saved, stamp
from sortie.perception.scene.town import RES_M, TILE_M, Bytes, FloatMap, Floats
from sortie.perception.scene.traffic import Cars
from sortie.perception.types import Capture
from sortie.scenarios.streams import stream

CAMERAS = ("front", "left", "right", "back", "nadir")
MAX_REACH_M = 170.0
RES = np.float32(RES_M)
FloatOrArray = TypeVar("FloatOrArray", float, Floats)


def rotation(xyzw: Sequence[float]) -> Floats:
    """The matrix [3, 3] that takes body (FLU) vectors to world (ENU), from a quaternion x, y, z, w.

    Raises:
        ValueError: one without a length.
    """
    norm = float(np.sqrt(np.square(np.asarray(xyzw, dtype=np.float64)).sum()))
    if not 0.0 < norm < np.inf:
        raise ValueError(f"orientation_xyzw is {tuple(xyzw)}, must have a finite length above 0")
    x, y, z, w = np.asarray(xyzw, dtype=np.float64) / norm
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


def views_shape(cameras: Cameras = USUAL) -> tuple[int, int, int, int]:
    """The shape of a drone's pictures: cameras, height, width, colours."""
    return len(CAMERAS), cameras.height_px, cameras.width_px, 3


def camera_axes(cameras: Cameras = USUAL) -> Floats:
    """[5, 3, 3]: rows are each camera's right, down and forward axes in the body frame (FLU)."""
    out, lens = [], cameras.lens
    for azimuth in (0.0, 90.0, -90.0, 180.0):
        a = np.radians(azimuth)
        ahead = np.array([np.cos(a), np.sin(a), 0.0])
        right = np.array([np.sin(a), -np.cos(a), 0.0])
        forward = (lens.ahead * ahead + np.array([0.0, 0.0, -lens.down])) / np.sqrt(2)
        out.append([right, np.cross(forward, right), forward])
    out.append([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return np.array(out)


AXES = camera_axes()


@lru_cache(maxsize=16)
def _rays(cameras: Cameras) -> FloatMap:
    """Body-frame directions of every pixel, float32 [5 · height · width, 3], not normalised."""
    u = (np.arange(cameras.width_px) + 0.5) / cameras.width_px * 2 - 1
    v = (np.arange(cameras.height_px) + 0.5) / cameras.height_px * 2 - 1
    vv, uu = np.meshgrid(v * cameras.lens.half_v, u * cameras.lens.half_h, indexing="ij")
    local = np.stack([uu, vv, np.ones_like(uu)], axis=-1).reshape(-1, 3)
    return np.concatenate([local @ axes for axes in camera_axes(cameras)]).astype(np.float32)


class Window:
    """Rasters of a whole number of tiles: static scenery with parked cars, and room for the moving ones."""

    def __init__(self, scene: SceneModel, ix: range, iy: range) -> None:
        self.x0_m, self.y0_m = ix.start * TILE_M, iy.start * TILE_M
        tiles = [[scene.town.tile(i, j) for i in ix] for j in iy]
        self.height = np.concatenate([np.concatenate([t.height_m for t in row], axis=1) for row in tiles])
        self.colour = np.concatenate([np.concatenate([t.albedo for t in row], axis=1) for row in tiles])
        self.light = np.concatenate([np.concatenate([t.light for t in row], axis=1) for row in tiles])
        self._stamp(scene.parked_cars)
        self.coarse = _grown(_blocks(self.height, COARSE), 1)
        self.far = _grown(_blocks(self.coarse, FAR // COARSE), FAR_REACH)
        """For scenery alone, as rays are followed above all cars."""
        self.top_m = float(self.height.max())

    def pixel(self, x_m: FloatOrArray, y_m: FloatOrArray) -> tuple[FloatOrArray, FloatOrArray]:
        """Where places are, in pixels from the raster's edge (column, row)."""
        return (x_m - self.x0_m) / RES_M, (y_m - self.y0_m) / RES_M

    @contextmanager
    def with_cars(self, cars: Cars) -> Iterator[None]:
        """The window with `cars` in it, for the time of the block."""
        spans, _ = self._spans(cars)
        scenery, coarse, top_m = saved(self.height, self.colour, spans), self.coarse.copy(), self.top_m
        self._stamp(cars)
        raised(self.height, self.coarse, COARSE, spans)
        self.top_m = max(top_m, float(cars.height_m.max(initial=0.0)))  # a field may hold nothing as high
        try:
            yield
        finally:
            restore(self.height, self.colour, spans, *scenery)
            self.coarse[...], self.top_m = coarse, top_m

    def _spans(self, cars: Cars) -> tuple[NDArray[np.int64], Floats]:
        """Rows and columns [n, 4] that cars may cover, none for those that are not whole in the window; and their middles [n, 2], pixels."""
        reach = 0.5 * np.hypot(cars.length_m, cars.width_m) / RES_M
        x, y = self.pixel(cars.x_m, cars.y_m)
        spans = np.stack([np.floor(y - reach), np.ceil(y + reach), np.floor(x - reach), np.ceil(x + reach)], axis=1)
        rows, columns = self.height.shape
        spans[(spans[:, 0] < 0) | (spans[:, 1] > rows) | (spans[:, 2] < 0) | (spans[:, 3] > columns)] = 0
        return spans.astype(np.int64), np.stack([x, y], axis=1)

    def _stamp(self, cars: Cars) -> None:
        spans, middles = self._spans(cars)
        turns = np.stack([np.cos(cars.yaw_rad), np.sin(cars.yaw_rad)], axis=1)
        sizes = np.stack([cars.length_m, cars.width_m, cars.height_m], axis=1)
        stamp(self.height, self.colour, self.light, RES_M, spans, middles, turns, sizes, cars.colour)


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


class Renderer:
    """Renders captures of one scene; keeps the rasters of the last window."""

    def __init__(self, scene: SceneModel, seed: int, replication: int = 0) -> None:
        self.scene = scene
        self.key = seed, replication
        self._window: Window | None = None
        self._span: tuple[range, range] = (range(0), range(0))

    def render(self, captures: Sequence[Capture]) -> Bytes:
        """Camera images of captures by cameras of one resolution, uint8 [n, 5, height, width, 3], in the order of `CAMERAS`."""
        out = np.empty((len(captures), *views_shape(captures[0].cameras if captures else USUAL)), np.uint8)
        self.render_into(captures, out)
        return out

    def render_into(
        self, captures: Sequence[Capture], out: Bytes | Sequence[Bytes], each: Callable[..., Iterable[None]] = map
    ) -> None:
        """Write the images of each capture into an array [5, height, width, 3] in C order, whole when its function is done.

        `each` runs a function over captures, `map` or a pool's `map`; the images are the same.
        """
        if not captures:
            return
        window = self._window_over(captures)
        gain = np.float32(self.scene.config.brightness)
        for t_s in dict.fromkeys(c.t_s for c in captures):
            here = [i for i, c in enumerate(captures) if c.t_s == t_s]
            with window.with_cars(self.scene.moving_bodies(t_s)):

                def one(i: int) -> None:
                    c = captures[i]
                    turn = rotation(c.orientation_xyzw).T.astype(np.float32)
                    eye = tuple(np.float32(v) for v in (*window.pixel(*c.position_m[:2]), c.position_m[2]))
                    top_m = min(window.top_m, c.position_m[2] - 1.0)
                    rasters = (window.height, window.coarse, window.far, window.colour)
                    rays = _rays(c.cameras)
                    see(rays, turn, eye, RES, top_m, *rasters, gain, _noise(*self.key, c), out[i].reshape(-1, 3))

                for _ in each(one, here):
                    pass

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


def _noise(seed: int, replication: int, capture: Capture) -> Bytes:
    """Uniform sensor noise, uint8 [rays, 3] of 0 … 15 levels (8 is none), keyed by drone and millisecond."""
    rng = stream(seed, replication, (capture.drone, max(round(capture.t_s * 1e3), 0)), "camera.noise")
    numbers = int(np.prod(views_shape(capture.cameras)))
    return np.asarray(np.frombuffer(rng.bytes(numbers), np.uint8) & np.uint8(15)).reshape(-1, 3)
