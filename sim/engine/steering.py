"""Planners in flight: what they command, what of it is safe, and the motion that follows.

It is used only where a mobility model plans in flight. Each planner reads the view of its drone's policy. Commands of one
frame are decided together at the begin of the next frame, by ascending drone. After a granted command the rest of the
flight is computed again.
"""

from __future__ import annotations

import math
from numbers import Real

import numpy as np

from sortie.fleet.flight.displaced import steered
from sortie.fleet.flight.mobility import found_mobility, is_planner
from sortie.fleet.flight.steering import (
    LEAST_MOVE_M,
    SHARES,
    Array,
    Command,
    GoTo,
    Hold,
    Land,
    Return,
    SteeredWay,
    Velocity,
    nearest_m,
    refusal,
    steer,
    steered_area_m,
)
from sortie.fleet.flight.ways import starts_m
from sortie.policies.contract import FleetView
from sortie.scenarios.plugins.reference import Guard, PluginError, checked_call
from sortie.scenarios.schema import Fleet, FlightGroup, Scenario
from sortie.scenarios.schema.events.base import joining
from sortie.scenarios.streams import stream
from sortie.sim.engine.membership import Membership
from sortie.sim.engine.world import World

EVERY_S = 0.5
"""Planners are asked this often."""
EVENT = "steering"
"""The kind of commands and refusals among the record's events."""
COMMANDS = (GoTo, Velocity, Hold, Return, Land)


def steers(group: Fleet | FlightGroup) -> bool:
    """Whether a fleet or a group is steered by planners of one's own."""
    return group.mobility != "formation" and is_planner(found_mobility(group.mobility, group.mobility_params))


def area_m(fleet: Fleet, flown_m: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """x_min, y_min, x_max, y_max of where a fleet flies as planned, and where its planners may take it, ENU."""
    steered_m = steered_area_m(fleet, steers)
    if steered_m is None:
        return flown_m
    low, high = np.minimum(flown_m[:2], steered_m[:2]), np.maximum(flown_m[2:], steered_m[2:])
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


class Steering:
    """Steers drones as their planners command, as far as safety allows."""

    def __init__(self, scenario: Scenario, world: World, membership: Membership, seed: int, replication: int) -> None:
        """Raises:
        PluginError: a planner that is not there, does not load, or lacks its method; a start outside the bounds.
        """
        fleet = scenario.fleet
        self._fleet, self._world, self._membership, self._base = fleet, world, membership, world.motion
        self._every = max(1, round(EVERY_S / scenario.frame_s))
        self._time_s = np.asarray(world.motion.time_s)
        self._names: dict[int, str] = {}
        self._planners: dict[int, Guard] = {}
        self._starts_m: Array = starts_m(fleet)
        flown: list[tuple[Fleet | FlightGroup, tuple[int, ...]]] = [(fleet, fleet.in_formation)]
        for group, drones in [*flown, *((group, group.drones) for group in fleet.groups)]:
            if steers(group):
                model = found_mobility(group.mobility, group.mobility_params)
                for drone in drones:
                    start, rng = tuple(self._starts_m[drone].tolist()), stream(seed, replication, drone, "planner")
                    made = checked_call("mobility", model, drone, start, rng)
                    self._planners[drone] = Guard("mobility", made, ("command",))
                    self._names[drone] = group.mobility.rpartition(":")[2]
        self._ways = {drone: self._resting(drone) for drone in self._planners}
        self._wishes: dict[int, Command] = {}
        self._reported: dict[int, str] = {}
        self._comes = joining(scenario.events).union(*(group.reserve for group in scenario.mission.groups))
        self._frame = 0
        membership.on_join = self._begin_anew

    def _begin_anew(self, drone: int) -> None:
        """A drone that joins appears in its slot, and rests there until its next command."""
        frame = self._world.next_frame
        if drone not in self._planners or frame >= len(self._time_s):
            return
        self._ways[drone] = self._resting(drone)
        self._wishes.pop(drone, None)
        self._reported.pop(drone, None)
        self._world.reroute(steered(self._world.motion, self._base, {drone: self._shift(drone, frame)}, frame))

    def _resting(self, drone: int) -> SteeredWay:
        x, y, z = self._starts_m[drone].tolist()
        limits = self._fleet.steering
        if not limits.altitude_m[0] <= z <= limits.altitude_m[1]:
            bound = f"must be within fleet.steering.altitude_m {limits.altitude_m}"
            raise PluginError(f"mobility {self._names[drone]}: drone {drone} begins at a height of {z:g} m, {bound}")
        fence_m = limits.fence_m
        if fence_m is not None and not (fence_m[0] <= x <= fence_m[2] and fence_m[1] <= y <= fence_m[3]):
            bound = f"must be within fleet.steering.fence_m {fence_m}"
            raise PluginError(f"mobility {self._names[drone]}: drone {drone} begins at ({x:g}, {y:g}), {bound}")
        return SteeredWay(0.0, (x, y, z), (0.0, 0.0, 0.0))

    @property
    def anyone(self) -> bool:
        """Whether any drone has a planner."""
        return bool(self._planners)

    def read(self, drone: int, view: FleetView) -> None:
        """Let a drone's planner read the view of a decision.

        Raises:
            PluginError: the planner fails, or returns no command.
        """
        planner = self._planners.get(drone)
        if planner is None or self._frame % self._every:
            return
        command = planner.command(view)  # type: ignore[attr-defined]
        if command is None:
            return
        if not _is_command(command):
            kinds = ", ".join(kind.__name__ for kind in COMMANDS)
            what = f"returns {command!r}, must be None or one of {kinds} with finite numbers and speeds > 0"
            raise PluginError(f"mobility {self._names[drone]} on drone {drone}: {what}")
        self._wishes[drone] = command

    def renew(self, frame: int) -> None:
        """Decide what was commanded; what is granted begins with this frame. Call it first in a frame."""
        self._frame = frame
        wishes, self._wishes = self._wishes, {}
        drones = self._world.drones
        flying = [i for i in sorted(wishes) if drones[i].airborne and i not in self._world.homebound]
        if not flying:
            return
        gone = [i for i, d in enumerate(drones) if not (d.airborne or i in self._comes)]
        others_m = np.array(self._world.motion.position_m[frame:])
        down = [i for i, d in enumerate(drones) if not d.airborne]
        others_m[:, down] = self._base.position_m[frame:, down]  # where they appear if they join
        granted, landing = {}, []
        for drone in flying:
            command = wishes[drone]
            way = self._granted(drone, command, frame, others_m, gone)
            if way is None:
                continue
            self._ways[drone] = way
            granted[drone] = self._shift(drone, frame)
            others_m[:, drone] = self._base.position_m[frame:, drone] + granted[drone][0]
            if isinstance(command, Land):
                landing.append(drone)
        if granted:
            self._world.reroute(steered(self._world.motion, self._base, granted, frame))
        for drone in landing:
            self._membership.go_home(drone, f"{self._names[drone]} lands it")

    def _shift(self, drone: int, frame: int) -> tuple[Array, Array, Array]:
        place, speed, push = self._ways[drone].at(self._time_s[frame:])
        return place - self._starts_m[drone], speed, push

    def _granted(self, drone: int, command: Command, frame: int, others_m: Array, gone: list[int]) -> SteeredWay | None:
        """The way that a command gets; None where the drone does as before, because it is on its way or all is refused."""
        now_s, time_s = float(self._time_s[frame]), self._time_s[frame:]
        aim = self._aim(drone, command, frame)
        if isinstance(aim, GoTo) and self._flies_to(drone, aim):
            self._report(drone, type(command).__name__)
            return None
        left_out = [*gone, drone]
        rest = np.delete(others_m, left_out, axis=1)
        least_m = np.minimum(self._fleet.steering.separation_m, nearest_m(others_m[:, drone], rest)) - 1e-9
        which = np.delete(np.arange(others_m.shape[1]), left_out)
        refused = ""
        for share in SHARES if isinstance(aim, GoTo | Velocity) else SHARES[:1]:
            way = steer(self._ways[drone], aim, now_s, self._fleet.steering, share)
            refused = refusal(way, now_s, self._starts_m[drone], self._fleet)
            if not refused:
                ours_m = self._base.position_m[frame:, drone] + way.at(time_s)[0] - self._starts_m[drone]
                near = np.flatnonzero(nearest_m(ours_m, rest) < least_m)
                if not len(near):
                    self._report(drone, type(command).__name__)
                    return way
                refused = f"would come too near drone {which[near[0]]}"
        self._report(drone, f"{type(command).__name__} refused, it {refused}")
        return None

    def _flies_to(self, drone: int, aim: GoTo) -> bool:
        """Whether it is on its way there, or there."""
        end_m = self._ways[drone].end_m
        height_m = float(end_m[2]) if aim.z_m is None else aim.z_m
        return math.dist(end_m, (aim.x_m, aim.y_m, height_m)) < LEAST_MOVE_M

    def _aim(self, drone: int, command: Command, frame: int) -> GoTo | Velocity | Hold:
        """The command with its place where the drone would go: it believes to be elsewhere than it is."""
        if isinstance(command, Land):
            return Hold()
        if isinstance(command, Return):
            return GoTo(*self._starts_m[drone].tolist())
        if not isinstance(command, GoTo):
            return command
        believed_m = self._world.sensed(drone, frame).capture.est_position_m
        x_m, y_m, z_m = (np.array(believed_m) - self._world.motion.position_m[frame, drone]).tolist()
        height_m = None if command.z_m is None else command.z_m - z_m
        return GoTo(command.x_m - x_m, command.y_m - y_m, height_m, command.speed_mps)

    def _report(self, drone: int, text: str) -> None:
        """Record what a planner commands once, however often it repeats it."""
        if self._reported.get(drone) != text:
            self._reported[drone] = text
            self._world.note(drone, EVENT, f"{self._names[drone]}: {text}")


def _is_command(given: object) -> bool:
    """Whether a planner returned a command, with finite numbers wherever it may not be None, and no speed of 0 or less."""
    if not isinstance(given, COMMANDS):
        return False
    optional = (given.z_m, given.speed_mps) if isinstance(given, GoTo) else ()
    numbers = [*given[:2], *(v for v in optional if v is not None)] if isinstance(given, GoTo) else list(given)
    if not all(isinstance(v, Real) and math.isfinite(v) for v in numbers):
        return False
    return not isinstance(given, GoTo) or given.speed_mps is None or given.speed_mps > 0
