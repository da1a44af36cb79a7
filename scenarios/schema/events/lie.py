"""Drones that lie."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from sortie.scenarios.schema.base import DroneId
from sortie.scenarios.schema.events.base import About, Claim, Fleet, Lasting


class Lie(Lasting):
    """A drone says what is false, in its own descriptors."""

    acts_live: ClassVar[bool] = True
    in_trace: ClassVar[bool] = False

    kind: Literal["lie"]
    drone: DroneId = Field(description="Who lies, in its own descriptors.")
    about: About = Field("coverage", description="What is false.")
    claim: Claim = Field(
        "much",
        description="All cells new, 500 Mb/s to everyone, a full battery; or nothing seen, 0.1 Mb/s, an empty one.",
    )

    def begin(self, fleet: Fleet) -> None:
        fleet.lie(self.drone, self.about, self.claim)
        fleet.note(f"claims {self.claim} {self.about}", self.drone)

    def end(self, fleet: Fleet, lasts: bool) -> None:
        fleet.lift()
        self.note_end(fleet, lasts, "lie_over", "tells the truth again", "still lies: another lie lasts")
