"""The mission as a function of time: each group's phase, target and region of responsibility."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from typing import NamedTuple

from sortie.fleet.agent import Task
from sortie.perception.scene.traffic import TargetPath
from sortie.policies.contract import PHASE_OF, Disc
from sortie.scenarios.frames import instant
from sortie.scenarios.schema import Mission


class MissionNow(NamedTuple):
    """A group's mission at one instant; positions ENU."""

    phase: str
    region: Disc | None
    target: int
    """Number of the target, -1 where there is none. It is the car's id in the scene."""
    target_xy: tuple[float, float] | None

    def task(self, follows: Callable[[int, tuple[float, float]], bool]) -> Task:
        """What a drone is to do. In phase `track` it names the target while it has a track of it.

        Args: `follows` says whether the drone follows a target, by its number and where the ground station believes it is.
        """
        named = self.phase == "track" and self.target_xy is not None and follows(self.target, self.target_xy)
        return Task(PHASE_OF[self.phase], self.region, (self.target,) if named else ())


class MissionPlan:
    """Looks a group's mission up by time.

    The region of a phase without a centre follows the phase's target: the ground station cues the drones with the
    target's true position, as the paper's track-a-target task does.
    """

    def __init__(self, mission: Mission, drones: int) -> None:
        self._phases = mission.phases_of
        self._begins = [[instant(p.at_s) for p in phases] for phases in self._phases]
        self._targets = [TargetPath.of(target) for target in mission.targets]
        self.group_of = [mission.group_of(drone) for drone in range(drones)]
        """The number of each drone's group."""
        self.groups = sorted(set(self.group_of))
        """The groups that have drones."""

    def at(self, t_s: float) -> dict[int, MissionNow]:
        """The mission of each group that has drones, at `t_s`."""
        return {group: self._of(group, t_s) for group in self.groups}

    def region(self, drone: int, t_s: float) -> Disc | None:
        """The region of a drone's group at `t_s`."""
        return self._of(self.group_of[drone], t_s).region

    def _of(self, group: int, t_s: float) -> MissionNow:
        phase = self._phases[group][bisect_right(self._begins[group], instant(t_s)) - 1]
        number, target = -1, None
        if self._targets:
            number, target = phase.target, self._targets[phase.target].pose(t_s)[:2]
        region = phase.region
        if region is None:
            return MissionNow(phase.phase, None, number, target)
        centre = region.centre_m or target
        assert centre is not None, "the schema asks for a target where a region has no centre"  # noqa: S101
        return MissionNow(phase.phase, Disc(*centre, region.radius_m), number, target)
