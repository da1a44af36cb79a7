"""A procedural town without edges: every block's content follows from the scene's seed and its index alone.

The world is ENU. Roads run along x = i·block_m and y = j·block_m; block (i, j) is the square between
them and owns its buildings, trees and the kerb spots on its own sides of the four roads. Across a road,
from its centre line: a lane to 3.2 m, kerb parking to 5.6 m, pavement to 8.1 m, then the lots.
`Town.tile` rasterises any 102.4 m square of it; nothing is rasterised before it is needed.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sortie.scenarios.schema import Scene
from sortie.scenarios.streams import stream

Floats = NDArray[np.float64]
FloatMap = NDArray[np.float32]
Bytes = NDArray[np.uint8]

LANE_M = 3.2
LANE_CENTRE_M = 1.6
KERB_M = 5.6
PARKING_CENTRE_M = 4.35
PAVEMENT_M = 8.1
TREE_LINE_M = 6.9

RES_M = 0.32
"""Raster resolution, m a pixel."""
TILE_PX = 320
TILE_M = RES_M * TILE_PX
_PAD_PX = 80  # 25.6 m around a tile at least, so that shadows cross its seams
_SHADE = 0.6  # light that is left in a shadow under a clear sky

CAR_COLOURS: Bytes = np.array(
    [
        (232, 232, 230),
        (198, 200, 204),
        (120, 122, 126),
        (42, 43, 47),
        (28, 44, 92),
        (150, 28, 26),
        (40, 92, 58),
        (196, 170, 110),
        (70, 120, 176),
        (212, 106, 34),
    ],
    dtype=np.uint8,
)
_COLOUR_SHARE = np.cumsum([0.24, 0.2, 0.14, 0.16, 0.08, 0.07, 0.03, 0.03, 0.03, 0.02])


@dataclass(frozen=True, slots=True)
class Style:
    """What lots of one style look like."""

    lot_m: float
    """A lot's side, roughly: as many as fit between the pavements."""
    fill: tuple[float, float]
    """The part of its lot's side that a house takes, least and most."""
    height: float
    """Factor on the scene's mean height of buildings."""
    gardens: int
    """Trees that an empty lot may hold; built lots too where `green`."""
    green: bool
    lawn: tuple[tuple[int, int, int], tuple[int, int, int]]
    """The two colours between which a lot's ground lies."""
    wall: tuple[tuple[int, int, int], tuple[int, int, int]]
    """The same of its roof."""


STYLES = {
    "town": Style(20.0, (0.5, 0.9), 1.0, 1, False, ((88, 118, 62), (150, 142, 120)), ((142, 78, 62), (172, 170, 168))),
    "old_town": Style(
        12.0, (0.75, 1.0), 1.1, 1, False, ((138, 130, 116), (158, 152, 140)), ((150, 74, 52), (132, 92, 74))
    ),
    "suburb": Style(26.0, (0.3, 0.5), 0.7, 3, True, ((76, 122, 56), (112, 132, 74)), ((120, 84, 70), (96, 96, 100))),
    "yard": Style(
        48.0, (0.55, 0.9), 0.9, 0, False, ((118, 118, 116), (146, 142, 134)), ((150, 154, 158), (186, 188, 190))
    ),
}
"""By the names of `Scene.style`."""


def zigzag(index: int) -> int:
    """Map a signed index to a non-negative one, one to one (seeds know no negative numbers)."""
    return 2 * index if index >= 0 else -2 * index - 1


@dataclass(frozen=True, slots=True)
class Bodies:
    """The shapes of n cars: `size_m` [n, 3] (length, width, height) and `colour` [n, 3] uint8."""

    size_m: Floats
    colour: Bytes


def draw_bodies(u: Floats, trucks: float = 0.0) -> Bodies:
    """Shapes from uniform draws `u` [n, 3]: 85 % cars (3.8–5.0 m), 15 % vans (5.0–5.8 m); a share may be trucks (7–9 m).

    Trucks stand between what traffic law calls a medium truck (6 m and longer in GA 802) and AASHTO's single-unit design
    vehicle (9.2 × 2.4 × 3.4–4.1 m), which is larger than most. They are as wide as 96/53/EC allows, 2.55 m, or nearly.
    """
    van = u[:, 0] > 0.85
    part = np.where(van, (u[:, 0] - 0.85) / 0.15, u[:, 0] / 0.85)
    length = np.where(van, 5.0 + 0.8 * part, 3.8 + 1.2 * part)
    width = np.where(van, 1.95 + 0.1 * u[:, 1], 1.7 + 0.25 * u[:, 1])
    height = np.where(van, 2.0 + 0.4 * u[:, 1], 1.4 + 0.3 * u[:, 1])
    if trucks > 0.0:
        truck = u[:, 0] > 1.0 - trucks
        part = (u[:, 0] - (1.0 - trucks)) / trucks
        length = np.where(truck, 7.0 + 2.0 * part, length)
        width = np.where(truck, 2.45 + 0.1 * u[:, 1], width)
        height = np.where(truck, 3.0 + 0.4 * u[:, 1], height)
    pick = np.minimum(np.searchsorted(_COLOUR_SHARE, u[:, 2] * _COLOUR_SHARE[-1]), len(CAR_COLOURS) - 1)
    return Bodies(np.stack([length, width, height], axis=1), CAR_COLOURS[pick])


@dataclass(frozen=True, slots=True)
class Block:
    """What stands in one block, world coordinates, metres.

    `lots` [n, 5]: x0, y0, x1, y1, tone 0…1; `buildings` [n, 6]: x0, y0, x1, y1, height, tone;
    `trees` [n, 5]: x, y, radius, height, tone; `parked` [n, 3]: x, y, yaw; `bodies`: their shapes;
    `spots` [n, 3]: which car of the town each of them is: i, j and its kerb spot in the block.
    """

    lots: Floats
    buildings: Floats
    trees: Floats
    parked: Floats
    bodies: Bodies
    spots: NDArray[np.int64]


@lru_cache(maxsize=1024)  # sorties that are compared fly over the same town
def block(scene: Scene, i: int, j: int) -> Block:
    """The content of block (i, j).

    Densities are thresholds on draws that do not depend on them: a denser town keeps what a sparser
    one with the same seed has, and adds to it.
    """
    rng = stream(scene.seed, 0, (zigzag(i), zigzag(j)), "town.block")
    size = scene.block_m
    x0, y0 = i * size, j * size
    inner = size - 2 * PAVEMENT_M

    style = STYLES[scene.style]
    n = max(1, int(inner // style.lot_m))
    pitch = inner / n
    gx, gy = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    u = rng.random((n * n, 8))
    lx = x0 + PAVEMENT_M + gx.ravel() * pitch
    ly = y0 + PAVEMENT_M + gy.ravel() * pitch
    lots = np.stack([lx, ly, lx + pitch, ly + pitch, u[:, 7]], axis=1)
    least, span = style.fill[0], style.fill[1] - style.fill[0]
    w, d = (least + span * u[:, 1]) * pitch, (least + span * u[:, 2]) * pitch
    bx, by = lx + u[:, 3] * (pitch - w), ly + u[:, 4] * (pitch - d)
    height = np.clip(scene.building_height_m * style.height * (0.5 + u[:, 5]), 2.5, 40.0)
    built = u[:, 0] < scene.building_density
    buildings = np.stack([bx, by, bx + w, by + d, height, u[:, 6]], axis=1)[built]

    sides = [
        # (start x, start y), unit vector along, lateral unit vector into the block, yaw of the adjacent lane
        ((x0, y0), (0.0, 1.0), (1.0, 0.0), np.pi / 2),
        ((x0 + size, y0), (0.0, 1.0), (-1.0, 0.0), -np.pi / 2),
        ((x0, y0), (1.0, 0.0), (0.0, 1.0), np.pi),
        ((x0, y0 + size), (1.0, 0.0), (0.0, -1.0), 0.0),
    ]
    tree_s = np.arange(12.0, size - 11.0, 10.0)
    spot_s = np.arange(13.0, size - 12.0, 7.0)
    trees, parked, bodies, taken = [], [], [], []
    for (sx, sy), along, inward, yaw in sides:
        u = rng.random((len(tree_s), 5))
        s, off = tree_s + 3.0 * (u[:, 1] - 0.5), TREE_LINE_M + 0.5 * (u[:, 4] - 0.5)
        row = np.stack(
            [
                sx + along[0] * s + inward[0] * off,
                sy + along[1] * s + inward[1] * off,
                1.3 + 1.4 * u[:, 2],
                3.5 + 5.0 * u[:, 3],
                u[:, 4],
            ],
            axis=1,
        )
        trees.append(row[u[:, 0] < scene.tree_density])
        may_park = rng.random() < 0.4  # elsewhere stopping is forbidden
        u = rng.random((len(spot_s), 7))
        s, off = spot_s + (u[:, 1] - 0.5), PARKING_CENTRE_M + 0.3 * (u[:, 2] - 0.5)
        row = np.stack(
            [
                sx + along[0] * s + inward[0] * off,
                sy + along[1] * s + inward[1] * off,
                yaw + np.radians(4.0) * (u[:, 3] - 0.5),
            ],
            axis=1,
        )
        stands = (u[:, 0] < scene.parked_density) & may_park
        taken.append(stands)
        parked.append(row[stands])
        bodies.append(u[stands][:, 4:7])

    for _ in range(style.gardens):
        u = rng.random((n * n, 6))
        gardens = np.stack(
            [
                lx + (0.2 + 0.6 * u[:, 1]) * pitch,
                ly + (0.2 + 0.6 * u[:, 2]) * pitch,
                1.5 + 2.0 * u[:, 3],
                4 + 5 * u[:, 4],
                u[:, 5],
            ],
            axis=1,
        )
        trees.append(gardens[(u[:, 0] < scene.tree_density) & (style.green | ~built)])
    shapes = draw_bodies(np.concatenate(bodies))
    spot = np.flatnonzero(np.concatenate(taken))
    spots = np.column_stack([np.full(len(spot), i), np.full(len(spot), j), spot])
    return Block(lots, buildings, np.concatenate(trees), np.concatenate(parked), shapes, spots)


@dataclass(frozen=True, slots=True)
class Tile:
    """Rasters of one 102.4 m square, [row = y, column = x], 0.32 m a pixel.

    `height_m` float32, `albedo` uint8 […, 3] with shadows in it, `light` float32 (1 in the sun).
    """

    height_m: FloatMap
    albedo: Bytes
    light: FloatMap


class Town:
    """Blocks and tiles of one scene, made when first needed and kept (tiles: the latest 64)."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._blocks: dict[tuple[int, int], Block] = {}
        self._tiles: OrderedDict[tuple[int, int], Tile] = OrderedDict()

    def block(self, i: int, j: int) -> Block:
        """Block (i, j), see `block`."""
        found = self._blocks.get((i, j))
        if found is None:
            found = self._blocks[i, j] = block(self.scene, i, j)
        return found

    def blocks(self, x0: float, y0: float, x1: float, y1: float) -> list[Block]:
        """All blocks that touch the rectangle (ENU, m)."""
        size = self.scene.block_m
        return [
            self.block(i, j)
            for i in range(int(np.floor(x0 / size)), int(np.floor(x1 / size)) + 1)
            for j in range(int(np.floor(y0 / size)), int(np.floor(y1 / size)) + 1)
        ]

    def tile(self, ix: int, iy: int) -> Tile:
        """The tile whose south-west corner is (ix, iy) · 102.4 m."""
        key = (ix, iy)
        found = self._tiles.get(key)
        if found is None:
            found = self._tiles[key] = self._rasterise(ix, iy)
            if len(self._tiles) > 64:
                self._tiles.popitem(last=False)
        else:
            self._tiles.move_to_end(key)
        return found

    def _rasterise(self, ix: int, iy: int) -> Tile:
        style = STYLES[self.scene.style]
        longest_m = np.hypot(*shadow_m(self.scene)) * min(40.0, 1.5 * self.scene.building_height_m * style.height)
        pad = max(_PAD_PX, 4 * int(np.ceil(longest_m / RES_M / 4)))
        x0, y0 = ix * TILE_M - pad * RES_M, iy * TILE_M - pad * RES_M
        size = TILE_PX + 2 * pad
        side = size * RES_M
        blocks = self.blocks(x0 - 4.0, y0 - 4.0, x0 + side + 4.0, y0 + side + 4.0)
        cx, cy = x0 + (np.arange(size) + 0.5) * RES_M, y0 + (np.arange(size) + 0.5) * RES_M
        height = np.zeros((size, size), np.float32)
        colour = _ground(cx, cy, self.scene.block_m)

        def rect(x_0: float, y_0: float, x_1: float, y_1: float) -> tuple[slice, slice]:
            a, b = np.searchsorted(cx, (x_0, x_1))
            c, d = np.searchsorted(cy, (y_0, y_1))
            return slice(c, d), slice(a, b)

        for b in blocks:
            for lot in b.lots:
                colour[rect(*lot[:4])] = _mix(*style.lawn, lot[4])
            for one in b.buildings:
                at = rect(*one[:4])
                height[at] = one[4]
                colour[at] = _mix(*style.wall, one[5])
                inner = rect(one[0] + 0.8, one[1] + 0.8, one[2] - 0.8, one[3] - 0.8)
                colour[inner] *= 0.88
        trees = [t for b in blocks for t in b.trees]
        for x, y, radius, top, tone in trees:
            at = rect(x - radius, y - radius, x + radius, y + radius)
            part = ((cx[at[1]][None, :] - x) ** 2 + (cy[at[0]][:, None] - y) ** 2) / radius**2
            inside = (part < 1.0) & (height[at] < top)
            dome = (top * (1.0 - 0.35 * part)).astype(np.float32)
            height[at] = np.where(inside, dome, height[at])
            leaf = _mix((34, 70, 30), (74, 104, 44), tone) * (1.05 - 0.35 * part[..., None])
            colour[at] = np.where(inside[..., None], leaf, colour[at])
        light = _shadows(height, self.scene)
        rng = stream(self.scene.seed, 0, (zigzag(ix), zigzag(iy)), "town.texture")
        grain = rng.random((size // 4, size // 4), dtype=np.float32).repeat(4, 0).repeat(4, 1)
        fine = rng.random((size, size), dtype=np.float32)
        colour *= (light * (0.86 + 0.14 * grain + 0.14 * fine))[..., None]
        cut = slice(pad, pad + TILE_PX)
        return Tile(
            np.ascontiguousarray(height[cut, cut]),
            np.clip(colour[cut, cut], 0, 255).astype(np.uint8),
            np.ascontiguousarray(light[cut, cut]),
        )


def _mix(a: tuple[int, int, int], b: tuple[int, int, int], part: float) -> FloatMap:
    return np.asarray(a, np.float32) * (1 - part) + np.asarray(b, np.float32) * part


def _ground(cx: NDArray[Any], cy: NDArray[Any], block_m: float) -> FloatMap:
    """Road, marking, kerb, pavement and grass colours by distance from the nearest road centre lines."""
    fx = np.abs((cx / block_m + 0.5) % 1.0 - 0.5) * block_m
    fy = np.abs((cy / block_m + 0.5) % 1.0 - 0.5) * block_m
    near = np.minimum(fx[None, :], fy[:, None])
    far = np.maximum(fx[None, :], fy[:, None])
    out = np.empty((len(cy), len(cx), 3), np.float32)
    out[...] = (98, 126, 70)
    out[near < PAVEMENT_M] = (158, 154, 146)
    out[near < KERB_M + 0.2] = (188, 186, 180)
    out[near < KERB_M] = (92, 92, 94)
    out[near < LANE_M] = (82, 82, 86)
    along = np.where(fx[None, :] < fy[:, None], cy[:, None], cx[None, :])
    dash = (near < 0.24) & (along % 6.0 < 3.0) & (far > KERB_M + 4.0)
    edge = (np.abs(near - LANE_M) < 0.17) & (far > KERB_M + 1.0)
    stop = (near < LANE_M) & (np.abs(far - KERB_M - 2.0) < 0.3)
    out[dash | stop] = (214, 214, 206)
    out[edge] = (140, 140, 140)
    return out


def shadow_m(scene: Scene) -> tuple[float, float]:
    """How far a shadow falls (x, y) in metres for each metre of height."""
    long = 1.0 / np.tan(np.radians(scene.sun_elevation_deg))
    away = np.radians(scene.sun_azimuth_deg)
    return float(-long * np.cos(away)), float(-long * np.sin(away))


def _shadows(height: FloatMap, scene: Scene) -> FloatMap:
    """Light on each pixel, 1 or the shade: a pixel is dark if something towards the sun stands above the ray to it."""
    if scene.overcast >= 1.0:
        return np.ones(height.shape, np.float32)
    sun_x, sun_y = shadow_m(scene)
    lit = np.full(height.shape, -1e3, np.float32)
    top = float(height.max())
    step_m = 1.0
    rows, columns = height.shape
    for k in range(1, int(top / step_m) + 1):
        dx, dy = round(sun_x * k * step_m / RES_M), round(sun_y * k * step_m / RES_M)
        if abs(dx) >= columns or abs(dy) >= rows:
            break
        to = slice(max(dy, 0), rows + min(dy, 0)), slice(max(dx, 0), columns + min(dx, 0))
        of = slice(max(-dy, 0), rows + min(-dy, 0)), slice(max(-dx, 0), columns + min(-dx, 0))
        np.maximum(lit[to], height[of] - k * step_m, out=lit[to])
    shade = np.float32(_SHADE + (1 - _SHADE) * scene.overcast)
    return np.where(lit > height + 0.1, shade, np.float32(1.0))
