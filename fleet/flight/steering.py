"""Steering in flight: what a planner may command, the smooth way that follows, and what keeps it safe.

A drone's way changes by changes of velocity, each spread in time as the route's corners are, and ends at rest. What flies
at any time was found safe to its end, so a drone whose planner falls silent comes to rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import NamedTuple, Protocol, TypeGuard

import numpy as np
import numpy.typing as npt

from sortie.fleet.flight.mobility import found_mobility, is_planner
from sortie.fleet.flight.route import PEAK, spread
from sortie.fleet.flight.safety import INSTANTS_S, JITTERS
from sortie.fleet.flight.ways import starts_m
from sortie.policies.contract import FleetView
from sortie.scenarios import schema

Array = npt.NDArray[np.float64]
Vector = tuple[float, float, float]

VELOCITY_LASTS_S = 2.0
"""A commanded velocity is flown for this long; then the drone comes to rest, unless another command came."""
LEAST_MOVE_M = 0.5
"""A place nearer than this to where a drone comes to rest moves nothing: jitter and estimates are no reason."""
SHORTEST_S = 0.2
"""No change of velocity is spread over less."""
_ROUNDS = 24


class GoTo(NamedTuple):
    """Fly straight to a place and stop there. Places are where the drone believes them to be, ENU."""

    x_m: float
    y_m: float
    z_m: float | None = None
    """None keeps the height."""
    speed_mps: float | None = None
    """None is as fast as `fleet.steering` allows."""


class Velocity(NamedTuple):
    """Fly at a velocity, ENU, for two seconds or until the next command."""

    x_mps: float
    y_mps: float
    z_mps: float = 0.0


class Hold(NamedTuple):
    """Come to rest."""


class Return(NamedTuple):
    """Fly to where the drone began."""


class Land(NamedTuple):
    """Come to rest, descend to the ground and leave the fleet."""


Command = GoTo | Velocity | Hold | Return | Land


def is_command(given: object) -> TypeGuard[Command]:
    """Whether a planner returned a command, with finite numbers wherever it may not be None, and no speed of 0 or less."""
    if not isinstance(given, Command):
        return False
    optional = given[2:] if isinstance(given, GoTo) else ()
    numbers = [*(given[:2] if optional else given), *(v for v in optional if v is not None)]
    if not all(isinstance(v, Real) and math.isfinite(v) for v in numbers):
        return False
    return not isinstance(given, GoTo) or given.speed_mps is None or given.speed_mps > 0


class Planner(Protocol):
    """A mobility model that steers one drone. It is made with the drone's number, its start (ENU) and a random generator;
    keyword-only arguments are its parameters."""

    def command(self, view: FleetView) -> Command | None:
        """What to do now, by the view that the policy reads too. None changes nothing."""


class Change(NamedTuple):
    """A change of velocity, spread over a time."""

    begin_s: float
    width_s: float
    by_mps: Vector


@dataclass(frozen=True, slots=True)
class SteeredWay:
    """A drone's nominal motion from a moment on, ENU."""

    begin_s: float
    place_m: Vector
    velocity_mps: Vector
    changes: tuple[Change, ...] = ()

    def at(self, time_s: Array) -> tuple[Array, Array, Array]:
        """Position, velocity and acceleration at times from the begin on: [T, 3] each."""
        place, velocity = np.array(self.place_m), np.array(self.velocity_mps)
        position = place + (time_s - self.begin_s)[:, None] * velocity
        speed, push = np.repeat(velocity[None], len(time_s), axis=0), np.zeros((len(time_s), 3))
        for change in self.changes:
            ramp, step, slope = spread(time_s - change.begin_s - change.width_s / 2, change.width_s)
            by = np.array(change.by_mps)
            position, speed, push = (
                total + part[:, None] * by
                for total, part in zip((position, speed, push), (ramp, step, slope), strict=True)
            )
        return position, speed, push

    def until(self, now_s: float) -> tuple[SteeredWay, float]:
        """The way without the changes of velocity that have not begun, and when the present one is over."""
        for change in self.changes:
            end_s = change.begin_s + change.width_s
            if change.begin_s <= now_s < end_s:
                here, velocity = self.state(change.begin_s)
                return SteeredWay(change.begin_s, _vector(here), _vector(velocity), (change,)), end_s
        here, velocity = self.state(now_s)
        return SteeredWay(now_s, _vector(here), _vector(velocity)), now_s

    @property
    def rests_s(self) -> float:
        """When it comes to rest."""
        return max([self.begin_s, *(change.begin_s + change.width_s for change in self.changes)])

    @property
    def end_m(self) -> Array:
        """Where it comes to rest."""
        return self.state(self.rests_s)[0]

    def state(self, now_s: float) -> tuple[Array, Array]:
        """Position and velocity now."""
        position, velocity, _ = self.at(np.array([now_s]))
        return position[0], velocity[0]


def steer(
    way: SteeredWay, command: GoTo | Velocity | Hold, now_s: float, limits: schema.Steering, share: float = 1.0
) -> SteeredWay:
    """The way that a command asks for, within speed and acceleration. A change of velocity that has begun is finished first.

    Args:
        way: what is flown now.
        command: what to do.
        now_s: when the command comes.
        limits: the bounds.
        share: of the way, or of the velocity, that is tried.
    """
    way, free_s = way.until(now_s)
    here, velocity = way.state(free_s)
    if isinstance(command, GoTo):
        z_m = float(here[2]) if command.z_m is None else command.z_m
        there = here + share * (np.array((command.x_m, command.y_m, z_m)) - here)
        changes = _to(here, velocity, there, free_s, limits, command.speed_mps)
    else:
        wanted = np.zeros(3) if isinstance(command, Hold) else share * np.array(command)
        wanted *= min(1.0, _fastest(wanted, limits, None) / max(float(np.linalg.norm(wanted)), 1e-12))
        changes = _through(velocity, wanted, free_s, limits)
    return replace(way, changes=(*way.changes, *changes))


def _through(velocity: Array, wanted: Array, now_s: float, limits: schema.Steering) -> list[Change]:
    """To a velocity, which is kept for a while, and to rest."""
    first_s = _width_s(wanted - velocity, limits)
    changes = [Change(now_s, first_s, _vector(wanted - velocity))]
    if wanted.any():
        stop_s = now_s + max(VELOCITY_LASTS_S, first_s)
        changes.append(Change(stop_s, _width_s(wanted, limits), _vector(-wanted)))
    return changes


def _to(
    here: Array, velocity: Array, there: Array, now_s: float, limits: schema.Steering, speed_mps: float | None
) -> list[Change]:
    """Straight to a place, as fast as the bounds allow, and at rest there.

    Velocity changes to one towards the place over w1, and to zero over w2. What is covered by then is
    v·w1/2 + c·τ, with τ from the middle of one change to the middle of the other, at least (w1 + w2)/2.
    """

    def tried(speed: float) -> tuple[Array, float, float, float] | None:
        first_s = SHORTEST_S
        for _ in range(_ROUNDS):
            rest = there - here - velocity * first_s / 2
            length = float(np.linalg.norm(rest))
            if length < 1e-9:
                return None
            cruise = rest / length * min(speed, _fastest(rest, limits, speed_mps))
            first_s = max(first_s, _width_s(cruise - velocity, limits))
        if _width_s(cruise - velocity, limits) > first_s + 1e-9:
            return None
        lasts_s, last_s = length / float(np.linalg.norm(cruise)), _width_s(cruise, limits)
        return (cruise, first_s, lasts_s, last_s) if lasts_s >= (first_s + last_s) / 2 else None

    slow, fast = 0.0, math.hypot(limits.speed_mps, limits.climb_mps)
    found = tried(fast)
    for _ in range(0 if found else _ROUNDS):
        speed = (slow + fast) / 2
        answer = tried(speed)
        found, slow, fast = (found, slow, speed) if answer is None else (answer, speed, fast)
    if found is None:
        return _through(velocity, np.zeros(3), now_s, limits)
    cruise, first_s, lasts_s, last_s = found
    stop_s = now_s + first_s / 2 + lasts_s - last_s / 2
    return [Change(now_s, first_s, _vector(cruise - velocity)), Change(stop_s, last_s, _vector(-cruise))]


def refusal(way: SteeredWay, now_s: float, start_m: Array, fleet: schema.Fleet) -> str:
    """Why a way leaves the bounds of place from now on until it rests; empty where it does not.

    Args:
        way: the way that is tried.
        now_s: it is flown from then on.
        start_m: where the drone began.
        fleet: its `steering`, and the jitter, of which the fence keeps clear.
    """
    limits, bends = fleet.steering, [np.array([now_s, way.rests_s])]
    for begin_s, width_s, _ in way.changes:  # between them it flies straight, so that no place there is further out
        bends.append(np.linspace(begin_s, begin_s + width_s, math.ceil(width_s / INSTANTS_S) + 1))
    place = way.at(np.unique(np.maximum(now_s, np.concatenate(bends))))[0]
    low_m, high_m = (min(limits.altitude_m[0], place[0, 2]), max(limits.altitude_m[1], place[0, 2]))
    if (place[:, 2] < low_m - 1e-6).any() or (place[:, 2] > high_m + 1e-6).any():
        return f"would leave the altitudes of {limits.altitude_m[0]:g} to {limits.altitude_m[1]:g} m"
    away = np.linalg.norm(place - start_m, axis=-1)
    if (away > max(limits.reach_m, float(away[0])) + 1e-6).any():
        return f"would leave its reach of {limits.reach_m:g} m"
    if limits.fence_m is not None:
        room_m = JITTERS * fleet.motion.pose_jitter_m
        outside = np.maximum(
            np.array(limits.fence_m[:2]) + room_m - place[:, :2], place[:, :2] - np.array(limits.fence_m[2:]) + room_m
        ).max(axis=-1)
        if (outside > max(0.0, float(outside[0])) + 1e-6).any():
            return "would leave the fence"
    return ""


def nearest_m(ours_m: Array, others_m: Array) -> Array:
    """How near a drone [T, 3] comes to each of k others [T, k, 3], straight from frame to frame: [k]."""
    apart = others_m - ours_m[:, None]
    if len(apart) < 2:
        return np.linalg.norm(apart, axis=-1).min(axis=0) if len(apart) else np.full(apart.shape[1], np.inf)
    begin, along = apart[:-1], np.diff(apart, axis=0)
    length2 = np.maximum((along * along).sum(axis=-1), 1e-18)
    share = np.clip(-(begin * along).sum(axis=-1) / length2, 0.0, 1.0)
    nearest: Array = np.linalg.norm(begin + share[..., None] * along, axis=-1).min(axis=0)
    return nearest


@dataclass(frozen=True, slots=True)
class SteeringWish:
    """A planner's wish for another way (`sortie.fleet.flight.safety.Wish`), among others whom it comes no nearer than now."""

    drone: int
    aim: GoTo | Velocity | Hold
    way: SteeredWay
    """What it flies now."""
    start_m: Array
    hover_m: Array
    """Where it would hover from now on, [F, 3]."""
    time_s: Array
    """Of the same frames, [F]."""
    places_m: Array
    """Where all drones will be in them, [F, N, 3]."""
    gone: Sequence[int]
    """Drones that have left the air for good, to whom nobody comes near."""
    fleet: schema.Fleet
    """Its `steering`, and the jitter, of which the fence keeps clear."""

    def attempt(self, share: float) -> SteeredWay | None:
        """The way of a share of the command; None where the drone is on its way there, or there."""
        aim = self.aim
        if isinstance(aim, Hold) and share < 1.0:
            return None
        if isinstance(aim, GoTo):
            end_m = self.way.end_m
            height_m = float(end_m[2]) if aim.z_m is None else aim.z_m
            if math.dist(end_m, (aim.x_m, aim.y_m, height_m)) < LEAST_MOVE_M:
                return None
        return steer(self.way, aim, float(self.time_s[0]), self.fleet.steering, share)

    def refusal(self, way: SteeredWay) -> str:
        """Why a way is not safe until it rests."""
        refused = refusal(way, float(self.time_s[0]), self.start_m, self.fleet)
        if refused:
            return refused
        left_out = [*self.gone, self.drone]
        others, others_m = (
            np.delete(np.arange(self.places_m.shape[1]), left_out),
            np.delete(self.places_m, left_out, 1),
        )
        now_m = nearest_m(self.places_m[:, self.drone], others_m)
        least_m = np.minimum(self.fleet.steering.separation_m, now_m) - 1e-9
        near = np.flatnonzero(nearest_m(self.hover_m + way.at(self.time_s)[0] - self.start_m, others_m) < least_m)
        return f"would come too near drone {others[near[0]]}" if len(near) else ""


def with_planners(fleet: schema.Fleet) -> list[tuple[schema.Fleet | schema.FlightGroup, tuple[int, ...]]]:
    """The parts of a fleet that planners of the user's own steer, and their drones."""
    parts: list[tuple[schema.Fleet | schema.FlightGroup, tuple[int, ...]]] = [(fleet, fleet.in_formation)]
    parts += [(group, group.drones) for group in fleet.groups]
    return [
        (part, drones)
        for part, drones in parts
        if part.mobility != "formation" and is_planner(found_mobility(part.mobility, part.mobility_params))
    ]


def area_m(fleet: schema.Fleet, flown_m: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """x_min, y_min, x_max, y_max of where a fleet flies as planned, and where its planners may take it, ENU."""
    drones = [drone for _, drones in with_planners(fleet) for drone in drones]
    if not drones:
        return flown_m
    limits, starts = fleet.steering, starts_m(fleet)[drones, :2]
    low, high = starts.min(axis=0) - limits.reach_m, starts.max(axis=0) + limits.reach_m
    if limits.fence_m is not None:
        low, high = np.maximum(low, limits.fence_m[:2]), np.minimum(high, limits.fence_m[2:])
    low, high = np.minimum(flown_m[:2], low), np.maximum(flown_m[2:], high)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _fastest(direction: Array, limits: schema.Steering, speed_mps: float | None) -> float:
    """The highest speed in a direction."""
    length = float(np.linalg.norm(direction))
    if length < 1e-12:
        return 0.0
    level, up = math.hypot(direction[0], direction[1]) / length, abs(float(direction[2])) / length
    bounds = [limit / part for limit, part in ((limits.speed_mps, level), (limits.climb_mps, up)) if part > 1e-12]
    return min(bounds if speed_mps is None else [*bounds, speed_mps])


def _width_s(change: Array, limits: schema.Steering) -> float:
    """The shortest time for a change of velocity."""
    return max(SHORTEST_S, PEAK * float(np.linalg.norm(change)) / limits.acceleration_mps2)


def _vector(values: Array) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
