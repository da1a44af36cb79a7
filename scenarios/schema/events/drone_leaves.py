"""Drones that go home."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from sortie.scenarios.schema.base import DroneId
from sortie.scenarios.schema.events.base import Fleet, MemberEvent, Misfit
from sortie.scenarios.schema.movement import GroundStation


class DroneLeaves(MemberEvent):
    """A drone descends and leaves the fleet."""

    presence: ClassVar[str] = "out"
    told_live: ClassVar[frozenset[str]] = frozenset({"drone_leaves"})

    kind: Literal["drone_leaves"]
    drone: DroneId = Field(description="Who goes home: it publishes landing, descends and leaves.")

    def misfit(self, station: GroundStation | None) -> Misfit | None:
        if station is None:
            return None
        bound = "a drone that flies, it is a ground station" + " on mains power" * station.mains
        return "drone", f"{self.drone}", bound

    def no_effect(self, flies: bool, descends: bool) -> str:
        return "it already descends" if descends else super().no_effect(flies, descends)

    def happen(self, fleet: Fleet) -> None:
        fleet.send_home(self.drone)
