"""Drones that are lost, join or go home, and batteries that fail."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from sortie.scenarios.schema.base import DroneId
from sortie.scenarios.schema.events.base import Fleet, MemberEvent, Misfit, PackEvent
from sortie.scenarios.schema.movement import GroundStation


class DroneLost(MemberEvent):
    """A drone falls silent."""

    presence: ClassVar[str] = "out"
    told_live: ClassVar[frozenset[str]] = frozenset({"drone_lost"})

    kind: Literal["drone_lost"]
    drone: DroneId = Field(description="Who falls silent and leaves.")

    def happen(self, fleet: Fleet) -> None:
        fleet.lose(self.drone)


class DroneJoins(MemberEvent):
    """A drone on the ground appears in its slot."""

    presence: ClassVar[str] = "in"
    told_live: ClassVar[frozenset[str]] = frozenset({"drone_joins", "stays_down"})

    kind: Literal["drone_joins"]
    drone: DroneId = Field(
        description="The drone that joins. It begins on the ground, unless an earlier event made it leave or lost it."
    )

    def no_effect(self, flies: bool, descends: bool) -> str:
        if descends:
            return "it still descends"
        return "it is already in the fleet" if flies else ""

    def happen(self, fleet: Fleet) -> None:
        fleet.join(self.drone)


class DroneLeaves(MemberEvent):
    """A drone descends and leaves the fleet."""

    presence: ClassVar[str] = "out"
    told_live: ClassVar[frozenset[str]] = frozenset({"drone_leaves"})

    kind: Literal["drone_leaves"]
    drone: DroneId = Field(description="Who goes home: it publishes landing, descends and leaves.")

    def misfit(self, station: GroundStation | None) -> Misfit | None:
        if station is not None:
            bound = "a drone that flies, it is a ground station" + " on mains power" * station.mains
            return "drone", f"{self.drone}", bound
        return super().misfit(station)

    def no_effect(self, flies: bool, descends: bool) -> str:
        return "it already descends" if descends else super().no_effect(flies, descends)

    def happen(self, fleet: Fleet) -> None:
        fleet.send_home(self.drone)


class BatteryFault(PackEvent):
    """A part of a battery's energy is gone at once."""

    told_live: ClassVar[frozenset[str]] = frozenset({"battery_fault"})

    kind: Literal["battery_fault"]
    drone: DroneId = Field(description="Whose battery fails.")
    lost_fraction: float = Field(gt=0, le=1, description="Fraction of the remaining energy that is gone at once.")

    def happen(self, fleet: Fleet) -> None:
        fleet.note(f"{self.lost_fraction:.0%} of the remaining energy is gone", self.drone)
        fleet.drain(self.drone, self.lost_fraction)


class CellFailure(PackEvent):
    """A pack loses a cell."""

    told_live: ClassVar[frozenset[str]] = frozenset({"cell_failure"})

    kind: Literal["cell_failure"]
    drone: DroneId = Field(description="Whose pack loses a cell: its voltage and its energy are gone.")

    def happen(self, fleet: Fleet) -> None:
        left = fleet.cells(self.drone) - 1
        fleet.note({0: "no cell is left", 1: "1 cell is left"}.get(left, f"{left} cells are left"), self.drone)
        fleet.drop_cell(self.drone)
