"""Cameras that are covered."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from sortie.scenarios.schema.base import DroneId
from sortie.scenarios.schema.events.base import Fleet, Lasting


class CameraBlocked(Lasting):
    """A drone's cameras see nothing."""

    not_live: ClassVar[str] = "live drones believe their own poses"

    kind: Literal["camera_blocked"]
    drone: DroneId = Field(description="Whose cameras see nothing.")

    def begin(self, fleet: Fleet) -> None:
        fleet.block_cameras(self.drone)
        fleet.note("its cameras see nothing", self.drone)

    def end(self, fleet: Fleet, lasts: bool) -> None:
        fleet.lift()
        still = "its cameras still see nothing: another block lasts"
        self.note_end(fleet, lasts, "camera_clear", "its cameras see again", still)
