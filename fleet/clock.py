"""Clocks: how far a drone's clock is off, and how its peers find out from descriptors.

A clock with GNSS keeps a constant offset. Without GNSS it runs at its oscillator's own rate, which itself grows.

A receiver knows when a descriptor arrived by its own clock, and when it was stamped by the sender's. The difference, the
*lag*, is the delay on the way plus the offset between the two clocks. A descriptor arrives within the frame of its
stamp, so the delay lies between 0 and one frame. A lag outside of this range shows an offset; a smaller offset cannot be
told from delay, and is left alone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from statistics import median
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sortie.fleet.peers import FEWEST_COLUMNS
from sortie.fleet.plane import DroneStatus
from sortie.scenarios.schema import Clocks
from sortie.scenarios.streams import stream

WINDOW = 10
"""Descriptors in a row whose lags have to show an offset before it is believed; the smallest lag counts."""
_PPM, _MINUTE_S = 1e-6, 60.0


class Clock(NamedTuple):
    """A drone's clock from `since_s` on."""

    offset_s: float = 0.0
    """Its error at `since_s`."""
    since_s: float = 0.0
    rate_ppm: float = 0.0
    """How much too fast it runs."""
    growth_ppm_per_min: float = 0.0

    def error_s(self, t_s: float) -> float:
        """How far it is ahead of true time at `t_s`."""
        since_s = t_s - self.since_s
        grown_ppm = 0.5 * self.growth_ppm_per_min * since_s / _MINUTE_S
        return self.offset_s + (self.rate_ppm + grown_ppm) * _PPM * since_s

    def at(self, t_s: float) -> Clock:
        """The same clock, told from `t_s` on."""
        rate_ppm = self.rate_ppm + self.growth_ppm_per_min * (t_s - self.since_s) / _MINUTE_S
        return Clock(self.error_s(t_s), t_s, rate_ppm, self.growth_ppm_per_min)


class Oscillator(NamedTuple):
    """What is drawn for one drone: its clock's offset with GNSS, its rate without, and the growth of that."""

    offset_s: float
    rate_ppm: float
    growth_ppm_per_min: float

    def at_start(self, gnss: bool) -> Clock:
        """The clock at take-off."""
        return Clock(self.offset_s) if gnss else Clock(self.offset_s, 0.0, self.rate_ppm, self.growth_ppm_per_min)


def oscillators(config: Clocks, drones: int, seed: int, replication: int) -> list[Oscillator]:
    """Every drone's oscillator: normal draws with the scenario's standard deviations."""
    draws = [stream(seed, replication, i, "clock").standard_normal(3).tolist() for i in range(drones)]
    sigmas = config.offset_s, config.drift_ppm, config.drift_growth_ppm_per_min
    return [Oscillator(*(sigma * z for sigma, z in zip(sigmas, each, strict=True))) for each in draws]


class DroneClock:
    """A drone's clock in flight, with what events do to it. It keeps `DroneStatus.clock_skew_s`."""

    def __init__(self, status: DroneStatus, oscillator: Oscillator, *, gnss: bool, zero_s: float = 0.0) -> None:
        """Args:
        gnss: whether it follows GNSS, wherever there is any.
        zero_s: what a perfect clock shows at time 0.
        """
        self._status, self._oscillator, self._zero_s = status, oscillator, zero_s
        self._clock = oscillator.at_start(gnss)
        self.follows_gnss = gnss
        """Whether it follows GNSS, wherever there is any."""
        self._losses: set[int] = set()
        self.read(0.0)

    @property
    def has_gnss(self) -> bool:
        """Whether no loss of GNSS lasts."""
        return not self._losses

    def read(self, now_s: float) -> None:
        """Bring the drone's clock to the present."""
        self._status.clock_skew_s = self._zero_s + self._clock.error_s(now_s)

    def jump(self, now_s: float, offset_s: float) -> None:
        """It is off by so much now."""
        self._set(now_s, offset_s=offset_s)

    def drift(self, now_s: float, rate_ppm: float) -> None:
        """It drifts at a rate from now on, and follows GNSS no more."""
        self.follows_gnss = False
        self._set(now_s, rate_ppm=rate_ppm, growth_ppm_per_min=0.0)

    def lose_gnss(self, now_s: float, cause: int) -> float | None:
        """A loss of GNSS begins; returns the rate at which the clock drifts now, ppm, or None where it runs on as before."""
        followed = self.follows_gnss and self.has_gnss
        self._losses.add(cause)
        if not followed:
            return None
        own = self._oscillator
        self._set(now_s, rate_ppm=own.rate_ppm, growth_ppm_per_min=own.growth_ppm_per_min)
        return own.rate_ppm

    def regain_gnss(self, now_s: float, cause: int) -> None:
        """A loss of GNSS is over; after the last one the clock follows it again, if it did."""
        self._losses.remove(cause)
        if self.has_gnss and self.follows_gnss:
            self._set(now_s, offset_s=self._oscillator.offset_s, rate_ppm=0.0, growth_ppm_per_min=0.0)

    def _set(self, now_s: float, **changes: float) -> None:
        self._clock = self._clock.at(now_s)._replace(**changes)
        self.read(now_s)


class PeerClocks:
    """How far one drone's clock is ahead of each peer's, as their descriptors show."""

    def __init__(
        self, delay_s: float, ahead_s: NDArray[np.float64] | None = None, watched: NDArray[np.uint8] | None = None
    ) -> None:
        """Args:
        delay_s: the longest way of a descriptor, a frame.
        ahead_s: [ids] gets the offset from every peer's clock, 0 where none shows.
        watched: [ids] gets whether every lag of a peer counts: its clock showed an offset lately.
        """
        self.delay_s = delay_s
        self._ahead_s = np.zeros(FEWEST_COLUMNS) if ahead_s is None else ahead_s
        self._watched = np.zeros(FEWEST_COLUMNS, np.uint8) if watched is None else watched
        self.offset_s: dict[int, float] = {}
        """By peer; peers without a visible offset are left out. Each is known to ± `delay_s` / 2."""
        self._lags: dict[int, deque[float]] = {}

    def heard(self, peer: int, lag_s: float) -> None:
        """A descriptor came: `lag_s` is the own clock at its arrival, less its stamp."""
        if 0.0 <= lag_s <= self.delay_s:
            if peer in self._lags:
                del self._lags[peer]
                self.offset_s.pop(peer, None)
                self._ahead_s[peer] = self._watched[peer] = 0
            return
        self._watched[peer] = 1
        lags = self._lags.setdefault(peer, deque(maxlen=WINDOW))
        lags.append(lag_s)
        if len(lags) == WINDOW:
            self._ahead_s[peer] = self.offset_s[peer] = min(lags) - self.delay_s / 2

    def own_offset_s(self, peers: Iterable[int]) -> float:
        """How far the own clock is ahead of the fleet's: the median over the peers."""
        return median([0.0, *(self.offset_s.get(i, 0.0) for i in peers)]) if self.offset_s else 0.0
