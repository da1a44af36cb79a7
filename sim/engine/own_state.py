"""What scenario events do to one drone's own clock and words, in a sortie and in `sortie live` alike."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

from sortie.fleet.clock import Oscillator
from sortie.fleet.lies import falsified
from sortie.fleet.plane import DroneStatus
from sortie.scenarios.schema import ClockDrift, ClockSkew, Event, GnssLoss, Lie

OwnEvent = ClockSkew | ClockDrift | GnssLoss | Lie


class Told(NamedTuple):
    """What is written down about an event."""

    kind: str
    text: str


class OwnState:
    """A drone's clock and its lies. It keeps `DroneStatus.clock_skew_s` and `DroneStatus.lies`."""

    def __init__(self, status: DroneStatus, oscillator: Oscillator, *, gnss: bool, zero_s: float = 0.0) -> None:
        """Args: `zero_s`: what a perfect clock shows at time 0."""
        self._status, self._oscillator, self._zero_s = status, oscillator, zero_s
        self._clock = oscillator.at_start(gnss)
        self._follows_gnss = gnss  # wherever there is GNSS
        self._losses: set[int] = set()  # of GNSS, those that last
        self.read(0.0)

    def read(self, now_s: float) -> None:
        """Bring the drone's clock to the present."""
        self._status.clock_skew_s = self._zero_s + self._clock.error_s(now_s)

    def begin(self, event: OwnEvent, index: int, now_s: float) -> Told:
        """An event begins; `index` is its place among the scenario's."""
        own = self._oscillator
        match event:
            case ClockSkew():
                self._set(now_s, offset_s=event.skew_s)
                return Told("clock_skew", f"clock off by {event.skew_s:g} s")
            case ClockDrift():
                self._follows_gnss = False
                self._set(now_s, rate_ppm=event.drift_ppm, growth_ppm_per_min=0.0)
                return Told("clock_drift", f"clock drifts by {event.drift_ppm:g} ppm")
            case GnssLoss():
                followed = self._follows_gnss and not self._losses
                self._losses.add(index)
                if not followed:
                    return Told("gnss_loss", "no GNSS: the clock runs on as before")
                self._set(now_s, rate_ppm=own.rate_ppm, growth_ppm_per_min=own.growth_ppm_per_min)
                return Told("gnss_loss", f"no GNSS: the clock drifts by {own.rate_ppm:.3g} ppm")
            case Lie():
                self._status.lies[index] = partial(falsified, about=event.about, claim=event.claim)
                return Told("lie", f"claims {event.claim} {event.about}")

    def end(self, event: GnssLoss | Lie, index: int, now_s: float) -> Told:
        """An event that lasts ends."""
        match event:
            case GnssLoss():
                self._losses.remove(index)
                if self._losses:
                    return Told("gnss_loss", "still no GNSS: another loss lasts")
                if not self._follows_gnss:
                    return Told("gnss_back", "GNSS is back: the clock does not follow it")
                self._set(now_s, offset_s=self._oscillator.offset_s, rate_ppm=0.0, growth_ppm_per_min=0.0)
                return Told("gnss_back", "the clock follows GNSS again")
            case Lie():
                del self._status.lies[index]
                if self._status.lies:
                    return Told("lie", "still lies: another lie lasts")
                return Told("lie_over", "tells the truth again")

    def _set(self, now_s: float, **changes: float) -> None:
        self._clock = self._clock.at(now_s)._replace(**changes)
        self.read(now_s)


def whom(event: Event, drones: int) -> Sequence[int]:
    """The drones that an event is about; a jammer is about none."""
    drone = getattr(event, "drone", None)
    if drone is not None:
        return [drone]
    return range(drones) if isinstance(event, GnssLoss) else ()
