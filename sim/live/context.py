"""The senses of each drone of a live fleet: a sortie flown before, replayed at the wall clock's pace.

The paper's publishers replay context traces; here the trace is a flown scenario. Poses, charge, headrooms and goodput are
those of the simulated flight, under the same policies, since on loopback there is neither a pack to drain nor a radio to
measure. So are joins, departures and losses: `sortie.sim.engine.membership` decided them there. Lies and faults of clocks
are no part of a trace, because a live drone has them itself (`sortie.sim.live.events`).
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from sortie.fleet.agent import Platform, Task
from sortie.fleet.coverage import cameras_of
from sortie.fleet.flight.motion import OF_A_DRONE, Trajectories
from sortie.fleet.flight.steering import area_m
from sortie.fleet.senses import FlightSenses, Sensed
from sortie.fleet.traces import flown_motion
from sortie.perception.geometry import Cameras
from sortie.perception.scene.height_field import HeightField
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture
from sortie.policies.contract import PERSON_FLAG, PHASE_NAMES, Disc, TaskPhase, goodput_in
from sortie.scenarios.frames import frames_at
from sortie.scenarios.schema import KINDS, Limits, Scenario
from sortie.sim.apart import Said, call_within
from sortie.sim.engine.mission import MissionPlan
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import build, fly
from sortie.sim.engine.tracking import FleetTracking, TargetSeen, cars_in_reach

_REPLAYED_EVENTS = frozenset({"landed", "power_lost"}).union(*(kind.told_live for kind in KINDS.values()))
_RESTED = Platform(1.0, 1.0, 1.0)
Bounds = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Published:
    """What a drone published in one frame of the simulated flight, as far as it does not follow from its pose."""

    platform: Platform = _RESTED
    goodput_mbps: tuple[float, ...] = ()
    homebound: bool = False
    """Whether it published LANDING without a region."""
    person: bool = False
    """Whether its thermal camera had found a person in its region lately."""


@dataclass(frozen=True, slots=True)
class Trace:
    """One drone in the simulated flight."""

    motion: Trajectories
    """Its own, as the only drone."""
    bounds: Bounds
    """x_min, y_min, x_max, y_max of what the fleet was to fly, ENU; the scene follows from them."""
    t_s: tuple[float, ...] = (0.0,)
    """When the frames of `published` began."""
    published: tuple[Published, ...] = (Published(),)
    aloft: tuple[tuple[float, float], ...] = ((0.0, float("inf")),)
    """From when until when it was in the fleet."""
    events: tuple[tuple[float, str], ...] = ()
    """What happened to it."""

    def at(self, t_s: float) -> Published:
        """The latest that it published by `t_s`; the first one before there is any."""
        return self.published[max(0, bisect_right(self.t_s, t_s) - 1)]


def unflown(scenario: Scenario, drone: int) -> Trace:
    """The trace of a drone that is never sensed: its way by the plan, nothing published."""
    motion, _ = flown_motion(scenario.fleet, scenario.duration_s, scenario.frame_s, scenario.seed)
    return Trace(_only(motion, drone), motion.bounds_m())


def traces(scenario: Scenario, progress: Callable[[float], None] | None = None) -> list[Trace]:
    """Fly the scenario without a detector, boxes with maps and lies, and keep each drone's trace.

    Raises:
        PolicyError: its policy is unknown, fails or breaks its contract.
        LimitError: its policy takes longer than `limits.decision_s`.
    """
    limits = Limits(decision_s=scenario.limits.decision_s)
    if progress is None or not limits.are_set:
        work, hear = partial(_flown, scenario, progress), {}
    else:
        work, hear = partial(_flown, scenario, Said("progress")), {"progress": progress}
    return cast("list[Trace]", call_within(limits, scenario.name, work, hear) if limits.are_set else work())


def _flown(scenario: Scenario, progress: Callable[[float], None] | None) -> list[Trace]:
    """`traces`, in this process."""
    alone = {"detector": "none", "maps_bring_boxes": False, "match_poses": False}
    perception = scenario.perception.model_copy(update=alone)
    honest = tuple(event for event in scenario.events if event.in_trace)
    # a roster would shorten the goodputs to those of its members; the live drone makes its own
    context = scenario.context.model_copy(update={"roster": False})
    flown = scenario.model_copy(update={"perception": perception, "context": context, "events": honest})
    parts = build(flown, plan_for(flown), flown.seed)
    bounds = area_m(flown.fleet, parts.world.motion.nominal.bounds_m())
    fly(parts, progress)
    tables, motion = parts.recorder.finish(), parts.world.motion[:]
    return [_trace(scenario, drone, _only(motion, drone), bounds, tables) for drone in range(scenario.fleet.drones)]


def _trace(
    scenario: Scenario, drone: int, motion: Trajectories, bounds: Bounds, tables: Mapping[str, pa.Table]
) -> Trace:
    frame_s = scenario.frame_s
    own = {
        name: tables[name].filter(pc.equal(tables[name]["drone"], drone))
        for name in ("states", "descriptors", "events")
    }
    published = [
        Published(
            Platform(row["soc"], row["cpu_headroom"], row["gpu_headroom"]),
            tuple(row["goodput_mbps"]),
            row["phase"] == PHASE_NAMES[TaskPhase.LANDING] and np.isnan(row["region_x_m"]),
            bool(row["novelty_flags"] & PERSON_FLAG),
        )
        for row in own["descriptors"].to_pylist()
    ]
    frames = frames_at(own["descriptors"]["t_s"], frame_s)  # it publishes within its frame
    never = Published(goodput_mbps=(0.0,) * (scenario.fleet.drones - 1))
    return Trace(
        motion,
        bounds,
        tuple((frames * frame_s).tolist()) or (0.0,),
        tuple(published) or (never,),
        _runs(np.array(own["states"]["airborne"]), frame_s),
        tuple((row["t_s"], row["text"]) for row in own["events"].to_pylist() if row["kind"] in _REPLAYED_EVENTS),
    )


def _runs(airborne: np.ndarray, frame_s: float) -> tuple[tuple[float, float], ...]:
    """From when until when a row of frames is true; without an end where the last one is."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], airborne, [False]])))
    ends = [float("inf") if until == len(airborne) else until * frame_s for until in edges[1::2].tolist()]
    return tuple(zip((edges[::2] * frame_s).tolist(), ends, strict=True))


def _only(motion: Trajectories, drone: int) -> Trajectories:
    """One drone's motion."""
    own = {name: getattr(motion, name)[:, drone : drone + 1].copy() for name in (*OF_A_DRONE, "wind_mps")}
    return replace(motion, **own)


class ReplaySenses:
    """One drone's own sensors (sortie.fleet.agent.Senses), frame 0 being the one of `begin_s`."""

    def __init__(self, scenario: Scenario, drone: int, trace: Trace, begin_s: float) -> None:
        mission = scenario.mission
        self._scene = SceneModel(scenario.perception.scene, mission.target, trace.bounds, mission.more_targets)
        self._cameras = cameras_of(scenario.fleet)[drone]
        blind = (0,) if drone in scenario.fleet.without_camera else ()
        self._flight = FlightSenses(
            trace.motion, scenario.frame_s, self._scene.height_field, [self._cameras], blind=blind
        )
        self._plan = MissionPlan(mission, scenario.fleet.drones)
        self._tracking = FleetTracking(scenario, TargetSeen(self._scene))
        self._drone, self._trace = drone, trace
        self._first = round(begin_s / scenario.frame_s)
        self.sense(0)

    def sense(self, frame: int) -> Sensed:
        """The drone in a frame; the other methods then answer for the same moment."""
        (alone,) = self._flight.at(self._first + frame)
        self._sensed = alone._replace(capture=alone.capture._replace(drone=self._drone))
        self._published = self._trace.at(alone.capture.t_s)
        return self._sensed

    @property
    def refused(self) -> dict[str, int]:
        """Nothing: a replay is not heard."""
        return {}

    @property
    def height_field(self) -> HeightField:
        """What hides the ground from the drones' cameras."""
        return self._scene.height_field

    @property
    def cameras(self) -> Cameras:
        """The drone's."""
        return self._cameras

    def platform(self) -> Platform:
        """Charge and headrooms."""
        return self._published.platform

    def goodput_mbps(self, to: Sequence[int] | None = None) -> tuple[float, ...]:
        """To some drones, 0 for those beyond the scenario's fleet; to every other one of that by ascending id without `to`."""
        known = self._published.goodput_mbps
        return known if to is None else tuple([goodput_in(known, self._drone, None, peer) for peer in to])

    def task(self) -> Task:
        """Phase, region, targets, and whether a person is in the region."""
        now_s = self._sensed.capture.t_s
        if self._published.homebound:
            return Task(TaskPhase.LANDING, None)
        now = self._plan.at(now_s)[self._plan.group_of[self._drone]]
        task = now.task(lambda target, cue_m: self._tracking.follows(self._drone, target, cue_m, now_s))
        return task._replace(person_in_region=self._published.person)

    def count_boxes(self, capture: Capture, roi: Disc | None) -> int:
        """Cars in range: no detector runs here."""
        return cars_in_reach(self._scene, capture, roi)

    def perceived(self, capture: Capture) -> None:
        """The drone looked: it finds a target that it has in view."""
        self._tracking.perceived(capture)

    def people_in(self, capture: Capture, roi: Disc | None) -> Boxes:
        """Nobody: no thermal camera runs here."""
        return Boxes.empty()

    def tracks_in(self, capture: Capture, roi: Disc | None) -> None:
        """No tracks: no detector runs here."""
