"""Tracks of cars, trucks and people on the ground, many drones' in one table, and how they move on. Free of torch.

A track is a Kalman filter's state: a car that keeps its velocity but for white noise in its acceleration (constant
velocity; Y. Bar-Shalom, X. R. Li, T. Kirubarajan, *Estimation with Applications to Tracking and Navigation*, 2001, §6.2).
A box is off by as much to either side, so east and north are two filters with one covariance. It has three numbers: the
variance of position, of velocity, and what both have in common.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

ACCELERATION_DENSITY = 0.5
"""Spectral density of the white noise in a car's acceleration along each axis, m²/s³."""
MOVES_AT = 3.0
"""A car drives if its speed is this many standard deviations of it; one that drives slower is taken to stand."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """n tracks, each at its own time; world frame ENU. Arrays may be shared with other tracks: nobody writes into them."""

    owner: Ints
    """[n] the drone that keeps it."""
    id: Ints
    """[n] its number, one of its owner's; none is used twice."""
    t_s: Floats
    """[n] the time of its state."""
    xy_m: Floats
    """[n, 2]"""
    velocity_mps: Floats
    """[n, 2]"""
    covariance: Floats
    """[n, 3] variance of position (m²), covariance of position and velocity (m²/s), variance of velocity (m²/s²), along
    either axis."""
    size_m: Floats
    """[n, 2] length, width."""
    yaw_rad: Floats
    """[n] heading as boxes have it: front and back may be exchanged."""
    score: Floats
    """[n] 0 … 1: the mean score of its boxes, where a look without a box counts as 0."""
    hits: Ints
    """[n] how many boxes it has had."""
    looks: Ints
    """[n] how many looks its owner has had since its first box, that one included."""
    seen_s: Floats
    """[n] when it had its last box."""
    confirmed: Bools
    """[n] False for a track that is tentative: what it follows may be a false positive."""
    kind: NDArray[np.int8] = None  # type: ignore[assignment]  # filled in below
    """[n] its class, as `TargetClass`; cars where left out."""

    def __post_init__(self) -> None:
        if self.kind is None:
            object.__setattr__(self, "kind", np.zeros(len(self.id), np.int8))

    def __len__(self) -> int:
        return len(self.id)

    def take(self, which: NDArray[Any] | slice) -> Tracks:
        """The tracks at the given indices, under the given mask or in the given slice, in that order."""
        return Tracks(*[getattr(self, name)[which] for name in _FIELDS])

    @classmethod
    def empty(cls) -> Tracks:
        """No tracks."""
        one, two, three = np.zeros(0), np.zeros((0, 2)), np.zeros((0, 3))
        number = np.zeros(0, np.int64)
        return cls(number, number, one, two, two, three, two, one, one, number, number, one, np.zeros(0, bool))

    @classmethod
    def join(cls, *several: Tracks) -> Tracks:
        """All tracks of several, in order."""
        some = [t for t in several if len(t)]
        if len(some) < 2:
            return some[0] if some else cls.empty()
        return cls(*[np.concatenate([getattr(t, name) for t in some]) for name in _FIELDS])

    @property
    def moves(self) -> Bools:
        """[n] whether its speed is significant."""
        v = self.velocity_mps
        square: Floats = v[:, 0] * v[:, 0] + v[:, 1] * v[:, 1]
        return np.asarray(square > MOVES_AT**2 * self.covariance[:, 2])


_FIELDS = tuple(f.name for f in fields(Tracks))


def grown(covariance: Floats, dt_s: Floats) -> Floats:
    """Covariances [n, 3] after times [n]; backwards they grow as they do forwards."""
    pp, pv, vv = covariance.T
    noise = ACCELERATION_DENSITY * np.abs(dt_s)
    square = dt_s * dt_s
    out = np.empty((len(pp), 3))
    out[:, 0] = pp + 2.0 * dt_s * pv + square * vv + noise * square / 3.0
    out[:, 1] = pv + dt_s * vv + noise * dt_s / 2.0
    out[:, 2] = vv + noise
    return out


def predicted(tracks: Tracks, to_s: ArrayLike) -> Tracks:
    """The tracks at other times [n] or at one time, later or earlier: each keeps its velocity."""
    to = np.broadcast_to(np.asarray(to_s, np.float64), tracks.t_s.shape)
    dt = to - tracks.t_s
    return replace(
        tracks, t_s=to, xy_m=tracks.xy_m + dt[:, None] * tracks.velocity_mps, covariance=grown(tracks.covariance, dt)
    )
