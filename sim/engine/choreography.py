"""Viewpoints in flight: the moves that policies request, those that are safe, and the motion that follows.

It is used only where a policy chooses viewpoints. Requests of one frame are decided together at the begin of the next
frame, by ascending drone. After a granted move the rest of the flight is computed again.
"""

from __future__ import annotations

import numpy as np

from sortie.fleet.flight.displaced import displaced
from sortie.fleet.flight.viewpoints import Move, Plan, bounds_of, course_of, grant
from sortie.policies.contract import Reposition
from sortie.scenarios.schema import Scenario
from sortie.scenarios.schema.events.base import joining
from sortie.sim.engine.world import World

RETRY_S = 1.0
"""Time until a refused request is decided again; the other drones have hardly moved before."""
EVENT = "viewpoint"
"""The kind of grants and refusals among the record's events."""


class Choreography:
    """Moves drones to the viewpoints that their policies request, as far as safety allows."""

    def __init__(self, scenario: Scenario, world: World, *, posed_by_trace: bool) -> None:
        """Args: `posed_by_trace`: some drone flies a recorded pose.

        Viewpoints keep their distances within one formation. So no drone may move where others fly apart from it.

        Raises:
            MotionError: a slot's own way leaves the fence.
        """
        self._world, self._base = world, world.motion
        self._course = course_of(scenario.fleet, np.asarray(world.motion.time_s))
        self._bounds = bounds_of(scenario.fleet)
        apart = bool(scenario.fleet.groups) or scenario.fleet.mobility != "formation"
        self._fixed = "flies a recorded pose" if posed_by_trace else "flies apart from the formation" * apart
        """Why no drone may move; empty where they may."""
        self._outside = set(range(scenario.fleet.drones)).difference(scenario.fleet.in_formation)
        self._frame = 0
        self._comes = joining(scenario.events).union(*(group.reserve for group in scenario.mission.groups))
        """Drones whose slots stay free while they are on the ground: they may yet appear there."""
        self._requests: dict[int, tuple[float, float, str]] = {}
        self._reported: dict[int, str] = {}
        self._again_at: dict[int, int] = {}
        self._retry_frames = max(1, round(RETRY_S / scenario.frame_s))
        self.plans: list[Plan] = [()] * scenario.fleet.drones

    def request(self, drone: int, viewpoint: Reposition | None) -> None:
        """Request a viewpoint for a drone from now on; None requests its slot."""
        if viewpoint is None:
            self._requests[drone] = (0.0, 0.0, "back to its slot")
            return
        believed_m = self._world.sensed(drone, self._frame).capture.est_position_m  # faults of its sensors included
        true_m = self._world.motion.position_m[self._frame, drone]
        error_x_m, error_y_m, _ = (np.array(believed_m) - true_m).tolist()
        shift = self._course.wanted_shift_m(drone, self._frame, viewpoint.x_m - error_x_m, viewpoint.y_m - error_y_m)
        self._requests[drone] = (*shift, viewpoint.reason)

    def renew(self, frame: int) -> None:
        """Decide the open requests; granted moves begin with this frame. Call it first in a frame."""
        self._frame = frame
        flies = [d.airborne and i not in self._world.homebound for i, d in enumerate(self._world.drones)]
        asked = sorted(self._requests.keys() - self._outside)
        requesting = [i for i in asked if flies[i] and frame >= self._again_at.get(i, 0)]
        if self._fixed:
            for drone in requesting:
                self._report_once(drone, f"holds its slot: a drone of the fleet {self._fixed}")
            return
        answers: dict[int, Move | str | None] = {}
        moved = False
        while requesting:  # who was in the way may have been granted a move meanwhile
            answers |= {i: self._granted(i) for i in requesting}
            again = [i for i in requesting if isinstance(answers[i], str)]
            moved |= any(isinstance(answers[i], Move) for i in requesting)
            requesting = again if len(again) < len(requesting) else []
        for drone, answer in answers.items():
            self._write(drone, answer)
        if moved:
            self._world.reroute(displaced(self._world.motion, self._base, self._course, self.plans, frame))

    def _granted(self, drone: int) -> Move | str | None:
        """The answer to a request: a move, which is then part of the plan, or the reason for refusal."""
        x_m, y_m, _ = self._requests[drone]
        gone = [
            i for i, d in enumerate(self._world.drones) if i in self._outside or not (d.airborne or i in self._comes)
        ]
        answer = grant(drone, (x_m, y_m), self.plans, self._course, self._bounds, self._frame, gone)
        if isinstance(answer, Move):
            self.plans[drone] = (*self.plans[drone], answer)
        return answer

    def _write(self, drone: int, answer: Move | str | None) -> None:
        reason = self._requests[drone][2]
        if isinstance(answer, Move):
            (x_m, y_m), what = answer.end_m, f"moves {answer.length_m:.1f} m in {answer.width_s:.1f} s"
            self._reported.pop(drone, None)
            self._world.note(drone, EVENT, f"{what}, to {x_m:+.1f} m ahead and {y_m:+.1f} m left of its slot: {reason}")
        elif answer is not None:
            self._again_at[drone] = self._frame + self._retry_frames
            self._report_once(drone, f"stays, {answer}: {reason}")

    def _report_once(self, drone: int, text: str) -> None:
        """Record a text once, however often the request is repeated."""
        if self._reported.get(drone) != text:
            self._reported[drone] = text
            self._world.note(drone, EVENT, text)
