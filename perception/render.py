"""What five cameras on a drone see: rays against the town's height field, on a CPU, a few milliseconds a camera.

Each drone carries the cameras of UAV3D: front, left, right and back pitched 45° down and one that looks
straight down, 70° horizontal field of view, 16:9, rendered at 160 × 90. They are fixed to the body, so a bank
moves the view. A ray descends from the tallest thing in the window: 2 m slices are skipped where a coarse
maximum map says that nothing is in reach, and walked in fine steps where something is (0.5 m of height,
0.25 m below 2 m). The scenery is static; the moving cars of a moment are stamped into the rasters, and lifted out after.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch

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
REACH = 3.0
"""Rays flatter than 1:3 see haze: they meet the ground beyond the grid's corner."""
MAX_REACH_M = 170.0
_COARSE = 8
_HAZE = (168, 178, 190)
_SLICE_M = 2.0


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


_RAYS = torch.from_numpy(_ray_table().astype(np.float32))


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
        rows, columns = self.height.shape
        blocks = self.height.reshape(rows // _COARSE, _COARSE, columns // _COARSE, _COARSE).max(axis=(1, 3))
        grown = np.pad(blocks, 1)
        grown = np.maximum(np.maximum(grown[:-2], grown[1:-1]), grown[2:])
        self.coarse = np.maximum(np.maximum(grown[:, :-2], grown[:, 1:-1]), grown[:, 2:])
        self.top_m = float(self.height.max())

    @contextmanager
    def with_cars(self, cars: Cars) -> Iterator[None]:
        """The window with `cars` in it, for the time of the block."""
        undo = []
        for patch in stamps(cars, self):
            undo.append((patch.at, self.height[patch.at].copy(), self.colour[patch.at].copy()))
            patch.put(self)
        coarse = self.coarse.copy()
        for at, _, _ in undo:
            reach = tuple(slice(max(s.start // _COARSE - 1, 0), (s.stop - 1) // _COARSE + 2) for s in at)
            self.coarse[reach] = np.maximum(self.coarse[reach], self.height[at].max())
        try:
            yield
        finally:
            for at, height, colour in reversed(undo):
                self.height[at] = height
                self.colour[at] = colour
            self.coarse[...] = coarse


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
        gain = self.scene.config.brightness
        for t_s in dict.fromkeys(c.t_s for c in captures):
            here = [i for i, c in enumerate(captures) if c.t_s == t_s]
            with window.with_cars(self.scene.moving_cars(t_s)):

                def one(i: int) -> None:
                    with torch.inference_mode():
                        image = _cast(window, captures[i])
                        if gain != 1.0:
                            image = (image * gain).to(torch.int16)
                        image = image + _noise(self.seed, captures[i], image.numel()).view_as(image)
                        out[i] = image.clamp_(0, 255).to(torch.uint8).view(out.shape[1:]).numpy()

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


def _cast(window: Window, capture: Capture) -> torch.Tensor:
    """Colours uint8 [rays, 3] of one drone's rays."""
    direction = _RAYS @ torch.from_numpy(rotation(capture.orientation_xyzw).T.astype(np.float32))
    dx, dy, dz = direction.unbind(1)
    down = torch.clamp(-dz, min=0.05)
    bx, by = dx / (down * RES_M), dy / (down * RES_M)  # pixels sideways per metre of descent
    z0 = capture.position_m[2]
    ax = torch.add(bx * z0, (capture.position_m[0] - window.x0_m) / RES_M)
    ay = torch.add(by * z0, (capture.position_m[1] - window.y0_m) / RES_M)
    index, hit_z = _march(window, ax, ay, bx, by, min(window.top_m, z0 - 1.0))
    colour = torch.from_numpy(window.colour).view(-1, 3).index_select(0, index)
    wall = torch.from_numpy(window.height).view(-1).index_select(0, index) - hit_z > 0.8
    side = torch.where(bx.abs() > by.abs(), 0.55, 0.75)
    out = (colour * torch.where(wall, side, 1.0)[:, None]).to(torch.uint8)
    haze = dx * dx + dy * dy > (-dz * REACH).clamp_(min=0.0) ** 2
    if bool(haze.any()):
        out[haze] = torch.tensor(_HAZE, dtype=torch.uint8)
    return out


def _march(
    window: Window, ax: torch.Tensor, ay: torch.Tensor, bx: torch.Tensor, by: torch.Tensor, top_m: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Where each ray (x = ax − z·bx, y = ay − z·by, pixels) first meets the height field: pixel index and z, both [n]."""
    rows, columns = window.height.shape
    fine, coarse = torch.from_numpy(window.height).view(-1), torch.from_numpy(window.coarse).view(-1)
    wide = columns // _COARSE
    result = _pixel(ax, ay, bx, by, 0.0, 1.0, rows, columns)
    hit_z = torch.zeros(len(ax))
    alive = torch.ones(len(ax), dtype=torch.bool)
    for step in range(int(np.ceil(top_m / _SLICE_M)) - 1, -1, -1):
        low = step * _SLICE_M
        at = _pixel(ax, ay, bx, by, low + _SLICE_M / 2, 1 / _COARSE, rows // _COARSE, wide)
        who = (coarse.index_select(0, at) > low).logical_and_(alive).nonzero().squeeze(1)
        if not len(who):
            continue
        rax, ray, rbx, rby = (v.index_select(0, who) for v in (ax, ay, bx, by))
        fine_step = 0.25 if step == 0 else 0.5
        got, got_z = result.index_select(0, who), torch.zeros(len(who))
        for k in range(int(_SLICE_M / fine_step)):  # upwards: the highest meeting is the first on the way down
            z = low + k * fine_step
            if z > 0.0:
                index = _pixel(rax, ray, rbx, rby, z, 1.0, rows, columns)
                found = fine.index_select(0, index) >= z
                got = torch.where(found, index, got)
                got_z.masked_fill_(found, z)
        result.index_copy_(0, who, got)
        hit_z.index_copy_(0, who, got_z)
        alive.index_copy_(0, who, got_z == 0.0)
    return result, hit_z


def _pixel(
    ax: torch.Tensor,
    ay: torch.Tensor,
    bx: torch.Tensor,
    by: torch.Tensor,
    z: float,
    scale: float,
    rows: int,
    columns: int,
) -> torch.Tensor:
    """Flat index, int32 [n], of the raster cell that each ray is over at height z; the raster's edge goes on for ever."""
    ix = torch.sub(ax, bx, alpha=z).mul_(scale).clamp_(0, columns - 1).to(torch.int32)
    iy = torch.sub(ay, by, alpha=z).mul_(scale).clamp_(0, rows - 1).to(torch.int32)
    return iy.mul_(columns).add_(ix)


def _noise(seed: int, capture: Capture, size: int) -> torch.Tensor:
    """Uniform sensor noise of −8 … 7 levels, int16, keyed by drone and millisecond."""
    rng = stream(seed, 0, (capture.drone, max(round(capture.t_s * 1e3), 0)), "camera.noise")
    return torch.from_numpy((np.frombuffer(rng.bytes(size), np.uint8) & 15).astype(np.int16) - 8)
