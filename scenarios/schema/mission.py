"""`mission`: phases, regions and the target."""

from __future__ import annotations

from itertools import pairwise

from pydantic import Field, model_validator

from sortie.scenarios.schema.base import PhaseName, PointM, Section, inconsistent


class Target(Section):
    waypoints_m: tuple[PointM, ...] = Field(
        min_length=1, max_length=1000, description="Path of the target car, ENU (x, y)."
    )
    speed_mps: float = Field(5.0, gt=0, le=40, description="Speed of the target car.")


class Region(Section):
    radius_m: float = Field(32.0, gt=0, le=2000, description="Radius of the mission disc.")
    centre_m: PointM | None = Field(None, description="Its centre, ENU (x, y); left out, the disc follows the target.")


class Phase(Section):
    at_s: float = Field(0.0, ge=0, description="When the phase begins.")
    phase: PhaseName = Field("search", description="What the fleet is doing.")
    region: Region | None = Field(None, description="Region of responsibility during the phase.")


class Mission(Section):
    phases: tuple[Phase, ...] = Field(
        (Phase(),), min_length=1, max_length=100, description="Phases in order of time; the first begins at 0."
    )
    target: Target | None = Field(None, description="The car to track.")

    @model_validator(mode="after")
    def _ordered(self) -> Mission:
        first = self.phases[0].at_s
        if first != 0:
            raise inconsistent(("phases", 0, "at_s"), f"{first:g}", "0, the first phase begins the sortie")
        for i, (before, after) in enumerate(pairwise(self.phases), start=1):
            if after.at_s <= before.at_s:
                bound = f"above {before.at_s:g}, when the phase before begins"
                raise inconsistent(("phases", i, "at_s"), f"{after.at_s:g}", bound)
        for i, phase in enumerate(self.phases):
            if phase.region is not None and phase.region.centre_m is None and self.target is None:
                bound = "given where there is no mission.target to follow"
                raise inconsistent(("phases", i, "region", "centre_m"), "missing", bound)
        return self
