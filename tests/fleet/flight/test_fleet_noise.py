"""Both processes are linear in their draws, so their covariance can be computed exactly and held to the closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sortie.fleet.flight.noise import GaussMarkov, Smooth

steps = st.floats(0.001, 2.0)
times = st.floats(0.05, 100.0)
T = 12


def lags_s(step_s: float) -> np.ndarray:
    return np.abs(np.subtract.outer(np.arange(T), np.arange(T))) * step_s


@given(steps, times)
def test_gauss_markov_covariance_is_exponential_at_any_step(step_s: float, time_s: float) -> None:
    response = GaussMarkov(2.0, time_s, step_s).block(np.eye(T))
    np.testing.assert_allclose(response @ response.T, 4 * np.exp(-lags_s(step_s) / time_s), atol=1e-12)


@given(steps, times)
def test_smooth_covariance_is_matern_at_any_step(step_s: float, time_s: float) -> None:
    """Value r(t), velocity −r″(t) and acceleration r⁗(t), with r(t) = σ²(1 + u + 2u²/5 + u³/15)e^{−u}."""
    rate = 16 / (5 * time_s)
    value, velocity, acceleration = Smooth(2.0, time_s, step_s).block(np.eye(4 * T).reshape(T, 4, 4 * T))
    u = rate * lags_s(step_s)
    e = 4 * np.exp(-u)
    np.testing.assert_allclose(value @ value.T, (1 + u + 2 * u**2 / 5 + u**3 / 15) * e, atol=1e-9)
    np.testing.assert_allclose(velocity @ velocity.T / rate**2, (3 + 3 * u - u**3) / 15 * e, atol=1e-9)
    np.testing.assert_allclose(
        acceleration @ acceleration.T / rate**4, (3 + 3 * u - 6 * u**2 + u**3) / 15 * e, atol=1e-9
    )


@given(steps, times)
def test_smooth_derivatives_belong_to_the_value(step_s: float, time_s: float) -> None:
    """At one instant: value and velocity uncorrelated, value and acceleration −λ²σ²/5."""
    rate = 16 / (5 * time_s)
    value, velocity, acceleration = Smooth(1.0, time_s, step_s).block(np.eye(4 * T).reshape(T, 4, 4 * T))
    np.testing.assert_allclose(np.sum(value * velocity, axis=1) / rate, 0, atol=1e-9)
    np.testing.assert_allclose(np.sum(value * acceleration, axis=1) / rate**2, -1 / 5, atol=1e-9)
    np.testing.assert_allclose(np.sum(velocity * acceleration, axis=1) / rate**3, 0, atol=1e-9)


def test_correlation_time_is_the_integral_of_the_autocorrelation() -> None:
    first_draws = np.zeros((4000, 4, 4))
    first_draws[0] = np.eye(4)  # the covariance with the first sample comes through its draws alone
    response = Smooth(1.0, 2.5, 0.01).block(first_draws)[0]
    covariance = response @ response[0]
    assert (covariance.sum() - 0.5) * 0.01 == pytest.approx(2.5, rel=1e-3)


def test_tiny_steps_do_not_cancel_to_nothing() -> None:
    value, velocity, _ = Smooth(1.0, 100.0, 1e-4).block(np.random.default_rng(1).standard_normal((2000, 4)))
    assert np.abs(np.diff(value) / 1e-4 - velocity[1:]).max() < 1e-5


def test_zero_sigma_is_silence_and_longer_series_begin_alike() -> None:
    normals = np.random.default_rng(2).standard_normal((50, 4, 2))
    assert not Smooth(0.0, 2.0, 0.1).block(normals)[0].any()
    for begins in (lambda n: Smooth(1.0, 2.0, 0.1).block(n)[0], lambda n: GaussMarkov(1.0, 2.0, 0.1).block(n)):
        np.testing.assert_array_equal(begins(normals)[:20], begins(normals[:20]))
