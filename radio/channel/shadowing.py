"""Shadowing that is correlated in space: links between neighbouring positions share their obstacles.

A Gaussian field over pairs of positions and time with the autocorrelation
e^{−|Δa|/d} · e^{−|Δb|/d} · e^{−|Δt|/T}: Gudmundson's exponential (Electronics Letters 27, 1991) for each end of a
link, as measured between two moving ends (Wang, Tameh & Nix, IEEE Trans. Veh. Tech. 57, 2008), and the time in which
the surroundings change. It is a sum of plane waves whose wave vectors are drawn from the spectrum of the exponential.
"""

from __future__ import annotations

from itertools import pairwise
from math import exp, sqrt
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sortie.scenarios.streams import stream

FloatArray = NDArray[np.float64]
Floats = TypeVar("Floats", bound=NDArray[np.floating[Any]])

WAVES = 256


class ShadowField:
    """One realisation of the field; drones are points in it, so that one more changes nothing for the others.

    Args:
        sigma_db: standard deviation.
        distance_m, time_s: correlation distance d and time T.
        seed, replication: as in `sortie.scenarios.streams.stream`.
    """

    def __init__(self, sigma_db: float, distance_m: float, time_s: float, seed: int, replication: int) -> None:
        rng = stream(seed, replication, (), "shadowing field")
        # the spectrum of e^{−r/d} is Cauchy's: a normal vector over an independent normal number (1 / d wide)
        self._a, self._b = (
            rng.standard_normal((3, WAVES)) / (np.abs(rng.standard_normal(WAVES)) * distance_m) for _ in range(2)
        )
        self._t = rng.standard_cauchy(WAVES) / time_s
        self._phase = rng.uniform(0.0, 2.0 * np.pi, WAVES)
        self._sigma_db, self._distance_m = sigma_db, distance_m

    def between(self, positions_m: FloatArray, t_s: float) -> FloatArray:
        """[N, N] dB, symmetric, of links between [N, 3] positions (ENU, m) at a time; zero on the diagonal."""
        # einsum adds in one order; a matrix library's hangs on the machine and on how many drones there are
        at_a, at_b = (np.einsum("nk,kw->nw", positions_m, waves) for waves in (self._a, self._b))
        first = np.exp(1j * (at_a + self._t * t_s + self._phase))
        one_way = np.einsum("iw,jw->ij", first, np.exp(1j * at_b)).real
        apart = np.sqrt(((positions_m[:, None] - positions_m[None]) ** 2).sum(axis=-1))
        # a link is the same from both ends; the two halves have the correlation e^{−2 |a − b| / d}
        both = np.sqrt(1.0 + np.exp(-2.0 * apart / self._distance_m))
        field = (one_way + one_way.T) / both * (self._sigma_db / sqrt(WAVES))
        np.fill_diagonal(field, 0.0)
        return np.asarray(field)


def gauss_markov(innovations: Floats, sigma_db: float, keep: float, before_db: Floats | None) -> Floats:
    """First-order Gauss–Markov process along the first axis.

    Args:
        innovations: [frames, ...] standard normals.
        sigma_db: standard deviation.
        keep: correlation from one frame to the next.
        before_db: [...] the value before; None, or NaN where there was none, begins stationary.

    Returns:
        [frames, ...] dB.
    """
    out: Floats = np.empty_like(innovations)
    np.multiply(sqrt(1.0 - keep**2) * sigma_db, innovations, out=out)
    stationary = sigma_db * innovations[0]
    out[0] = stationary if before_db is None else np.where(np.isnan(before_db), stationary, out[0] + keep * before_db)
    for before, now in pairwise(out):
        now += keep * before
    return out


def keep(frame_s: float, time_s: float) -> float:
    """Correlation from one frame to the next: e^{−frame/T}."""
    return exp(-frame_s / time_s)
