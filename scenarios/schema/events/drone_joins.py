"""Drones that join."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from sortie.scenarios.schema.base import DroneId
from sortie.scenarios.schema.events.base import Fleet, MemberEvent


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
