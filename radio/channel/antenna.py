"""What an antenna loses toward a direction, against its best one.

The transmit power of a scenario holds the antennas' gains; a pattern can only take away from it. A half-wave dipole
along the airframe's z axis is blind along that axis: a drone that banks or pitches turns its antenna with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

FLOOR_DB = 20.0
"""The nulls of a dipole on an airframe are filled by scatter: no direction loses more."""


def antenna_loss_db(pattern: Literal["isotropic", "dipole"], cosine: ArrayLike) -> FloatArray:
    """Loss against the best direction, dB, ≥ 0.

    Args:
        pattern: `isotropic` loses nothing; `dipole` is the half-wave one, (cos(π/2 cos θ) / sin θ)² of its peak
            (Balanis, Antenna Theory, §4.6), at most `FLOOR_DB`.
        cosine: [...] of the angle θ between the antenna's axis and the direction.
    """
    c = np.abs(np.asarray(cosine, dtype=float))
    if pattern == "isotropic":
        return np.zeros_like(c)
    sine_squared = np.maximum(1.0 - c**2, 1e-12)
    gain = np.cos(0.5 * np.pi * np.minimum(c, 1.0)) ** 2 / sine_squared
    return np.asarray(np.minimum(-10.0 * np.log10(np.maximum(gain, 1e-12)), FLOOR_DB))


class Antennas:
    """The antennas of a fleet."""

    def __init__(self, patterns: Sequence[Literal["isotropic", "dipole"]]) -> None:
        """Args: `patterns`: each drone's, as `antenna_loss_db` takes them."""
        self._dipole = np.array([pattern == "dipole" for pattern in patterns])
        self.lossless = not self._dipole.any()
        """Whether no antenna loses anything in any direction."""

    def loss_db(self, drones: NDArray[np.integer] | slice, cosine: ArrayLike) -> FloatArray:
        """Loss of these drones' antennas [L], dB, for angles with these cosines [..., L]."""
        return np.where(self._dipole[drones], antenna_loss_db("dipole", cosine), 0.0)
