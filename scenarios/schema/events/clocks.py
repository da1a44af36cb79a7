"""Clocks that are off or drift, and GNSS that is lost."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sortie.scenarios.schema.base import DroneId
from sortie.scenarios.schema.events.base import Event, Fleet, PoseFault


class ClockSkew(Event):
    """A clock jumps."""

    acts_live: ClassVar[bool] = True

    kind: Literal["clock_skew"]
    drone: DroneId = Field(description="Whose clock is off.")
    skew_s: float = Field(
        ge=-3600, le=3600, description="Added to its stamps; negative makes its descriptors look old."
    )

    def begin(self, fleet: Fleet) -> None:
        fleet.clock(self.drone).jump(fleet.t_s, self.skew_s)
        fleet.note(f"clock off by {self.skew_s:g} s", self.drone)
        fleet.read_clocks()


class ClockDrift(Event):
    """A clock runs too fast or too slowly from now on."""

    acts_live: ClassVar[bool] = True

    kind: Literal["clock_drift"]
    drone: DroneId = Field(description="Whose clock drifts, and follows GNSS no more.")
    drift_ppm: float = Field(ge=-100000, le=100000, description="How much too fast it runs from then on.")

    def begin(self, fleet: Fleet) -> None:
        fleet.clock(self.drone).drift(fleet.t_s, self.drift_ppm)
        fleet.note(f"clock drifts by {self.drift_ppm:g} ppm", self.drone)
        fleet.read_clocks()


class GnssLoss(PoseFault):
    """Clocks run by their own oscillators, and the believed position may walk."""

    acts_live: ClassVar[bool] = True

    kind: Literal["gnss_loss"]
    drone: DroneId | None = Field(None, description="Who loses it; left out, all drones.")
    position_walk_m: float = Field(
        0.0,
        ge=0,
        le=100,
        description="Dead reckoning: standard deviation of the believed position's error after one second, per horizontal axis; it grows with the square root of time.",
    )

    def begin(self, fleet: Fleet) -> None:
        for drone in self._members(fleet):
            rate_ppm = fleet.clock(drone).lose_gnss(fleet.t_s, fleet.index)
            how = "runs on as before" if rate_ppm is None else f"drifts by {rate_ppm:.3g} ppm"
            fleet.note(f"no GNSS: the clock {how}", drone)
        fleet.read_clocks()

    def end(self, fleet: Fleet, lasts: bool) -> None:
        for drone in self._members(fleet):
            clock = fleet.clock(drone)
            clock.regain_gnss(fleet.t_s, fleet.index)
            if not clock.has_gnss:
                fleet.note("still no GNSS: another loss lasts", drone)
            elif not clock.follows_gnss:
                fleet.note("GNSS is back: the clock does not follow it", drone, "gnss_back")
            else:
                fleet.note("the clock follows GNSS again", drone, "gnss_back")
        fleet.read_clocks()

    def pose_error(
        self, since_s: NDArray[np.float64], frame_s: float, rng: np.random.Generator
    ) -> NDArray[np.float64] | None:
        if not self.touches_pose:
            return None
        error = np.zeros((len(since_s), 4))
        error[:, :2] = np.cumsum(
            rng.normal(scale=self.position_walk_m * np.sqrt(frame_s), size=(len(since_s), 2)), axis=0
        )
        return error

    @property
    def touches_pose(self) -> bool:
        return self.position_walk_m > 0.0

    def _members(self, fleet: Fleet) -> list[int]:
        return [drone for drone in fleet.members if self.drone in (None, drone)]
