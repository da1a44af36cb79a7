"""The mission as a function of time: phase, target and region of responsibility."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

from sortie.fleet.agent import Task
from sortie.perception.scene.traffic import TARGET_ID, TargetPath
from sortie.policies.contract import PHASE_OF, Disc
from sortie.scenarios.schema import Mission


class MissionNow(NamedTuple):
    """The mission at one instant; positions ENU."""

    phase: str
    region: Disc | None
    target_xy: tuple[float, float] | None

    def task(self, own_xy_m: Sequence[float], footprint_m: float) -> Task:
        """What a drone at `own_xy_m` is to do; it names the target while it tracks it and has it in its footprint."""
        phase, region, target = self
        targets: tuple[int, ...] = ()
        if phase == "track" and target is not None:
            dx_m, dy_m = target[0] - own_xy_m[0], target[1] - own_xy_m[1]
            if dx_m * dx_m + dy_m * dy_m <= footprint_m * footprint_m:
                targets = (TARGET_ID,)
        return Task(PHASE_OF[phase], region, targets)


class MissionPlan:
    """Looks the mission up by time.

    The region of a phase without a centre follows the target: the ground station cues the fleet with the
    target's true position, as the paper's track-a-target task does.
    """

    def __init__(self, mission: Mission) -> None:
        self._phases = mission.phases
        self._begins_s = [p.at_s for p in mission.phases]
        self._target = None if mission.target is None else TargetPath.of(mission.target)

    def at(self, t_s: float) -> MissionNow:
        """The mission at `t_s`."""
        phase = self._phases[bisect_right(self._begins_s, t_s + 1e-9) - 1]
        target = None if self._target is None else self._target.pose(t_s)[:2]
        region = phase.region
        if region is None:
            return MissionNow(phase.phase, None, target)
        centre = region.centre_m or target
        assert centre is not None, "the schema asks for a target where a region has no centre"  # noqa: S101
        return MissionNow(phase.phase, Disc(*centre, region.radius_m), target)
