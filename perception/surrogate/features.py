"""Covariates of detection: who looks at a car, from where, and what is in between. Free of torch.

A *look* is one capture and one car in its ±102.4 m square. Everything here follows from geometry and the scene's
description; nothing is rendered. Looks of many captures are worked out at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from sortie.perception.classes import TRUCK, vehicle_classes
from sortie.perception.geometry import FULL, USUAL, Lens, camera_margins
from sortie.perception.scene.behind_trucks import behind
from sortie.perception.scene.height_field import CAR_TOP_M, TRUCK_TOP_M
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.town import Floats
from sortie.perception.scene.traffic import TARGET_COLOUR, TARGET_SIZE_M
from sortie.perception.surrogate.kerbs import Kerbs, next_of
from sortie.perception.types import Capture

Ints = NDArray[np.intp]
LOOK_COVARIATES = (
    "range",
    "nadir",
    "margin",
    "visible",
    "across",
    "tone",
    "tint",
    "moving",
    "length",
    "lit",
    "shade",
    "brightness",
    "crowd",
    "altitude",
    "strange",
    "square",
    "next",
    "next_along",
    "next_across",
)
LEARNED_AT_M = 60.0
"""The height at which networks are trained: what is higher or lower is strange to them."""
NEXT_M = 8.0
"""A car that stands farther away from the next one has none."""
LARGEST_M = (5.8, 2.05)
"""The largest vehicle that the calibration knows, a van. A truck is seen as one: the network gives it a box like a car's, and
so does the surrogate (`perception/README.md`)."""
SQUARE_RAD = np.radians(3.0)
_ROAD_TONE, _TONE = 0.34, np.array([0.299, 0.587, 0.114]) / 255.0


@dataclass(frozen=True, slots=True)
class CaptureColumns:
    """Captures as columns: `t_s` [c], `position_m` [c, 3], `est` [c, 3] (x, y, yaw), `yaw_rad` [c], `tilt` [c, 3, 3] (body to level), `stretch` [c]
    the height that the lift believes over the height there is: by that much its map is too large. `lens` holds numbers
    where all cameras are alike, else arrays [c]."""

    t_s: Floats
    position_m: Floats
    est: Floats
    yaw_rad: Floats
    tilt: Floats
    stretch: Floats
    lens: Lens

    def lens_at(self, capture: Ints) -> Lens:
        """The lens of some captures [n], or of all."""
        first = self.lens.half_h
        return Lens(*(v[capture] for v in self.lens)) if isinstance(first, np.ndarray) else self.lens

    @classmethod
    def of(cls, captures: Sequence[Capture]) -> CaptureColumns:
        t_s = np.array([c.t_s for c in captures])
        position = np.array([c.position_m for c in captures]).reshape(-1, 3)
        est = np.array([(c.est_position_m[0], c.est_position_m[1], c.est_yaw_rad) for c in captures]).reshape(-1, 3)
        x, y, z, w = np.array([c.orientation_xyzw for c in captures]).reshape(-1, 4).T
        yaw = np.arctan2(2 * (x * y + z * w), 1 - 2 * (y * y + z * z))
        body = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        ).transpose(2, 0, 1)
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        tilt = np.stack([c * body[:, 0] + s * body[:, 1], c * body[:, 1] - s * body[:, 0], body[:, 2]], axis=1)
        stretch = np.array([c.est_position_m[2] for c in captures]) / np.maximum(position[:, 2], 1.0)
        alike = len({c.cameras for c in captures}) < 2
        first = captures[0].cameras if len(captures) else USUAL
        lens = first.lens if alike else Lens(*np.array([c.cameras.lens for c in captures]).T)
        return cls(t_s, position, est, yaw, tilt, stretch, lens)


@dataclass(frozen=True, slots=True)
class Looks:
    """n looks, capture by capture, cars ascending: `capture` [n], `car` [n] (column of `Traffic`), `xy_m` [n, 2] where the
    drone's map shows the car, in its level frame, `world_m` [n, 2] and `yaw_rad` [n] the same in ENU, `covariates` [n, 19] float32 as
    `LOOK_COVARIATES`, `index` [c, cars] (−1: no look); those of capture c are `first[c]` to `first[c + 1]`."""

    capture: Ints
    car: Ints
    xy_m: Floats
    world_m: Floats
    yaw_rad: Floats
    covariates: NDArray[np.float32]
    index: NDArray[np.int32]
    first: Ints


class Traffic:
    """Every car of a scene as columns, parked ones first, then moving ones, then the targets."""

    def __init__(self, scene: SceneModel) -> None:
        parked, lanes, extra = scene.parked_cars, scene._lanes, len(scene.targets)
        self._lanes, self._targets = lanes, scene.targets
        self.parked, self.count = len(parked), len(parked) + len(lanes.s0_m) + extra
        ids = scene._parked_ids, scene._moving_ids, np.arange(extra)
        self.ids: NDArray[np.int32] = np.concatenate(ids).astype(np.int32)
        """[cars] as `Cars.ids`."""
        targets = np.array([(3, k, 0, 0) for k in range(extra)], np.int64).reshape(-1, 4)
        spots = np.insert(scene._parked_spots, 0, 2, axis=1)
        self.identity: NDArray[np.int64] = np.concatenate([spots, lanes.slot, targets])
        """[cars, 4] which car of the town each is; it does not depend on the scene's bounds. A moving car has its `Lanes.slot`,
        so it is the same car when the pattern repeats. A parked one has 2 and its `Block.spots`, a target 3, its number and 0."""
        size = [
            np.stack([parked.length_m, parked.width_m], 1),
            lanes.size_m[:, :2],
            np.tile(TARGET_SIZE_M[:2], (extra, 1)),
        ]
        self.size_m: Floats = np.concatenate(size)
        self.seen_size_m: Floats = np.minimum(self.size_m, LARGEST_M)
        """As the network takes them to be."""
        self.truck = vehicle_classes(self.size_m[:, 0]) == TRUCK
        colour = np.concatenate([parked.colour, lanes.colour, np.tile(np.array(TARGET_COLOUR, np.uint8), (extra, 1))])
        self.tone: Floats = np.einsum("nc,c->n", colour, _TONE)
        self.tint: Floats = (colour.max(axis=1).astype(float) - colour.min(axis=1)) / 255.0
        self.parked_xy: Floats = np.stack([parked.x_m, parked.y_m], 1)
        self._next_parked = next_of(self.parked_xy)
        self._yaw = np.concatenate([parked.yaw_rad, lanes.yaw_rad, np.zeros(extra)])

    def at(self, t_s: Floats, parked: Ints) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Where some parked cars (their indices) and, after them, all others are at times [t]: xy [t, k, 2], yaw [t, k], and
        whether they are in the scene [t, k]."""
        n, first, lanes = len(t_s), len(parked), self._lanes
        moving = slice(first, first + len(lanes.s0_m))
        count = first + self.count - self.parked
        xy, there = np.empty((n, count, 2)), np.ones((n, count), bool)
        yaw = np.broadcast_to(np.concatenate([self._yaw[parked], self._yaw[self.parked :]]), (n, count))
        xy[:, :first] = self.parked_xy[parked]
        s = lanes.low_m + np.mod(lanes.s0_m + lanes.speed_mps * t_s[:, None] - lanes.low_m, lanes.period_m)
        xy[:, moving, 0] = np.where(lanes.east, s, lanes.lateral_m)
        xy[:, moving, 1] = np.where(lanes.east, lanes.lateral_m, s)
        there[:, moving] = s <= lanes.limit_m
        if self._targets:
            yaw = yaw.copy()
            for k, path in enumerate(self._targets, start=count - len(self._targets)):
                pose = np.array([path.pose(t) for t in t_s.tolist()])
                xy[:, k], yaw[:, k] = pose[:, :2], pose[:, 2]
        return xy, yaw, there

    def next_to(self, parked: Ints, xy: Floats, there: NDArray[np.bool_]) -> Floats:
        """From every car to the one next to it [t, k, 2], of cars as `at` gives them; inf where none is within 8 m."""
        first = len(parked)
        out = np.full(xy.shape, np.inf)
        out[:, :first] = self._next_parked[parked]
        moment, k = np.nonzero(there[:, first:])
        places = xy[moment, first + k]
        # moments lie apart along a third axis, so that no car is next to one of another moment
        moving = cKDTree(np.column_stack([places, 4.0 * NEXT_M * moment]))
        one, other = moving.query_pairs(NEXT_M + 0.01, output_type="ndarray").T
        past = cKDTree(places).sparse_distance_matrix(
            cKDTree(self.parked_xy[parked]), NEXT_M + 0.01, output_type="ndarray"
        )
        mover, stands = past["i"], past["j"]
        passing = _squared(self.parked_xy[parked[stands]] - places[mover])
        between = _squared(places[other] - places[one])
        me, around = np.concatenate([mover, one, other]), np.concatenate([stands, first + k[other], first + k[one]])
        best = _least(me, np.concatenate([passing, between, between]), around)
        me, around = me[best], around[best]
        out[moment[me], first + k[me]] = xy[moment[me], around] - places[me]
        best = _least(moment[mover] * first + stands, passing, mover)
        mover, stands, passing = mover[best], stands[best], passing[best]
        closer = passing < _squared(out[moment[mover], stands])
        mover, stands = mover[closer], stands[closer]
        out[moment[mover], stands] = places[mover] - self.parked_xy[parked[stands]]
        out[out[..., 0] ** 2 + out[..., 1] ** 2 > NEXT_M**2] = np.inf
        return out


class Eyes:
    """Works out looks over one scene."""

    def __init__(self, scene: SceneModel) -> None:
        self.traffic = Traffic(scene)
        self._field, self._kerbs = scene.height_field, Kerbs(scene)
        self._trucks_at = scene.trucks if self.traffic.truck.any() else None
        config = scene.config
        self._light = np.array([config.overcast, config.brightness, 1.0 / np.tan(np.radians(config.sun_elevation_deg))])
        parked = self.traffic.parked_xy
        self._lit = self._field.lit(parked[:, 0], parked[:, 1])

    def look(self, fleet: CaptureColumns, *, bare: bool = False) -> Looks:
        """All looks of the captures; `bare` leaves the covariates out."""
        traffic, half = self.traffic, FULL.half_extent_m
        where = fleet.position_m[:, :2]
        low, high = where.min(axis=0, initial=np.inf) - 1.5 * half, where.max(axis=0, initial=-np.inf) + 1.5 * half
        parked = np.flatnonzero(((traffic.parked_xy > low) & (traffic.parked_xy < high)).all(axis=1))
        times, which = np.unique(fleet.t_s, return_inverse=True)
        xy, yaw, there = traffic.at(times, parked)
        # differences in double precision: a car's place must not depend on what else is computed
        x, y = ((xy[which, :, k] - where[:, k, None]).astype(np.float32) for k in (0, 1))
        c, s = np.cos(fleet.yaw_rad).astype(np.float32)[:, None], np.sin(fleet.yaw_rad).astype(np.float32)[:, None]
        near = np.abs(c * x + s * y) < half
        near &= np.abs(c * y - s * x) < half
        near &= there[which]
        capture, among = np.nonzero(near)
        x, y, c, s = x[capture, among], y[capture, among], c[capture, 0], s[capture, 0]
        local = np.stack([c * x + s * y, c * y - s * x], axis=1).astype(np.float64)
        car = np.concatenate([parked, np.arange(traffic.parked, traffic.count)])[among]
        index = np.full((len(where), traffic.count), -1, np.int32)
        index[capture, car] = np.arange(len(capture))
        at = which[capture]
        world, turn = xy[at, among], yaw[at, among]
        covariates = np.zeros((0, 0), np.float32)
        if not bare:
            there &= ((xy > low) & (xy < high)).all(axis=-1)
            beside_it = traffic.next_to(parked, xy, there)[at, among]
            covariates = self._covariates(fleet, capture, car, local, world, turn, beside_it)
        first = np.searchsorted(capture, np.arange(len(where) + 1))
        return Looks(capture, car, local * fleet.stretch[capture, None], world, turn, covariates, index, first)

    def _covariates(
        self, fleet: CaptureColumns, capture: Ints, car: Ints, local: Floats, xy: Floats, yaw: Floats, beside_it: Floats
    ) -> NDArray[np.float32]:
        traffic = self.traffic
        eye = fleet.position_m[capture]
        reach = np.hypot(local[:, 0], local[:, 1])
        tilt = np.moveaxis(fleet.tilt, 0, 2)[..., capture]
        nadir, margin = _in_view(tilt, local, eye[:, 2], fleet.lens_at(capture))
        along = 0.35 * traffic.seen_size_m[car, 0, None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        points = (xy - along, xy, xy + along)
        visible = sum(self._seen(p, eye, fleet.t_s[capture], traffic.truck[car]).astype(np.float32) for p in points)
        moving = car >= traffic.parked
        crowd = np.empty(len(car), np.float32)
        crowd[~moving], crowd[moving] = self._kerbs.parked[car[~moving]], self._kerbs.near(xy[moving, 0], xy[moving, 1])
        bearing = np.arctan2(local[:, 1], local[:, 0]) + fleet.yaw_rad[capture]
        lit = np.empty(len(car), bool)
        lit[~moving] = self._lit[car[~moving]]
        lit[moving] = self._field.lit(xy[moving, 0], xy[moving, 1])
        beside_m = np.hypot(*beside_it.T)
        close = np.maximum(0.0, 1.0 - beside_m / NEXT_M)
        way = np.where(close[:, None] > 0.0, beside_it, 0.0) / np.clip(beside_m, 0.1, NEXT_M)[:, None]
        way = on_axes(way, *axes(yaw, xy - eye[:, :2])) * close[:, None]
        overcast, brightness, length = self._light
        shade = (1.0 - overcast) * min(length, 2.5)
        light = np.where(lit, 1.0, 0.6 + 0.4 * overcast)
        columns = (
            reach / 100.0,
            nadir,
            np.clip(margin, -0.4, 0.4),
            visible / 3.0,
            np.abs(np.sin(yaw - bearing)),
            (traffic.tone[car] * light - _ROAD_TONE) * brightness,
            traffic.tint[car] * light * brightness,
            moving,
            traffic.seen_size_m[car, 0] - 4.6,
            lit,
            shade,
            brightness - 1.0,
            crowd,
            eye[:, 2] / LEARNED_AT_M - 1.0,
            np.abs(eye[:, 2] / LEARNED_AT_M - 1.0),
            square(yaw - fleet.yaw_rad[capture]),
            close,
            way[:, 0],
            way[:, 1],
        )
        return beside(len(car), columns)

    def _seen(self, xy: Floats, eye: Floats, t_s: Floats, truck: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Whether points [n, 2] of vehicles are seen: over roofs and crowns, and past trucks."""
        seen = self._field.seen(xy[:, 0], xy[:, 1], eye)
        if self._trucks_at is None:
            return seen
        seen[truck] = self._field.seen(xy[truck, 0], xy[truck, 1], eye[truck], TRUCK_TOP_M)
        for now_s in np.unique(t_s).tolist():
            here = np.flatnonzero((t_s == now_s) & ~truck)
            seen[here] &= ~behind(self._trucks_at(now_s), xy[here], eye[here], CAR_TOP_M)
        return seen


def _squared(xy: Floats) -> Floats:
    """The squared lengths of vectors [n, 2]."""
    return np.asarray(xy[:, 0] ** 2 + xy[:, 1] ** 2)


def _least(group: Ints, value: Floats, tie: Ints) -> Ints:
    """The row with the least value in each group; of equal ones that with the least `tie`."""
    order = np.lexsort((tie, value, group))
    return np.asarray(order[np.unique(group[order], return_index=True)[1]])


def square(turn_rad: Floats) -> Floats:
    """How nearly what is turned by this stands along or across a map's cells: 1 if it does, a half at 2° off. A network
    of cells finds such cars less well, the more so if it was trained on headings of every kind."""
    off = np.abs((turn_rad + np.pi / 4) % (np.pi / 2) - np.pi / 4)
    return np.asarray(np.exp(-off / SQUARE_RAD))


def beside(rows: int, columns: Sequence[ArrayLike]) -> NDArray[np.float32]:
    """Columns (or one value for all rows) beside one another, [rows, columns]; each is rounded as it is put in."""
    out = np.empty((rows, len(columns)), np.float32)
    for k, column in enumerate(columns):
        out[:, k] = column
    return out


def _in_view(tilt: Floats, local: Floats, height_m: Floats, lens: Lens) -> tuple[NDArray[np.bool_], Floats]:
    """Whether the camera that looks down sees the point, and how far inside the camera that the lift asks it lies (1 in its middle).

    `tilt` is [3, 3, n], so that each of its numbers is a run in memory."""
    ahead_m, left_m, drop_m = local[:, 0], local[:, 1], height_m - 0.8
    x, y, z = (tilt[0, k] * ahead_m + tilt[1, k] * left_m - tilt[2, k] * drop_m for k in range(3))
    down, side = camera_margins(x, y, z, lens)
    return down > 0.0, np.maximum(down, side)


def turned(xy: Floats, by_rad: Floats) -> Floats:
    """Vectors [n, 2], each turned by its angle [n]."""
    c, s = np.cos(by_rad), np.sin(by_rad)
    return np.stack([c * xy[:, 0] - s * xy[:, 1], s * xy[:, 0] + c * xy[:, 1]], axis=1)


def axes(yaw_rad: Floats, xy_m: Floats) -> tuple[Floats, Floats]:
    """A car's own axes, pointing away from the drone that looks: the angle [n] of the one along it, and on which side of that
    (1 left, −1 right) the other one lies. Boxes are off along a car far more than across it, and lean away."""
    bearing = np.arctan2(xy_m[:, 1], xy_m[:, 0])
    angle = np.where(np.cos(yaw_rad - bearing) >= 0, yaw_rad, yaw_rad + np.pi)
    return angle, np.where(np.sin(bearing - angle) >= 0, 1.0, -1.0)


def on_axes(xy: Floats, angle: Floats, hand: Floats) -> Floats:
    """Vectors [n, 2] on such axes."""
    return turned(xy, -angle) * np.stack([np.ones(len(hand)), hand], axis=1)


def off_axes(uv: Floats, angle: Floats, hand: Floats) -> Floats:
    """And back."""
    return turned(uv * np.stack([np.ones(len(hand)), hand], axis=1), angle)
