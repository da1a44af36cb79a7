"""Correlated Gaussian noise with exact discretisation: the time step changes no statistics.

Two processes, both stationary from their first sample, both given by a standard deviation and a
correlation time (the integral of the autocorrelation from 0 to ∞):

* `GaussMarkov`, first order (Ornstein–Uhlenbeck): continuous, not differentiable. Gusts, estimate errors.
* `Smooth`, four equal poles (Matérn 7/2): three times differentiable, so that velocity, acceleration and jerk
  exist and belong to the position. Where a drone really is. Fewer poles would not do: attitude follows from
  acceleration and body rates from jerk; with two poles the one, with three the other would be white noise, its
  size a matter of the time step.

Both run as linear filters over standard normal draws, block after block, time along the first axis. So a longer
sortie begins with the same numbers as a shorter one, and the blocks' sizes change nothing.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.special import gammainc

Array = npt.NDArray[np.float64]

LAGS = 4


class GaussMarkov:
    """First-order Gauss–Markov process; autocorrelation exp(−|t|/time_s)."""

    def __init__(self, sigma: float, time_s: float, step_s: float) -> None:
        """Args:
        sigma: standard deviation, in the unit wanted.
        time_s: correlation time, > 0.
        step_s: time between samples, > 0.
        """
        self._sigma, self._drive = sigma, sigma * math.sqrt(-math.expm1(-2 * step_s / time_s))
        self._lag = _Lag(math.exp(-step_s / time_s))

    def block(self, normals: Array) -> Array:
        """The next samples.

        Args:
            normals: [T, ...] independent standard normal draws.

        Returns:
            [T, ...], in the unit of sigma.
        """
        driven = normals * self._drive
        if self._lag.last is None:
            driven[0] = self._sigma * normals[0]
        return self._lag.block(driven)


class Smooth:
    """Smooth process with its derivatives; autocorrelation (1 + u + 2u²/5 + u³/15)·e^{−u}, u = λ|t|.

    Four chained first-order lags of rate λ = 16/(5·time_s). The derivatives' standard deviations are
    λ·sigma/√5 and λ²·sigma/√5 (Rasmussen & Williams 2006, Gaussian Processes for Machine Learning, §4.2 and B.2).
    """

    def __init__(self, sigma: float, time_s: float, step_s: float) -> None:
        """Args:
        sigma: standard deviation of the value.
        time_s: correlation time, > 0.
        step_s: time between samples, > 0.
        """
        self._rate = 16 / (5 * time_s)
        self._d = d = self._rate * step_s  # from here on time is counted in 1/λ
        self._gain = sigma * math.sqrt(32 / 5)  # the last lag's variance is 5/32
        self._root, self._begin = _root(_lag_covariance(d)), _root(_lag_covariance(math.inf))
        self._lags = [_Lag(math.exp(-d)) for _ in range(LAGS)]

    def block(self, normals: Array) -> tuple[Array, Array, Array]:
        """The next samples.

        Args:
            normals: [T, 4, ...] independent standard normal draws.

        Returns:
            value, first derivative, second derivative, each [T, ...], in sigma's unit, per s, per s².
        """
        d, decay = self._d, math.exp(-self._d)
        driven = np.einsum("ij,tj...->ti...", self._root, normals)
        before = [lag.last for lag in self._lags]
        if before[0] is None:
            driven[0] = np.einsum("ij,j...->i...", self._begin, normals[0])
        lags: list[Array] = []
        for i in range(LAGS):  # exact transition: lag j feeds lag i by e^{−d}·d^{i−j}/(i−j)!
            for j, lag in enumerate(lags):
                feed = decay * d ** (i - j) / math.factorial(i - j)
                driven[1:, i] += feed * lag[:-1]
                if (last := before[j]) is not None:
                    driven[0, i] += feed * last
            lags.append(self._lags[i].block(driven[:, i]))
        _, z2, z3, z4 = lags
        rate, gain = self._rate, self._gain
        return gain * z4, gain * rate * (z3 - z4), gain * rate**2 * (z2 - 2 * z3 + z4)


class _Lag:
    """y[t] = driven[t] + decay · y[t − 1]; scipy's lfilter does the same, but to import it takes half a second."""

    def __init__(self, decay: float) -> None:
        self._decay = decay
        self.last: Array | None = None
        """The last value; None before the first."""

    def block(self, driven: Array) -> Array:
        lagged = driven.reshape(len(driven), -1).copy()
        if self.last is not None:
            lagged[0] += self._decay * self.last.reshape(-1)
        for before, after in pairwise(lagged):
            after += self._decay * before
        out = lagged.reshape(driven.shape)
        self.last = out[-1].copy()
        return out


def _lag_covariance(d: float) -> Array:
    """Covariance [4, 4] that white noise leaves in four chained unit lags after time d (∞: the stationary one).

    ∫₀ᵈ e^{−2s} s^{i+j}/(i! j!) ds by the incomplete gamma function: the difference of stationary covariances
    is the same in algebra, but cancels to nothing in floats when d is small.
    """
    i, j = np.indices((LAGS, LAGS))
    m = i + j + 1
    factorial = np.array([1.0, 1.0, 2.0, 6.0, 24.0, 120.0, 720.0])
    share = np.ones_like(m, dtype=float) if math.isinf(d) else gammainc(m, 2 * d)
    covariance: Array = factorial[m - 1] / (factorial[i] * factorial[j]) * 0.5**m * share
    return covariance


def _root(covariance: Array) -> Array:
    """The lower Cholesky factor, row by row: numpy's is off in other last bits with every build of its matrix library, and
    so would be where a drone flies."""
    root = np.zeros_like(covariance)
    for i, row in enumerate(covariance):
        for j in range(i + 1):
            rest = row[j] - math.fsum(root[i, :j] * root[j, :j])
            root[i, j] = math.sqrt(rest) if i == j else rest / root[j, j]
    return root
