"""Clocks that are off."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from sortie.scenarios.schema.base import DroneId
from sortie.scenarios.schema.events.base import Event, Fleet


class ClockSkew(Event):
    """A clock jumps."""

    acts_live: ClassVar[bool] = True

    kind: Literal["clock_skew"]
    drone: DroneId = Field(description="Whose clock is off.")
    skew_s: float = Field(
        ge=-3600, le=3600, description="Added to its stamps; negative makes its descriptors look old."
    )

    def begin(self, fleet: Fleet) -> None:
        fleet.clock(self.drone).jump(fleet.t_s, self.skew_s)
        fleet.note(f"clock off by {self.skew_s:g} s", self.drone)
        fleet.read_clocks()
