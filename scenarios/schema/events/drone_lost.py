"""Drones that are lost."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from sortie.scenarios.schema.base import DroneId
from sortie.scenarios.schema.events.base import Fleet, MemberEvent


class DroneLost(MemberEvent):
    """A drone falls silent."""

    presence: ClassVar[str] = "out"
    told_live: ClassVar[frozenset[str]] = frozenset({"drone_lost"})

    kind: Literal["drone_lost"]
    drone: DroneId = Field(description="Who falls silent and leaves.")

    def happen(self, fleet: Fleet) -> None:
        fleet.lose(self.drone)
