"""`mission`: phases, regions and targets, of the fleet and of groups of drones."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from pydantic import Field, model_validator

from sortie.scenarios.schema.base import MOST_DRONES, DroneId, PhaseName, PointM, Section, Soc, inconsistent


class Target(Section):
    waypoints_m: tuple[PointM, ...] = Field(min_length=1, max_length=1000, description="Path, ENU (x, y).")
    speed_mps: float = Field(5.0, gt=0, le=40, description="Speed of the target car.")


class Region(Section):
    radius_m: float = Field(32.0, gt=0, le=2000, description="Radius of the mission disc.")
    centre_m: PointM | None = Field(
        None, description="Its centre, ENU (x, y); left out, the disc follows the phase's target."
    )


class Phase(Section):
    at_s: float = Field(0.0, ge=0, description="When the phase begins.")
    phase: PhaseName = Field("search", description="What the fleet is doing.")
    region: Region | None = Field(None, description="Region of responsibility during the phase.")
    target: int = Field(
        0, ge=0, le=100, description="The target of the phase: 0 is mission.target, 1 the first of more_targets."
    )


class Group(Section):
    drones: tuple[DroneId, ...] = Field(min_length=1, max_length=MOST_DRONES, description="Who belongs to the group.")
    phases: tuple[Phase, ...] = Field(
        min_length=1, max_length=100, description="The group's phases, in place of mission.phases."
    )
    reserve: tuple[DroneId, ...] = Field(
        (),
        max_length=MOST_DRONES,
        description="Drones of the group that wait on the ground and take over, in this order.",
    )


class Mission(Section):
    phases: tuple[Phase, ...] = Field(
        (Phase(),), min_length=1, max_length=100, description="Phases in order of time; the first begins at 0."
    )
    target: Target | None = Field(None, description="The car to track.")
    more_targets: tuple[Target, ...] = Field((), max_length=100, description="Further cars to track.")
    groups: tuple[Group, ...] = Field(
        (), max_length=100, description="Drones with phases of their own; all others fly mission.phases."
    )

    handover_soc: Soc | None = Field(
        None, description="At this charge a drone of a group with a reserve goes home; left out, none does."
    )
    descent_mps: float = Field(3.0, gt=0, le=10, description="How fast a drone that goes home descends.")

    @property
    def targets(self) -> tuple[Target, ...]:
        """Every target, by its number."""
        return (*(() if self.target is None else (self.target,)), *self.more_targets)

    @property
    def phases_of(self) -> tuple[tuple[Phase, ...], ...]:
        """The phases of each group by its number; 0 are the drones that are in none of `groups`."""
        return self.phases, *(group.phases for group in self.groups)

    def group_of(self, drone: int) -> int:
        """The number of a drone's group: 0, or k for `groups[k - 1]`."""
        return next((k for k, group in enumerate(self.groups, start=1) if drone in group.drones), 0)

    @model_validator(mode="after")
    def _sound(self) -> Mission:
        if self.more_targets and self.target is None:
            raise inconsistent(
                ("more_targets",), f"{len(self.more_targets)} of them", "left out without mission.target"
            )
        _check_phases(self.phases, len(self.targets), ())
        seen: set[int] = set()
        for k, group in enumerate(self.groups):
            _check_phases(group.phases, len(self.targets), ("groups", k))
            for i, drone in enumerate(group.drones):
                if drone in seen:
                    raise inconsistent(("groups", k, "drones", i), f"{drone}", "in one group, it is named above")
                seen.add(drone)
            for i, drone in enumerate(group.reserve):
                if drone not in group.drones or drone in group.reserve[:i]:
                    bound = f"one of the group's drones {sorted(group.drones)}, named once"
                    raise inconsistent(("groups", k, "reserve", i), f"{drone}", bound)
            if len(group.reserve) == len(group.drones):
                bound = "some of the group's drones, at least one must fly from the start"
                raise inconsistent(("groups", k, "reserve"), f"{list(group.reserve)}", bound)
        if self.handover_soc is not None and not any(group.reserve for group in self.groups):
            raise inconsistent(("handover_soc",), f"{self.handover_soc:g}", "left out where no group has a reserve")
        return self


def _check_phases(phases: Sequence[Phase], targets: int, at: tuple[str | int, ...]) -> None:
    """Phases in order, whose targets there are.

    Raises:
        ValidationError: naming the phase.
    """
    first = phases[0].at_s
    if first != 0:
        raise inconsistent((*at, "phases", 0, "at_s"), f"{first:g}", "0, the first phase begins the sortie")
    for i, (before, after) in enumerate(pairwise(phases), start=1):
        if after.at_s <= before.at_s:
            bound = f"above {before.at_s:g}, when the phase before begins"
            raise inconsistent((*at, "phases", i, "at_s"), f"{after.at_s:g}", bound)
    for i, phase in enumerate(phases):
        if phase.target and phase.target >= targets:
            bound = (
                f"below {targets}, the number of targets" if targets else "left out where there is no mission.target"
            )
            raise inconsistent((*at, "phases", i, "target"), f"{phase.target}", bound)
        if phase.region is not None and phase.region.centre_m is None and not targets:
            bound = "given where there is no mission.target to follow"
            raise inconsistent((*at, "phases", i, "region", "centre_m"), "missing", bound)
