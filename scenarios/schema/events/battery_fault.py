"""Batteries that lose energy."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from sortie.scenarios.schema.base import DroneId
from sortie.scenarios.schema.events.base import Fleet, PackEvent


class BatteryFault(PackEvent):
    """A part of a battery's energy is gone at once."""

    told_live: ClassVar[frozenset[str]] = frozenset({"battery_fault"})

    kind: Literal["battery_fault"]
    drone: DroneId = Field(description="Whose battery fails.")
    lost_fraction: float = Field(gt=0, le=1, description="Fraction of the remaining energy that is gone at once.")

    def happen(self, fleet: Fleet) -> None:
        fleet.note(f"{self.lost_fraction:.0%} of the remaining energy is gone", self.drone)
        fleet.drain(self.drone, self.lost_fraction)
