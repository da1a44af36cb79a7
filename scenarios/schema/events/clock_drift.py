"""Clocks that drift."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from sortie.scenarios.schema.base import DroneId
from sortie.scenarios.schema.events.base import Event, Fleet


class ClockDrift(Event):
    """A clock runs too fast or too slowly from now on."""

    acts_live: ClassVar[bool] = True

    kind: Literal["clock_drift"]
    drone: DroneId = Field(description="Whose clock drifts, and follows GNSS no more.")
    drift_ppm: float = Field(ge=-100000, le=100000, description="How much too fast it runs from then on.")

    def begin(self, fleet: Fleet) -> None:
        fleet.clock(self.drone).drift(fleet.t_s, self.drift_ppm)
        fleet.note(f"clock drifts by {self.drift_ppm:g} ppm", self.drone)
        fleet.read_clocks()
