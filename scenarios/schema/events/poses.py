"""Drones that believe to be, or to look, elsewhere than they do."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sortie.scenarios.schema.base import DroneId
from sortie.scenarios.schema.events.base import Fleet, PoseFault

Metres = Annotated[float, Field(ge=-10000, le=10000)]
Speed = Annotated[float, Field(ge=-1000, le=1000)]


class PositionFault(PoseFault):
    """The believed position jumps and drifts."""

    not_live: ClassVar[str] = "live drones believe their own poses"

    kind: Literal["position_fault"]
    drone: DroneId = Field(description="Who believes to be somewhere else.")
    offset_m: tuple[Metres, Metres, Metres] = Field(
        (0.0, 0.0, 0.0), description="A jump of the believed position, ENU (x, y, z)."
    )
    drift_mps: tuple[Speed, Speed, Speed] = Field(
        (0.0, 0.0, 0.0), description="How fast the believed position drifts from then on, ENU."
    )

    def begin(self, fleet: Fleet) -> None:
        offset_m, drift_mps = (math.hypot(*vector) for vector in (self.offset_m, self.drift_mps))
        fleet.note(f"believes to be {offset_m:.3g} m away, drifting at {drift_mps:.3g} m/s", self.drone)

    def pose_error(self, since_s: NDArray[np.float64], frame_s: float, rng: np.random.Generator) -> NDArray[np.float64]:
        error = np.zeros((len(since_s), 4))
        error[:, :3] = np.array(self.offset_m) + since_s[:, None] * np.array(self.drift_mps)
        return error


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
