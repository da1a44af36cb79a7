"""Viewpoints in flight: what policies wish, what of it the formation grants, and the flight that comes of it.

A sortie whose policies choose no viewpoints has none of this. Wishes of a frame are granted together, by ascending id,
at the begin of the next one; whenever one is, the rest of the flight is worked out anew.
"""

from __future__ import annotations

import numpy as np

from sortie.fleet.flight.displaced import displaced
from sortie.fleet.flight.viewpoints import Move, Plan, bounds_of, course_of, grant
from sortie.policies.contract import Reposition
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.world import World

RETRY_S = 1.0
"""A wish that was refused is looked at again after so long: the others have hardly moved on before."""
EVENT = "viewpoint"
"""The kind under which grants and refusals stand among the record's events."""


class Choreography:
    """Where every drone flies, as its policy asks and safety allows."""

    def __init__(self, scenario: Scenario, world: World, *, posed_by_trace: bool) -> None:
        """Args: `posed_by_trace` says that a drone flies a recorded pose: nobody knows its plans, so nobody moves.

        Raises:
            MotionError: a slot's own way leaves the fence.
        """
        self._world, self._base = world, world.motion
        self._course = course_of(scenario.fleet, np.asarray(world.motion.time_s))
        self._bounds = bounds_of(scenario.fleet)
        self._fixed = posed_by_trace
        self._frame = 0
        self._wishes: dict[int, tuple[float, float, str]] = {}
        self._told: dict[int, str] = {}
        self._again_at: dict[int, int] = {}
        self._retry_frames = max(1, round(RETRY_S / scenario.frame_s))
        self.plans: list[Plan] = [()] * scenario.fleet.drones

    def ask(self, drone: int, asked: Reposition | None) -> None:
        """A drone's wish from now on; None is its slot."""
        if asked is None:
            self._wishes[drone] = (0.0, 0.0, "back to its slot")
            return
        motion, at = self._world.motion, (self._frame, drone)
        error_x_m, error_y_m, _ = (motion.est_position_m[at] - motion.position_m[at]).tolist()
        shift = self._course.wanted_shift_m(drone, self._frame, asked.x_m - error_x_m, asked.y_m - error_y_m)
        self._wishes[drone] = (*shift, asked.reason)

    def renew(self, frame: int) -> None:
        """Grant what can be granted, to begin with this frame; call it before anything else looks at the frame."""
        self._frame = frame
        drones, again_at = self._world.drones, self._again_at
        asking = [i for i in sorted(self._wishes) if drones[i].airborne and frame >= again_at.get(i, 0)]
        if self._fixed:
            for drone in asking:
                self._tell(drone, "holds its slot: a drone of the fleet flies a recorded pose")
            return
        answers: dict[int, Move | str | None] = {}
        moved = False
        while asking:  # who was in the way may have been granted a move meanwhile
            answers |= {i: self._granted(i) for i in asking}
            again = [i for i in asking if isinstance(answers[i], str)]
            moved |= any(isinstance(answers[i], Move) for i in asking)
            asking = again if len(again) < len(asking) else []
        for drone, answer in answers.items():
            self._write(drone, answer)
        if moved:
            self._world.reroute(displaced(self._world.motion, self._base, self._course, self.plans, frame))

    def _granted(self, drone: int) -> Move | str | None:
        """What comes of a wish; a move is on the plan from here on."""
        x_m, y_m, _ = self._wishes[drone]
        gone = [i for i, status in enumerate(self._world.drones) if not status.airborne]
        answer = grant(drone, (x_m, y_m), self.plans, self._course, self._bounds, self._frame, gone)
        if isinstance(answer, Move):
            self.plans[drone] = (*self.plans[drone], answer)
        return answer

    def _write(self, drone: int, answer: Move | str | None) -> None:
        reason = self._wishes[drone][2]
        if isinstance(answer, Move):
            (x_m, y_m), what = answer.end_m, f"moves {answer.length_m:.1f} m in {answer.width_s:.1f} s"
            self._told.pop(drone, None)
            self._world.note(drone, EVENT, f"{what}, to {x_m:+.1f} m ahead and {y_m:+.1f} m left of its slot: {reason}")
        elif answer is not None:
            self._again_at[drone] = self._frame + self._retry_frames
            self._tell(drone, f"stays, {answer}: {reason}")

    def _tell(self, drone: int, text: str) -> None:
        """Once, however often the wish is repeated."""
        if self._told.get(drone) != text:
            self._told[drone] = text
            self._world.note(drone, EVENT, text)
