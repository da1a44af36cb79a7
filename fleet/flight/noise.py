"""Correlated Gaussian noise with exact discretisation: the time step changes no statistics.

Two processes, both stationary from their first sample, both given by a standard deviation and a
correlation time (the integral of the autocorrelation from 0 to ∞):

* `gauss_markov`, first order (Ornstein–Uhlenbeck): continuous, not differentiable. Gusts, estimate errors.
* `smooth`, four equal poles (Matérn 7/2): three times differentiable, so that velocity, acceleration and jerk
  exist and belong to the position. Where a drone really is. Fewer poles would not do: attitude follows from
  acceleration and body rates from jerk; with two poles the one, with three the other would be white noise, its
  size a matter of the time step.

Both run as linear filters over blocks of standard normal draws, time along the first axis, so that a longer
sortie begins with the same numbers as a shorter one.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.special import gammainc

Array = npt.NDArray[np.float64]

LAGS = 4


def gauss_markov(normals: Array, sigma: float, time_s: float, step_s: float) -> Array:
    """First-order Gauss–Markov process; autocorrelation exp(−|t|/time_s).

    Args:
        normals: [T, ...] independent standard normal draws.
        sigma: standard deviation, in the unit wanted.
        time_s: correlation time, > 0.
        step_s: time between samples, > 0.

    Returns:
        [T, ...], in the unit of sigma.
    """
    driven = normals * (sigma * math.sqrt(-math.expm1(-2 * step_s / time_s)))
    driven[0] = sigma * normals[0]
    return _lag(driven, math.exp(-step_s / time_s))


def smooth(normals: Array, sigma: float, time_s: float, step_s: float) -> tuple[Array, Array, Array]:
    """Smooth process with its derivatives; autocorrelation (1 + u + 2u²/5 + u³/15)·e^{−u}, u = λ|t|.

    Four chained first-order lags of rate λ = 16/(5·time_s). The derivatives' standard deviations are
    λ·sigma/√5 and λ²·sigma/√5 (Rasmussen & Williams 2006, Gaussian Processes for Machine Learning, §4.2 and B.2).

    Args:
        normals: [T, 4, ...] independent standard normal draws.
        sigma: standard deviation of the value.
        time_s: correlation time, > 0.
        step_s: time between samples, > 0.

    Returns:
        value, first derivative, second derivative, each [T, ...], in sigma's unit, per s, per s².
    """
    rate = 16 / (5 * time_s)
    d = rate * step_s  # from here on time is counted in 1/λ
    driven = np.einsum("ij,tj...->ti...", _root(_lag_covariance(d)), normals)
    driven[0] = np.einsum("ij,j...->i...", _root(_lag_covariance(math.inf)), normals[0])
    decay = math.exp(-d)
    lags: list[Array] = []
    for i in range(LAGS):  # exact transition: lag j feeds lag i by e^{−d}·d^{i−j}/(i−j)!
        for j, lag in enumerate(lags):
            driven[1:, i] += decay * d ** (i - j) / math.factorial(i - j) * lag[:-1]
        lags.append(_lag(driven[:, i], decay))
    _, z2, z3, z4 = lags
    gain = sigma * math.sqrt(32 / 5)  # the last lag's variance is 5/32
    return gain * z4, gain * rate * (z3 - z4), gain * rate**2 * (z2 - 2 * z3 + z4)


def _lag(driven: Array, decay: float) -> Array:
    """y[t] = driven[t] + decay · y[t − 1]; scipy's lfilter does the same, but to import it takes half a second."""
    lagged = driven.reshape(len(driven), -1).copy()
    for before, after in pairwise(lagged):
        after += decay * before
    return lagged.reshape(driven.shape)


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
