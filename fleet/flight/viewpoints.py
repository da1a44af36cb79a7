"""Viewpoints: how a drone leaves its slot because its policy asks, and what keeps that safe.

A drone's place is its slot plus a shift, both in the formation's frame (x forward, y left), so that places which keep
their distance go on keeping it however the formation flies and turns. A shift changes by moves: straight lines from
standing to standing, spread in time like the route's corners, so that speed and acceleration are bounded and have no
jumps. Whether a move is safe is judged with everybody ending the move that he is on and then standing where it ends.
"""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sortie.fleet.flight.motion import MotionError
from sortie.fleet.flight.route import PEAK, FramePath, bend, spread, turned
from sortie.fleet.flight.safety import INSTANTS_S, JITTERS
from sortie.fleet.flight.ways import route_path
from sortie.scenarios import schema
from sortie.scenarios.formation import slots

Array = npt.NDArray[np.float64]
Place = tuple[float, float]

LEAST_MOVE_M = 2.0
"""A wish for a place nearer than this to where a drone stands moves nothing: jitter and estimates are no reason."""
_PEAK_ACCELERATION = 9.0
"""Of a unit step spread over a unit of time (quadratic B-spline)."""


class Move(NamedTuple):
    """A drone's shift goes from one place to another, in the formation's frame."""

    begin_s: float
    width_s: float
    start_m: Place
    end_m: Place

    @property
    def end_s(self) -> float:
        """When it stands again."""
        return self.begin_s + self.width_s

    @property
    def length_m(self) -> float:
        """How far it goes."""
        return math.dist(self.start_m, self.end_m)

    @property
    def speed_mps(self) -> float:
        """The fastest that it gets."""
        return PEAK * self.length_m / self.width_s

    @property
    def acceleration_mps2(self) -> float:
        """The most that it accelerates."""
        return _PEAK_ACCELERATION * self.length_m / self.width_s**2


Plan = tuple[Move, ...]
"""One drone's moves so far, in order of time, none begun before the one before has ended."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """What places and moves are held to."""

    reach_m: float
    speed_mps: float
    acceleration_mps2: float
    separation_m: float
    """Between places: the drones' own and room for both their jitters."""
    fence_m: tuple[float, float, float, float] | None
    """For places, likewise."""


@dataclass(frozen=True, slots=True)
class Course:
    """What the formation will do: its frame at every frame of the flight, and its slots."""

    time_s: Array  # [T]
    path: FramePath
    slot_m: Array  # [N, 2]; NaN for drones outside of the formation

    def world_m(self, places_m: Array, frames: slice = slice(None)) -> Array:
        """Places [..., 2] of the formation's frame, one for every frame, on the ground, ENU."""
        world_m: Array = turned(places_m, self.path.yaw_rad[frames]) + self.path.position_m[frames]
        return world_m

    def wanted_shift_m(self, drone: int, frame: int, x_m: float, y_m: float) -> Place:
        """The shift that would have a drone over (x, y) now."""
        yaw, (at_x, at_y) = self.path.yaw_rad[frame], self.path.position_m[frame]
        cos, sin, dx, dy = math.cos(yaw), math.sin(yaw), x_m - at_x, y_m - at_y
        slot_x, slot_y = self.slot_m[drone]
        return float(cos * dx + sin * dy - slot_x), float(cos * dy - sin * dx - slot_y)


def bounds_of(fleet: schema.Fleet) -> Bounds:
    """The scenario's bounds, less room for the pose jitter."""
    v, room_m = fleet.viewpoints, JITTERS * fleet.motion.pose_jitter_m
    fence = v.fence_m
    if fence is not None:
        fence = (fence[0] + room_m, fence[1] + room_m, fence[2] - room_m, fence[3] - room_m)
    return Bounds(v.reach_m, v.speed_mps, v.acceleration_mps2, v.separation_m + math.sqrt(2) * room_m, fence)


def course_of(fleet: schema.Fleet, time_s: Array) -> Course:
    """What the formation will do, as `sortie.fleet.flight.motion.fly` has it.

    Raises:
        MotionError: a slot's own way leaves the fence.
    """
    formation, members = fleet.formation, list(fleet.in_formation) if fleet.mobility == "formation" else []
    slot_m = np.full((fleet.drones, 2), np.nan)
    if members:
        slot_m[members] = slots(formation.shape, len(members), formation.spacing_m)
    course = Course(time_s, route_path(formation, fleet.route, time_s), slot_m)
    bounds = bounds_of(fleet)
    for drone in members:
        place_m = first_outside(course, bounds, drone)
        if place_m is not None:
            x, y = place_m
            raise MotionError(
                f"fleet.viewpoints.fence_m {fleet.viewpoints.fence_m} must hold every slot's way with {JITTERS:g} times "
                f"pose_jitter_m to spare: drone {drone}'s slot comes to ({x:.1f}, {y:.1f})"
            )
    return course


# --- shifts over time ------------------------------------------------------------------------------


def standing_m(plan: Plan) -> Place:
    """The shift at which a drone stands once its last move is over."""
    return plan[-1].end_m if plan else (0.0, 0.0)


def shift_m(plan: Plan, time_s: Array) -> Array:
    """A drone's shift at any times [T]: [T, 2], m, the formation's frame."""
    return shifts(plan, time_s)[0]


def shifts(plan: Plan, time_s: Array) -> tuple[Array, Array, Array]:
    """Shift, its rate and its acceleration, [T, 2] each."""
    total = np.zeros((3, len(time_s), 2))
    for move in plan:
        since_s = time_s - (move.begin_s + 0.5 * move.width_s)
        _, step, slope = spread(since_s, move.width_s)
        along = np.subtract(move.end_m, move.start_m)
        total += np.stack([step, slope, bend(since_s, move.width_s)])[..., None] * along
    return total[0], total[1], total[2]


# --- what is safe ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ViewpointWish:
    """A drone's wish for another place (`sortie.fleet.flight.safety.Wish`)."""

    drone: int
    wanted_m: Place
    """The shift that it asks for, in the formation's frame."""
    plans: Sequence[Plan]
    """Every drone's moves so far."""
    course: Course
    bounds: Bounds
    frame: int
    """The move would begin with it."""
    gone: Container[int] = ()
    """Drones that have left the air for good, to whom nobody comes near."""

    def attempt(self, share: float) -> Move | None:
        """The move of a share of the way; None where the drone stands there already, or is on its way and has to arrive."""
        plan, now_s = self.plans[self.drone], float(self.course.time_s[self.frame])
        if plan and plan[-1].end_s > now_s:
            return None
        start, wish = standing_m(plan), _within(self.wanted_m, self.bounds.reach_m)
        end = (start[0] + share * (wish[0] - start[0]), start[1] + share * (wish[1] - start[1]))
        if math.dist(start, end) < LEAST_MOVE_M:
            return None
        return Move(now_s, _width_s(math.dist(start, end), self.bounds), start, end)

    def refusal(self, move: Move) -> str:
        """Why a move is not safe to the end of the flight."""
        near = _too_near(self.drone, move, self.plans, self.course, self.bounds, self.gone)
        if near is not None:
            return f"would come too near drone {near}"
        plan = (*self.plans[self.drone], move)
        outside_m = first_outside(self.course, self.bounds, self.drone, plan, self.frame)
        return "" if outside_m is None else "would leave the fence"


def first_outside(course: Course, bounds: Bounds, drone: int, plan: Plan = (), frame: int = 0) -> Array | None:
    """The first place outside the fence that a drone's place comes to from a frame to the end; None where it stays inside."""
    if bounds.fence_m is None:
        return None
    rest, (x_min, y_min, x_max, y_max) = slice(frame, None), bounds.fence_m
    world_m = course.world_m(course.slot_m[drone] + shift_m(plan, course.time_s[rest]), rest)
    outside = ((world_m < (x_min, y_min)) | (world_m > (x_max, y_max))).any(axis=-1)
    return world_m[outside.argmax()] if outside.any() else None


def least_m(course: Course, bounds: Bounds, i: int, j: int) -> float:
    """How near two places may come: the separation, or as near as the formation itself has them."""
    return min(bounds.separation_m, float(np.hypot(*(course.slot_m[i] - course.slot_m[j]))))


def _too_near(
    drone: int, move: Move, plans: Sequence[Plan], course: Course, bounds: Bounds, gone: Container[int]
) -> int | None:
    """The first drone to which a move would come closer than allowed, at any time."""
    for other, plan in enumerate(plans):
        if other == drone or other in gone:
            continue
        least = least_m(course, bounds, drone, other) - 1e-9
        apart = course.slot_m[drone] - course.slot_m[other]
        if not plan or plan[-1].end_s <= move.begin_s:  # it stands: a point and a segment
            apart = apart - standing_m(plan)
            if _distance_m(apart + move.start_m, apart + move.end_m) < least:
                return other
            continue
        last = plan[-1]
        if math.dist(*_middles(course, drone, move, other, last)) - (move.length_m + last.length_m) / 2 >= least:
            continue
        if move.begin_s == last.begin_s and math.isclose(move.width_s, last.width_s, rel_tol=1e-12):
            begin, end = (apart + np.subtract(a, b) for a, b in zip(move[2:], last[2:], strict=True))
            if _distance_m(begin, end) < least:  # in step: one moves straight past the other
                return other
            continue
        # both move: instants, and no nearer in between than speed and acceleration allow
        end_s = max(move.end_s, plan[-1].end_s)
        time_s = np.linspace(move.begin_s, end_s, max(2, math.ceil((end_s - move.begin_s) / INSTANTS_S) + 1))
        ours, theirs = shifts((move,), time_s), shifts(plan, time_s)
        way, rate = apart + move.start_m + ours[0] - theirs[0], np.linalg.norm(ours[1] - theirs[1], axis=-1)
        half_s = 0.5 * (time_s[1] - time_s[0])
        between_m = rate * half_s + (move.acceleration_mps2 + last.acceleration_mps2) * half_s**2 / 2
        if float((np.linalg.norm(way, axis=-1) - between_m).min()) < least:
            return other
    return None


def _middles(course: Course, drone: int, move: Move, other: int, theirs: Move) -> tuple[Array, Array]:
    """The middles of two drones' moves, in the formation's frame."""
    ours_m = course.slot_m[drone] + 0.5 * np.add(move.start_m, move.end_m)
    return ours_m, course.slot_m[other] + 0.5 * np.add(theirs.start_m, theirs.end_m)


def _distance_m(a: Array, b: Array) -> float:
    """From the origin to a segment."""
    along = b - a
    length2 = float((along * along).sum())
    t = min(1.0, max(0.0, -float((a * along).sum()) / length2)) if length2 > 0.0 else 0.0
    return float(np.hypot(*(a + t * along)))


def _width_s(length_m: float, bounds: Bounds) -> float:
    """The shortest time for a move within speed and acceleration."""
    by_speed = PEAK * length_m / bounds.speed_mps
    return max(by_speed, math.sqrt(_PEAK_ACCELERATION * length_m / bounds.acceleration_mps2))


def _within(wanted_m: Place, reach_m: float) -> Place:
    far_m = math.hypot(*wanted_m)
    share = reach_m / far_m if far_m > reach_m else 1.0
    return wanted_m[0] * share, wanted_m[1] * share
