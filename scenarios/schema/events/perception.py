"""Cameras that are covered, and perception that takes longer."""

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


class SlowPerception(Lasting):
    """A drone's features and boxes are ready later."""

    not_live: ClassVar[str] = "live drones believe their own poses"

    kind: Literal["slow_perception"]
    drone: DroneId = Field(description="The drone with features and boxes that are ready later.")
    extra_s: float = Field(0.2, gt=0, le=10, description="Added to the time from sensing to features ready to send.")

    def begin(self, fleet: Fleet) -> None:
        fleet.slow(self.drone, self.extra_s)
        fleet.note(f"its perception takes {self.extra_s:g} s longer", self.drone)

    def end(self, fleet: Fleet, lasts: bool) -> None:
        fleet.lift()
        still = f"its perception still takes {fleet.slowed_s(self.drone):g} s longer"
        self.note_end(fleet, lasts, "slow_perception_over", "its perception takes its usual time again", still)
