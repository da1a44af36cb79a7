"""Cars as a pure function of time: parked cars, lanes of moving cars, and the mission's target.

Every lane of every road carries a stream of cars that all drive at the lane's own speed, so that none
overtakes; the stream repeats every 1,280 m. Position along a lane is closed-form in t: nothing is
stepped, and moments may be computed in any order. Cars drive straight over crossings without
giving way, so two crossing cars may touch there for a moment (about one crossing in fifty at 10 cars/km).
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sortie.perception.scene.town import LANE_CENTRE_M, Bytes, Floats, Town, draw_bodies, zigzag
from sortie.scenarios.schema import Scene, Target
from sortie.scenarios.streams import stream

SLOT_M = 10.0
PATTERN_M = 1280.0
TARGET_ID = 0
TARGET_SIZE_M = (4.6, 1.9, 1.6)
TARGET_COLOUR = (212, 30, 36)


@dataclass(frozen=True, slots=True)
class Cars:
    """n cars at one moment, ENU: `ids` [n] int64, `x_m`, `y_m`, `yaw_rad`, `length_m`, `width_m`, `height_m` [n], `colour` [n, 3] uint8."""

    ids: NDArray[np.int64]
    x_m: Floats
    y_m: Floats
    yaw_rad: Floats
    length_m: Floats
    width_m: Floats
    height_m: Floats
    colour: Bytes

    def __len__(self) -> int:
        return len(self.ids)

    def table(self) -> Floats:
        """[n, 5]: x, y, length, width, yaw."""
        return np.stack([self.x_m, self.y_m, self.length_m, self.width_m, self.yaw_rad], axis=1)

    def where(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> Cars:
        """The cars that a mask [n] marks, or those at the given indices, in that order."""
        return Cars(*(getattr(self, name)[which] for name in self.__slots__))


def join(a: Cars, b: Cars) -> Cars:
    """The cars of a, then those of b."""
    return Cars(*(np.concatenate([getattr(a, name), getattr(b, name)]) for name in Cars.__slots__))


@dataclass(frozen=True, slots=True)
class Lanes:
    """All moving cars over a rectangle, one row a car.

    `s0_m` at t = 0 along the lane, `speed_mps` signed, `low_m` and `period_m` of the wrap, `limit_m` where
    the rectangle ends, `lateral_m` the fixed coordinate, `east` whether it drives along x. `slot` [n, 4] is which
    car of the town it is: axis (0 along x, 1 along y), road, direction (1 or −1) and slot of the pattern. It does not depend
    on the rectangle.
    """

    s0_m: Floats
    speed_mps: Floats
    low_m: Floats
    limit_m: Floats
    period_m: Floats
    lateral_m: Floats
    east: NDArray[np.bool_]
    yaw_rad: Floats
    size_m: Floats
    colour: Bytes
    slot: NDArray[np.int64]

    def position_m(self, t_s: float) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """x, y and whether the car is inside the rectangle at `t_s`."""
        s = self.low_m + np.mod(self.s0_m + self.speed_mps * t_s - self.low_m, self.period_m)
        return np.where(self.east, s, self.lateral_m), np.where(self.east, self.lateral_m, s), s <= self.limit_m


def lanes(scene: Scene, rect: tuple[float, float, float, float]) -> Lanes:
    """The moving cars over the rectangle (x0, y0, x1, y1), ENU metres, with right-hand traffic.

    A lane's stream is keyed by road and direction alone; within it a 10 m slot holds a car if its draw is
    below moving_cars_per_km / 100.
    """
    x0, y0, x1, y1 = rect
    rows: list[tuple[float, ...]] = []
    shapes: list[Floats] = []
    slots = int(PATTERN_M / SLOT_M)
    for axis, (low, high, across_low, across_high) in enumerate(((x0, x1, y0, y1), (y0, y1, x0, x1))):
        copies = int(np.ceil((high - low + SLOT_M) / PATTERN_M))
        for road in range(
            int(np.ceil((across_low - 4.0) / scene.block_m)), int(np.floor((across_high + 4.0) / scene.block_m)) + 1
        ):
            for sense in (1, -1):
                rng = stream(scene.seed, 0, (axis, zigzag(road), (sense + 1) // 2), "town.lane")
                speed = sense * scene.moving_speed_mps * (0.75 + 0.5 * rng.random())
                u = rng.random((slots, 5))
                side = -sense if axis == 0 else sense  # keep right: eastbound south of the line, northbound east of it
                lateral = road * scene.block_m + side * LANE_CENTRE_M
                yaw = (0.0 if sense > 0 else np.pi) if axis == 0 else sense * np.pi / 2
                for k in np.flatnonzero(u[:, 0] < scene.moving_cars_per_km / 100.0).tolist():
                    off = 0.0 if u[k, 2] > 1.0 - scene.trucks else 0.4 * (u[k, 1] - 0.5)  # a truck fills its slot
                    for copy in range(copies):
                        s0 = (k + 0.5 + off) * SLOT_M + copy * PATTERN_M
                        rows.append((s0, speed, low, high, copies * PATTERN_M, lateral, yaw, axis, road, sense, k))
                        shapes.append(u[k, 2:5])
    table = np.array(rows, dtype=np.float64).reshape(-1, 11)
    bodies = draw_bodies(np.array(shapes, dtype=np.float64).reshape(-1, 3), scene.trucks)
    (s0, speed_, low_, limit_, period_, lateral_, yaw_), slot = table[:, :7].T, table[:, 7:].astype(np.int64)
    east = slot[:, 0] == 0
    return Lanes(s0, speed_, low_, limit_, period_, lateral_, east, yaw_, bodies.size_m, bodies.colour, slot)


@dataclass(frozen=True, slots=True)
class TargetPath:
    """A target's or a person's path by arc length: `at_s_m` [k] distances of `points_m` [k] (x, y), `yaw_rad` [k − 1] of its legs."""

    points_m: list[tuple[float, float]]
    at_s_m: list[float]
    yaw_rad: list[float]
    speed_mps: float

    @classmethod
    def of(cls, target: Target) -> TargetPath:
        points = np.asarray(target.waypoints_m, dtype=np.float64)
        steps = np.hypot(*np.diff(points, axis=0).T)
        keep = np.concatenate([[True], steps > 1e-9])  # a waypoint given twice is passed once
        points = points[keep]
        dx, dy = np.diff(points, axis=0).T
        at = np.concatenate([[0.0], np.cumsum(np.hypot(dx, dy))])
        return cls([(x, y) for x, y in points.tolist()], at.tolist(), np.arctan2(dy, dx).tolist(), target.speed_mps)

    def pose(self, t_s: float) -> tuple[float, float, float]:
        """x, y and yaw at `t_s`; before the begin and after the end it stands."""
        points, at = self.points_m, self.at_s_m
        if len(points) == 1:
            return *points[0], 0.0
        s = min(max(self.speed_mps * t_s, 0.0), at[-1])
        leg = min(bisect_right(at, s), len(points) - 1)
        (ax, ay), (bx, by) = points[leg - 1], points[leg]
        part = (s - at[leg - 1]) / (at[leg] - at[leg - 1])
        return ax + part * (bx - ax), ay + part * (by - ay), self.yaw_rad[leg - 1]


def parked(town: Town, rect: tuple[float, float, float, float]) -> tuple[Floats, Floats, Bytes, NDArray[np.int64]]:
    """Parked cars in the rectangle: pose [n, 3] (x, y, yaw), size [n, 3], colour [n, 3], and `Block.spots` [n, 3]."""
    found = town.blocks(*rect)
    pose = np.concatenate([b.parked for b in found])
    size = np.concatenate([b.bodies.size_m for b in found])
    colour = np.concatenate([b.bodies.colour for b in found])
    spots = np.concatenate([b.spots for b in found])
    x0, y0, x1, y1 = rect
    inside = (pose[:, 0] >= x0) & (pose[:, 0] <= x1) & (pose[:, 1] >= y0) & (pose[:, 1] <= y1)
    return pose[inside], size[inside], colour[inside], spots[inside]
