"""Where every drone would be without wind, jitter and errors: its place in a formation, or on its ground station."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from sortie.fleet.flight.mobility import found_mobility, heading_rad, is_planner, positions_m
from sortie.fleet.flight.route import FramePath, across, frame_path, turned
from sortie.fleet.flight.steps import GroupPath, GroupWay
from sortie.scenarios import schema, scratch
from sortie.scenarios.formation import slots
from sortie.scenarios.streams import stream

Array = npt.NDArray[np.float64]


class Nominal(NamedTuple):
    """The motion of n drones over T frames, ENU."""

    position_m: Array  # [T, n, 3]
    velocity_mps: Array  # [T, n, 3]
    acceleration_mps2: Array  # [T, n, 3]
    yaw_rad: Array  # [T, n]
    sway: tuple[Array, Array, Array] | None = None
    """Share of their jitter that drones have, and its two derivatives, [T, n] each; None: all of it."""

    @property
    def states(self) -> tuple[Array, Array, Array]:
        """Position, velocity and acceleration."""
        return self.position_m, self.velocity_mps, self.acceleration_mps2


class Way(Protocol):
    """The planned motion of some drones."""

    def at(self, time_s: Array) -> Nominal:
        """Their motion at the times of consecutive frames."""


def ways_of(
    fleet: schema.Fleet, frames: int, frame_s: float, seed: int, replication: int = 0
) -> list[tuple[tuple[int, ...], Way]]:
    """Every way of a fleet, with the drones that fly it.

    Args:
        fleet: its formation, groups, ground stations and models of mobility.
        frames: how many will be flown, `frame_s` apart.
        seed, replication: as in `sortie.scenarios.streams.stream`.

    Raises:
        PluginError: a mobility model that is not there, fails, or cannot be flown.
    """
    height_m = np.array(fleet.altitudes_m)

    def way(group: schema.Fleet | schema.FlightGroup, drones: Sequence[int], number: int) -> Way:
        heights = height_m[list(drones)]
        if isinstance(group, schema.FlightGroup) and (group.take_off or group.legs):
            return _Stepwise(group, heights)
        formation = _InFormation(group.formation, group.route, heights)
        if group.mobility == "formation":
            return formation
        starts_m = formation.at(np.zeros(1)).position_m[0]
        model = found_mobility(group.mobility, group.mobility_params)
        if is_planner(model):  # it is steered in flight, from where it hovers
            return _Standing(starts_m)
        times_s = np.arange(frames + 2, dtype=np.float64) * frame_s  # the motion of the last frame needs the next two
        rng = stream(seed, replication, number, "mobility")
        return _Sampled(positions_m(model, times_s, starts_m, rng), frame_s)

    ways: list[tuple[tuple[int, ...], Way]] = []
    if fleet.in_formation:
        ways.append((fleet.in_formation, way(fleet, fleet.in_formation, 0)))
    ways += [(group.drones, way(group, group.drones, k)) for k, group in enumerate(fleet.groups, start=1)]
    ways += [((station.drone,), _Standing([station.position_m], sways=False)) for station in fleet.ground]
    return ways


def starts_m(fleet: schema.Fleet) -> Array:
    """Where each drone would begin in its formation, [N, 3] ENU."""
    places = np.zeros((fleet.drones, 3))
    for drones, way in ways_of(_without_models(fleet), 1, 1.0, 0):
        places[list(drones)] = way.at(np.zeros(1)).position_m[0]
    return places


def _without_models(fleet: schema.Fleet) -> schema.Fleet:
    """The fleet with all its drones in formations."""
    plain = {"mobility": "formation", "mobility_params": {}}
    groups = tuple(group.model_copy(update=plain) for group in fleet.groups)
    return fleet.model_copy(update={**plain, "groups": groups})


def route_path(formation: schema.Formation, route: schema.Route, time_s: Array) -> FramePath:
    """The reference point's flight along a route."""
    return frame_path(route.waypoints_m, route.speed_mps, route.turn_time_s, formation.spacing_m, time_s)


class _InFormation:
    """Drones in their slots, at their heights, along a route."""

    def __init__(self, formation: schema.Formation, route: schema.Route, height_m: Array) -> None:
        self._formation, self._route, self._height_m = formation, route, height_m
        self._slot_m = slots(formation.shape, len(height_m), formation.spacing_m)

    def at(self, time_s: Array) -> Nominal:
        path = route_path(self._formation, self._route, time_s)
        position, velocity, acceleration = _in_slots(path, self._slot_m)
        yaw = np.broadcast_to(path.yaw_rad[:, None], position.shape[:2])
        return Nominal(raised(position, self._height_m), raised(velocity), raised(acceleration), yaw)


class _Stepwise:
    """Drones in their slots about a reference point that changes its height."""

    def __init__(self, group: schema.FlightGroup, height_m: Array) -> None:
        self._way = GroupWay(group)
        self._slot_m = slots(group.formation.shape, len(height_m), group.formation.spacing_m)
        self._level_m, self._above_m = group.formation.altitude_m, height_m - group.formation.altitude_m
        self._up_s = self._way.up_s

    def at(self, time_s: Array) -> Nominal:
        path: GroupPath = self._way.at(time_s)
        ground = _in_slots(path.frame, self._slot_m)
        climbing = (time_s < self._up_s)[:, None]
        share = 1.0 + self._above_m / self._level_m  # all leave the ground together, and arrive together
        heights = np.where(climbing, path.height_m[:, None] * share, path.height_m[:, None] + self._above_m)
        rises = [np.where(climbing, v[:, None] * share, v[:, None]) for v in (path.climb_mps, path.climb_mps2)]
        yaw = np.broadcast_to(path.frame.yaw_rad[:, None], heights.shape)
        sway = [
            np.where(climbing, v[:, None] / self._level_m, rest) for v, rest in zip(path[1:], (1, 0, 0), strict=True)
        ]
        position, velocity, acceleration = (raised(*pair) for pair in zip(ground, (heights, *rises), strict=True))
        return Nominal(position, velocity, acceleration, yaw, sway=(sway[0], sway[1], sway[2]))


class _Standing:
    """Drones that hover, or a station that stands."""

    def __init__(self, places_m: npt.ArrayLike, *, sways: bool = True) -> None:
        self._places_m, self._sways = np.asarray(places_m, dtype=float), sways

    def at(self, time_s: Array) -> Nominal:
        still = np.zeros((len(time_s), *self._places_m.shape))
        none = still[..., 0]
        return Nominal(still + self._places_m, still, still, none, sway=None if self._sways else (none, none, none))


class _Sampled:
    """Positions of every frame, and of two more."""

    def __init__(self, positions_m: Array, frame_s: float) -> None:
        self._frame_s = frame_s
        velocity = np.gradient(positions_m, frame_s, axis=0)
        acceleration = np.gradient(velocity, frame_s, axis=0)
        states = positions_m, velocity, acceleration, heading_rad(velocity, frame_s)
        self._states = [scratch.copied(state) for state in states]

    def at(self, time_s: Array) -> Nominal:
        first = round(float(time_s[0]) / self._frame_s)
        position, velocity, acceleration, yaw = (state[first : first + len(time_s)] for state in self._states)
        return Nominal(position, velocity, acceleration, yaw)


def _in_slots(path: FramePath, slot_m: Array) -> tuple[Array, Array, Array]:
    """The virtual structure: p + R(ψ)·s and its two time derivatives, [T, n, 2] each."""
    arm = turned(slot_m, path.yaw_rad[:, None])
    left = across(arm)
    rate, rate_change = path.yaw_rate_radps[:, None, None], path.yaw_acceleration_radps2[:, None, None]
    position: Array = path.position_m[:, None] + arm
    velocity: Array = path.velocity_mps[:, None] + rate * left
    acceleration: Array = path.acceleration_mps2[:, None] + rate_change * left - rate**2 * arm
    return position, velocity, acceleration


def raised(ground: Array, height: float | Array = 0.0) -> Array:
    """[..., 2] to [..., 3], to one height or to one for each of the last axis but one."""
    up = np.broadcast_to(height, ground.shape[:-1])
    return np.concatenate([ground, up[..., None]], axis=-1)
