"""Drones that believe to look elsewhere."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sortie.scenarios.schema.base import DroneId
from sortie.scenarios.schema.events.base import Fleet, PoseFault


class HeadingFault(PoseFault):
    """The believed heading jumps and drifts."""

    not_live: ClassVar[str] = "live drones believe their own poses"

    kind: Literal["heading_fault"]
    drone: DroneId = Field(description="Who believes to look elsewhere.")
    offset_deg: float = Field(0.0, ge=-180, le=180, description="Added to the believed heading, counter-clockwise.")
    drift_degps: float = Field(0.0, ge=-90, le=90, description="Degrees a second by which it drifts from then on.")

    def begin(self, fleet: Fleet) -> None:
        how = f"believes its heading {self.offset_deg:g}° off, drifting by {self.drift_degps:g}° a second"
        fleet.note(how, self.drone)

    def pose_error(self, since_s: NDArray[np.float64], frame_s: float, rng: np.random.Generator) -> NDArray[np.float64]:
        error = np.zeros((len(since_s), 4))
        error[:, 3] = np.deg2rad(self.offset_deg + since_s * self.drift_degps)
        return error
