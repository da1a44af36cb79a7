"""What moves drones in flight: requests of policies, planners and membership, in one queue.

Policies request viewpoints, and planners give commands. What they request in one frame is decided together at the begin
of the next one, by ascending drone (`sortie.fleet.flight.safety`). Drones that go home or come back need no decision.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Sequence
from typing import Protocol, get_args

import numpy as np

from sortie.fleet.flight.manoeuvres import Appearance, Descent, Manoeuvre, Shifted, Steered
from sortie.fleet.flight.mobility import found_mobility
from sortie.fleet.flight.safety import grant
from sortie.fleet.flight.steering import (
    Array,
    Command,
    GoTo,
    Hold,
    Land,
    Return,
    SteeredWay,
    SteeringWish,
    Vector,
    Velocity,
    is_command,
    with_planners,
)
from sortie.fleet.flight.viewpoints import Move, Plan, ViewpointWish, bounds_of, course_of
from sortie.fleet.flight.ways import starts_m
from sortie.policies.contract import FleetView, Reposition
from sortie.scenarios.plugins.reference import Guard, PluginError, checked_call
from sortie.scenarios.schema import Scenario
from sortie.scenarios.schema.events.base import joining
from sortie.scenarios.streams import stream
from sortie.sim.engine.world import World

RETRY_S = 1.0
"""Time until a refused request that lasts is decided again; the other drones have hardly moved before."""
VIEWPOINT, STEERING = "viewpoint", "steering"
"""The kinds of grants and refusals among the record's events."""
EVERY_S = 0.5
"""Planners are asked this often."""

Answer = Manoeuvre | str | None
"""What is granted of a request, or why nothing is; None where the drone does as before."""


class Source(ABC):
    """Where requests come from, and what is particular to them."""

    event: str
    """Their kind among the record's events."""
    lasts: bool
    """Whether a request stands until another replaces it. Then it is decided again after a refusal."""

    @abstractmethod
    def requesting(self) -> Collection[int]:
        """The drones with a request."""

    @abstractmethod
    def answer(self, drone: int, frame: int, gone: Sequence[int]) -> Answer:
        """Decide a drone's request; nobody keeps clear of those that are gone for good."""

    @abstractmethod
    def text(self, drone: int, answer: Answer) -> str:
        """What the record says of an answer; empty says nothing."""

    def decided(self) -> None:  # noqa: B027
        """The requests of this frame are decided, and what was granted is flown."""

    def appear(self, drone: int, frame: int) -> Sequence[Manoeuvre]:
        """What a drone that joins flies, beside that it is in its slot: by default the way that it had."""
        return ()


class Manoeuvres:
    """Changes the motion of the fleet: the one queue of what moves drones in flight."""

    def __init__(self, scenario: Scenario, world: World) -> None:
        self._world, self._frame_s, self._sources = world, scenario.frame_s, list[Source]()
        self._retry_frames = max(1, round(RETRY_S / scenario.frame_s))
        self._again_at: dict[tuple[str, int], int] = {}
        self._reported: dict[tuple[str, int], str] = {}
        self._comes = joining(scenario.events).union(*(group.reserve for group in scenario.mission.groups))
        """Drones whose slots stay free while they are on the ground: they may yet appear there."""

    def serve(self, source: Source) -> None:
        """Decide the requests of a source too; those of earlier sources are decided first."""
        self._sources.append(source)

    def renew(self, frame: int) -> None:
        """Decide the open requests; what is granted begins with this frame."""
        drones, homebound = self._world.drones, self._world.homebound
        for source in self._sources:
            requesting = [
                i
                for i in sorted(source.requesting())
                if drones[i].airborne and i not in homebound and frame >= self._again_at.get((source.event, i), 0)
            ]
            answers = self._decide(source, requesting, frame)
            for drone, answer in answers.items():
                if isinstance(answer, str) and source.lasts:
                    self._again_at[source.event, drone] = frame + self._retry_frames
                text = source.text(drone, answer)
                if text and self._reported.get((source.event, drone)) != text:  # once, however often it is repeated
                    self._reported[source.event, drone] = text
                    self._world.note(drone, source.event, text)
            self._fly([a for a in answers.values() if a is not None and not isinstance(a, str)])
            source.decided()

    def _decide(self, source: Source, requesting: Sequence[int], frame: int) -> dict[int, Answer]:
        gone = [i for i, d in enumerate(self._world.drones) if not (d.airborne or i in self._comes)]
        answers: dict[int, Answer] = {}
        while requesting:
            answers |= {i: source.answer(i, frame, gone) for i in requesting}
            again = [i for i in requesting if isinstance(answers[i], str)]  # who was in their way may have moved
            requesting = again if source.lasts and len(again) < len(requesting) else []
        return answers

    def descend(self, drone: int, descent_mps: float) -> float | None:
        """A drone goes down from the next frame on; returns when it touches down, None if not in this flight."""
        world = self._world
        frame = world.next_frame
        if frame >= world.motion.frames:
            return None
        height_m = float(world.motion[frame : frame + 1].position_m[0, drone, 2])
        self._fly([Descent(drone, frame, height_m, descent_mps)])
        return frame * self._frame_s + max(0.0, height_m) / descent_mps

    def appear(self, drone: int) -> None:
        """A drone that joins is in its slot from the next frame on."""
        frame = self._world.next_frame
        if frame >= self._world.motion.frames:
            return
        manoeuvres: list[Manoeuvre] = [Appearance(drone, frame)] if drone in self._world.motion.descents else []
        for source in self._sources:
            anew = source.appear(drone, frame)
            if anew:
                self._reported.pop((source.event, drone), None)
            manoeuvres.extend(anew)
        self._fly(manoeuvres)

    def _fly(self, manoeuvres: Sequence[Manoeuvre]) -> None:
        if manoeuvres:
            self._world.reroute(manoeuvres)


class Viewpoints(Source):
    """The viewpoints that policies choose. A request lasts until the policy makes another one."""

    event, lasts = VIEWPOINT, True

    def __init__(self, scenario: Scenario, world: World, *, posed_by_trace: bool) -> None:
        """Args: `posed_by_trace`: some drone flies a recorded pose.

        Viewpoints keep their distances within one formation. So no drone may move where others fly apart from it.

        Raises:
            MotionError: a slot's own way leaves the fence.
        """
        fleet = scenario.fleet
        self._world, self._bounds = world, bounds_of(fleet)
        self._course = course_of(fleet, np.asarray(world.motion.nominal.time_s))
        apart = bool(fleet.groups) or fleet.mobility != "formation"
        self._fixed = "flies a recorded pose" if posed_by_trace else "flies apart from the formation" * apart
        """Why no drone may move; empty where they may."""
        self._outside = set(range(fleet.drones)).difference(fleet.in_formation)
        self._requests: dict[int, tuple[float, float, str]] = {}
        self.plans: list[Plan] = [()] * fleet.drones

    def request(self, drone: int, viewpoint: Reposition | None) -> None:
        """Request a viewpoint for a drone from now on; None requests its slot."""
        if viewpoint is None:
            self._requests[drone] = (0.0, 0.0, "back to its slot")
            return
        frame = self._world.frame
        error_x_m, error_y_m, _ = self._world.misplaced_m(drone, frame)
        x_m, y_m = viewpoint.x_m - error_x_m, viewpoint.y_m - error_y_m
        self._requests[drone] = (*self._course.wanted_shift_m(drone, frame, x_m, y_m), viewpoint.reason)

    def requesting(self) -> Collection[int]:
        """Those of the formation."""
        return self._requests.keys() - self._outside

    def answer(self, drone: int, frame: int, gone: Sequence[int]) -> Answer:
        """The move that is granted joins the drone's plan."""
        if self._fixed:
            return self._fixed
        (x_m, y_m, _), left_out = self._requests[drone], {*gone, *self._outside}
        move = grant(ViewpointWish(drone, (x_m, y_m), self.plans, self._course, self._bounds, frame, left_out))
        if not isinstance(move, Move):
            return move
        self.plans[drone] = (*self.plans[drone], move)
        return Shifted(drone, frame, self.plans[drone], self._course)

    def text(self, drone: int, answer: Answer) -> str:
        """The way to the viewpoint, or why the drone stays."""
        if self._fixed:
            return f"holds its slot: a drone of the fleet {self._fixed}"
        reason = self._requests[drone][2]
        if isinstance(answer, Shifted):
            move = answer.plan[-1]
            (x_m, y_m), what = move.end_m, f"moves {move.length_m:.1f} m in {move.width_s:.1f} s"
            return f"{what}, to {x_m:+.1f} m ahead and {y_m:+.1f} m left of its slot: {reason}"
        return "" if answer is None else f"stays, {answer}: {reason}"


class SendsHome(Protocol):
    """Who sends drones home (`sortie.sim.engine.membership.Membership`)."""

    def go_home(self, drone: int, text: str) -> None: ...


class Planners(Source):
    """The commands of mobility models that plan in flight. Each planner reads the view of its drone's policy."""

    event, lasts = STEERING, False

    def __init__(self, scenario: Scenario, world: World, members: SendsHome, seed: int, replication: int) -> None:
        """Args: `members` sends a drone home that its planner lands.

        Raises:
            PluginError: a planner that is not there, does not load, or lacks its method; a start outside the bounds.
        """
        fleet = scenario.fleet
        self._fleet, self._world, self._members = fleet, world, members
        self._every = max(1, round(EVERY_S / scenario.frame_s))
        self._names: dict[int, str] = {}
        self._planners: dict[int, Guard] = {}
        self._starts_m: Array = starts_m(fleet)
        for part, drones in with_planners(fleet):
            model = found_mobility(part.mobility, part.mobility_params)
            for drone in drones:
                made = checked_call(
                    "mobility", model, drone, self._start(drone), stream(seed, replication, drone, "planner")
                )
                self._planners[drone] = Guard("mobility", made, ("command",))
                self._names[drone] = part.mobility.rpartition(":")[2]
        self._ways = {drone: self._resting(drone) for drone in self._planners}
        self._commands: dict[int, Command] = {}
        self._landing: list[int] = []
        self._places_m: Array | None = None
        """Where all drones will be from this frame on, while its commands are decided."""

    def _resting(self, drone: int) -> SteeredWay:
        x, y, z = self._start(drone)
        limits = self._fleet.steering
        low_m, high_m = limits.altitude_m
        west_m, south_m, east_m, north_m = limits.fence_m or (x, y, x, y)
        for within, what, name, bound in (
            (low_m <= z <= high_m, f"at a height of {z:g} m", "altitude_m", limits.altitude_m),
            (west_m <= x <= east_m and south_m <= y <= north_m, f"at ({x:g}, {y:g})", "fence_m", limits.fence_m),
        ):
            if not within:
                must = f"must be within fleet.steering.{name} {bound}"
                raise PluginError(f"mobility {self._names[drone]}: drone {drone} begins {what}, {must}")
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
        if planner is None or self._world.frame % self._every:
            return
        command = planner.command(view)  # type: ignore[attr-defined]
        if command is not None:
            self.request(drone, command)

    def request(self, drone: int, command: object) -> None:
        """Give a drone a command, to be decided in the next frame.

        Raises:
            PluginError: it is none.
        """
        if not is_command(command):
            kinds = ", ".join(kind.__name__ for kind in get_args(Command))
            what = f"returns {command!r}, must be None or one of {kinds} with finite numbers and speeds > 0"
            raise PluginError(f"mobility {self._names[drone]} on drone {drone}: {what}")
        self._commands[drone] = command

    def requesting(self) -> Collection[int]:
        """Those whose planners gave commands since the last frame."""
        return self._commands

    def answer(self, drone: int, frame: int, gone: Sequence[int]) -> Answer:
        """The way that is granted is the drone's from now on; those who are decided later keep clear of it."""
        motion, start_m = self._world.motion, self._starts_m[drone]
        nominal = motion.nominal[frame:]
        if self._places_m is None:
            self._places_m = motion.rest_m(frame)
            down = [i for i, d in enumerate(self._world.drones) if not d.airborne]
            self._places_m[:, down] = nominal.position_m[:, down]  # where they appear if they join
        ours, aim, hover_m = self._ways[drone], self._aim(drone, frame), nominal.position_m[:, drone]
        rest = nominal.time_s, self._places_m, gone
        way = grant(SteeringWish(drone, aim, ours, start_m, hover_m, *rest, self._fleet))
        if not isinstance(way, SteeredWay):
            return way
        self._ways[drone] = way
        self._places_m[:, drone] = hover_m + (way.at(nominal.time_s)[0] - start_m)
        if isinstance(self._commands[drone], Land):
            self._landing.append(drone)
        return Steered(drone, frame, way, self._start(drone))

    def _aim(self, drone: int, frame: int) -> GoTo | Velocity | Hold:
        """The command with its place where the drone would go: it believes to be elsewhere than it is."""
        command = self._commands[drone]
        if isinstance(command, Land):
            return Hold()
        if isinstance(command, Return):
            return GoTo(*self._start(drone))
        if not isinstance(command, GoTo):
            return command
        x_m, y_m, z_m = self._world.misplaced_m(drone, frame)
        height_m = None if command.z_m is None else command.z_m - z_m
        return GoTo(command.x_m - x_m, command.y_m - y_m, height_m, command.speed_mps)

    def _start(self, drone: int) -> Vector:
        x, y, z = self._starts_m[drone].tolist()
        return x, y, z

    def text(self, drone: int, answer: Answer) -> str:
        """The command, and why it is refused."""
        what = f"{self._names[drone]}: {type(self._commands[drone]).__name__}"
        return f"{what} refused, it {answer}" if isinstance(answer, str) else what

    def appear(self, drone: int, frame: int) -> Sequence[Manoeuvre]:
        """It rests in its slot until its next command."""
        if drone not in self._planners:
            return ()
        self._ways[drone] = self._resting(drone)
        self._commands.pop(drone, None)
        return [Steered(drone, frame, self._ways[drone], self._start(drone))]

    def decided(self) -> None:
        """Commands are decided once; the next one comes soon."""
        landing, self._landing, self._places_m = self._landing, [], None
        self._commands.clear()
        for drone in landing:
            self._members.go_home(drone, f"{self._names[drone]} lands it")
