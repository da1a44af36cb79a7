"""A smooth flight along a way of steps: each has a velocity that it keeps for a time.

Such a way's velocity is a staircase in time. Each of its jumps is spread as the route's corners are
(`sortie.fleet.flight.route.spread`), so the flight is C³, exact where no jump is near, and passes inside its corners.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sortie.fleet.flight.route import FramePath, bend, spread, turns
from sortie.scenarios.schema import FlightGroup, Leg

Array = npt.NDArray[np.float64]
Point = tuple[float, float, float]


class Step(NamedTuple):
    """A velocity that is kept for a time."""

    velocity_mps: Point
    lasts_s: float


class Staircase:
    """The smooth flight along steps; it begins at the first step's velocity, and stands after the last."""

    def __init__(self, start_m: Point, steps: Sequence[Step], width_s: float) -> None:
        """Args:
        start_m: where it begins.
        steps: in order; there may be none.
        width_s: the time over which each change of velocity is spread, > 0.
        """
        velocities = np.array([step.velocity_mps for step in steps] or [(0.0, 0.0, 0.0)])
        lasts_s = np.array([step.lasts_s for step in steps] or [1.0])
        self._velocity_mps = np.concatenate([velocities, np.zeros((1, 3))])
        self.begins_s: Array = np.concatenate([[0.0], np.cumsum(lasts_s)])
        """When each step begins, and the standing after the last."""
        self._corner_m = np.array(start_m) + np.concatenate(
            [np.zeros((1, 3)), np.cumsum(velocities * lasts_s[:, None], axis=0)]
        )
        self._width_s = width_s

    def at(self, time_s: Array) -> tuple[Array, Array, Array]:
        """Position, velocity and acceleration at times ≥ 0 in order: [T, 3] each."""
        step = np.searchsorted(self.begins_s, time_s, side="right") - 1
        velocity = self._velocity_mps[step]
        position = self._corner_m[step] + velocity * (time_s - self.begins_s[step])[:, None]
        acceleration = np.zeros_like(position)
        half_s = self._width_s / 2
        for k, jump in enumerate(np.diff(self._velocity_mps, axis=0), start=1):
            at_s = self.begins_s[k]
            near = slice(*np.searchsorted(time_s, (at_s - half_s, at_s + half_s)))
            if near.start == near.stop or not jump.any():
                continue
            since_s = time_s[near] - at_s
            ramp, rise, slope = spread(since_s, self._width_s)
            position[near] += (ramp - np.maximum(since_s, 0.0))[:, None] * jump
            velocity[near] += (rise - (since_s >= 0.0))[:, None] * jump
            acceleration[near] += slope[:, None] * jump
        return position, velocity, acceleration


class GroupPath(NamedTuple):
    """A group's frame and its height over time."""

    frame: FramePath
    height_m: Array  # [T]
    climb_mps: Array
    climb_mps2: Array


class GroupWay:
    """The way of a group that takes off, or that flies legs after its route."""

    def __init__(self, group: FlightGroup) -> None:
        start_m = (*group.route.waypoints_m[0], 0.0 if group.take_off else group.formation.altitude_m)
        steps = list(_steps(group, start_m))
        self._way = Staircase(start_m, steps, group.route.turn_time_s)
        self.end_s = float(self._way.begins_s[-1]) + group.route.turn_time_s / 2
        """When it stands after its last leg; then it lands, if it does."""
        self.up_s = float(self._way.begins_s[2]) + group.route.turn_time_s / 2 if group.take_off else 0.0
        """When it has climbed to its altitude."""
        moves = [(at_s, s) for at_s, s in zip(self._way.begins_s, steps, strict=False) if any(s.velocity_mps[:2])]
        course = np.array([math.atan2(s.velocity_mps[1], s.velocity_mps[0]) for _, s in moves] or [0.0])
        self._course, self._turn_s = course[0], np.array([at_s for at_s, _ in moves[1:]])
        self._turn, self._width_s = turns(course, group.route.turn_time_s, group.formation.spacing_m)

    def at(self, time_s: Array) -> GroupPath:
        """The group's frame and its height at times ≥ 0 in order."""
        position, velocity, acceleration = self._way.at(time_s)
        since_s = time_s[:, None] - self._turn_s
        _, turned, turning = spread(since_s, self._width_s)
        yaw, rate, rate_change = (
            np.asarray(np.einsum("tw,w->t", parts, self._turn))
            for parts in (turned, turning, bend(since_s, self._width_s))
        )
        frame = FramePath(position[:, :2], velocity[:, :2], acceleration[:, :2], self._course + yaw, rate, rate_change)
        return GroupPath(frame, position[:, 2], velocity[:, 2], acceleration[:, 2])


def landing_s(group: FlightGroup) -> float | None:
    """When a group's last leg begins to land it; None where it does not."""
    lands = group.legs and group.legs[-1].action == "land"
    return GroupWay(group).end_s if lands else None


def _steps(group: FlightGroup, start_m: Point) -> Iterator[Step]:
    """The steps of a group's route and legs, but for landing."""
    route, at_m = group.route, start_m
    rest_s = route.turn_time_s / 2
    if group.take_off:
        up_m = (*start_m[:2], group.formation.altitude_m)
        yield Step((0.0, 0.0, 0.0), rest_s)
        yield _towards(at_m, up_m, group.climb_mps, group.climb_mps)
        yield Step((0.0, 0.0, 0.0), 2 * rest_s)
        at_m = up_m
    legs: Iterable[Leg] = (*(Leg(to_m=point) for point in route.waypoints_m[1:]), *group.legs)
    for leg in legs:
        if leg.action == "land":
            return
        if leg.for_s is not None:
            yield Step((0.0, 0.0, 0.0), leg.for_s + 2 * rest_s)  # it stands for that long between the spread changes
            continue
        x_m, y_m = leg.to_m or start_m[:2]
        there_m = (x_m, y_m, at_m[2] if leg.altitude_m is None else leg.altitude_m)
        if there_m != at_m:
            yield _towards(at_m, there_m, leg.speed_mps or route.speed_mps, group.climb_mps)
        at_m = there_m


def _towards(here_m: Point, there_m: Point, speed_mps: float, climb_mps: float) -> Step:
    """The straight step between two places, as fast as both speeds allow."""
    way = np.subtract(there_m, here_m)
    lasts_s = max(float(np.hypot(way[0], way[1])) / speed_mps, abs(float(way[2])) / climb_mps)
    x, y, z = (way / lasts_s).tolist()
    return Step((x, y, z), lasts_s)
