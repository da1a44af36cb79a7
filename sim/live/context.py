"""The senses of each drone of a live fleet: a sortie flown before, replayed at the wall clock's pace.

The paper's publishers replay context traces; here the trace is a flown scenario. Poses are the motion model's, the
mission is the plan's; charge, headrooms and goodput are those that the drone published in the simulated flight, under
the same policy, since on loopback there is neither a pack to drain nor a radio to measure.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass

import pyarrow.compute as pc

from sortie.fleet.agent import Platform, Task
from sortie.fleet.coverage import cameras_of
from sortie.fleet.senses import FlightSenses, Sensed
from sortie.fleet.traces import flown_motion
from sortie.perception.geometry import Cameras
from sortie.perception.scene.height_field import HeightField
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture
from sortie.policies.contract import Disc
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.mission import MissionPlan
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.engine.tracking import FleetTracking, TargetSeen
from sortie.sim.engine.world import cars_in_reach, route_bounds


@dataclass(frozen=True, slots=True)
class Trace:
    """What one drone published in the simulated flight, by rising time."""

    t_s: tuple[float, ...]
    platform: tuple[Platform, ...]
    goodput_mbps: tuple[tuple[float, ...], ...]
    end_s: float
    """From when on it is silent: it landed or was lost; infinite where it flew to the end."""

    def at(self, t_s: float) -> int:
        """Index of the latest row at `t_s`, the first one before there is any."""
        return max(0, bisect_right(self.t_s, t_s) - 1)


def traces(scenario: Scenario, progress: Callable[[float], None] | None = None) -> list[Trace]:
    """Fly the scenario without a detector and keep each drone's trace.

    Raises:
        PolicyError: its policy is unknown or breaks its contract.
    """
    perception = scenario.perception.model_copy(update={"detector": "none"})
    record = run_sortie(scenario.model_copy(update={"perception": perception}), progress=progress)
    rows, drones = record.tables["descriptors"], []
    for drone in range(scenario.fleet.drones):
        own = rows.filter(pc.equal(rows["drone"], drone)).to_pylist()
        t_s = tuple(row["t_s"] for row in own)
        silent_s = t_s[-1] + 1.5 * scenario.frame_s * scenario.context.publish_every if t_s else 0.0
        drones.append(
            Trace(
                t_s,
                tuple(Platform(row["soc"], row["cpu_headroom"], row["gpu_headroom"]) for row in own),
                tuple(tuple(row["goodput_mbps"]) for row in own),
                silent_s if silent_s < scenario.duration_s else float("inf"),
            )
        )
    return drones


class ReplaySenses:
    """One drone's own sensors (sortie.fleet.agent.Senses), frame 0 being the one of `begin_s`."""

    def __init__(self, scenario: Scenario, drone: int, trace: Trace, begin_s: float) -> None:
        motion, _ = flown_motion(scenario.fleet, scenario.duration_s, scenario.frame_s, scenario.seed)
        mission = scenario.mission
        self._scene = SceneModel(scenario.perception.scene, mission.target, route_bounds(motion), mission.more_targets)
        self._cameras = cameras_of(scenario.fleet)
        self._flight = FlightSenses(motion, scenario.frame_s, self._scene.height_field, self._cameras)
        self._plan = MissionPlan(mission, scenario.fleet.drones)
        self._tracking = FleetTracking(scenario, TargetSeen(self._scene))
        self._drone, self._trace = drone, trace
        self._first = round(begin_s / scenario.frame_s)
        self._sensed = self._flight.at(self._first)[drone]
        self._row = trace.at(begin_s)

    def sense(self, frame: int) -> Sensed:
        """The drone in a frame; the other methods then answer for the same moment."""
        self._sensed = sensed = self._flight.at(self._first + frame)[self._drone]
        self._row = self._trace.at(sensed.capture.t_s)
        return sensed

    @property
    def height_field(self) -> HeightField:
        """What hides the ground from the drones' cameras."""
        return self._scene.height_field

    @property
    def cameras(self) -> Cameras:
        """The drone's."""
        return self._cameras[self._drone]

    def platform(self) -> Platform:
        """Charge and headrooms."""
        return self._trace.platform[self._row]

    def goodput_mbps(self) -> tuple[float, ...]:
        """To every other drone by ascending id."""
        return self._trace.goodput_mbps[self._row]

    def task(self) -> Task:
        """Phase, region and targets."""
        now_s = self._sensed.capture.t_s
        now = self._plan.at(now_s)[self._plan.group_of[self._drone]]
        return now.task(lambda target, cue_m: self._tracking.follows(self._drone, target, cue_m, now_s))

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
