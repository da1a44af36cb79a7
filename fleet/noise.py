"""Correlated Gaussian noise with exact discretisation: the time step changes no statistics.

Two processes, both stationary from their first sample, both given by a standard deviation and a
correlation time (the integral of the autocorrelation from 0 to ∞):

* `gauss_markov`, first order (Ornstein–Uhlenbeck): continuous, not differentiable. Gusts, estimate errors.
* `smooth`, three equal poles (Matérn 5/2): twice differentiable, so that velocity and acceleration exist
  and belong to the position. Where a drone really is. Two poles would not do: the acceleration, from which
  the attitude follows, would be white noise, its size a matter of the time step.

Both run as linear filters over blocks of standard normal draws, time along the first axis, so that a longer
sortie begins with the same numbers as a shorter one.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter
from scipy.special import gammainc

Array = npt.NDArray[np.float64]


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
    """Twice differentiable process, with its derivatives; autocorrelation (1 + u + u²/3)·e^{−u}, u = λ|t|.

    Three chained first-order lags of rate λ = 8/(3·time_s). The derivatives' standard deviations are
    λ·sigma/√3 and λ²·sigma (Rasmussen & Williams 2006, Gaussian Processes for Machine Learning, §4.2 and B.2).

    Args:
        normals: [T, 3, ...] independent standard normal draws.
        sigma: standard deviation of the value.
        time_s: correlation time, > 0.
        step_s: time between samples, > 0.

    Returns:
        value, first derivative, second derivative, each [T, ...], in sigma's unit, per s, per s².
    """
    rate = 8 / (3 * time_s)
    d = rate * step_s  # from here on time is counted in 1/λ
    driven = np.einsum("ij,tj...->ti...", np.linalg.cholesky(_lag_covariance(d)), normals)
    driven[0] = np.einsum("ij,j...->i...", np.linalg.cholesky(_lag_covariance(math.inf)), normals[0])
    decay = math.exp(-d)
    z1 = _lag(driven[:, 0], decay)
    driven[1:, 1] += decay * d * z1[:-1]
    z2 = _lag(driven[:, 1], decay)
    driven[1:, 2] += decay * (d * z2[:-1] + d * d / 2 * z1[:-1])
    z3 = _lag(driven[:, 2], decay)
    gain = sigma * 4 / math.sqrt(3)  # the last lag's variance is 3/16
    return gain * z3, gain * rate * (z2 - z3), gain * rate**2 * (z1 - 2 * z2 + z3)


def _lag(driven: Array, decay: float) -> Array:
    lagged: Array = lfilter([1.0], [1.0, -decay], driven, axis=0)
    return lagged


def _lag_covariance(d: float) -> Array:
    """Covariance [3, 3] that white noise leaves in three chained unit lags after time d (∞: the stationary one).

    ∫₀ᵈ e^{−2s} s^{i+j}/(i! j!) ds by the incomplete gamma function: the difference of stationary covariances
    is the same in algebra, but cancels to nothing in floats when d is small.
    """
    i, j = np.indices((3, 3))
    m = i + j + 1
    factorial = np.array([1.0, 1.0, 2.0, 6.0, 24.0])
    share = np.ones_like(m, dtype=float) if math.isinf(d) else gammainc(m, 2 * d)
    covariance: Array = factorial[m - 1] / (factorial[i] * factorial[j]) * 0.5**m * share
    return covariance
