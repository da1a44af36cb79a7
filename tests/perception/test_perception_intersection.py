"""Covariance intersection: closed forms, an independent optimiser, and that it claims no more than is true."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from sortie.perception.intersection import Intersection, intersect, inverse

seeds = st.integers(0, 2**32 - 1)


def matrix(parts: np.ndarray) -> np.ndarray:
    a, b, c = parts
    return np.array([[a, b], [b, c]])


def drawn(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Places [n, 2] and covariances [n, 2, 2], up to thirty times as long as wide."""
    half = rng.normal(size=(n, 2, 2)) * rng.uniform(0.2, 3.0, (n, 1, 1))
    return rng.normal(size=(n, 2)), half @ half.transpose(0, 2, 1) + 0.05 * np.eye(2)


def of(places: np.ndarray, covariances: np.ndarray, common: float = 1.0) -> Intersection:
    parts = np.stack([covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]], axis=1)
    return intersect(places, inverse(parts), np.zeros(len(places), np.intp), common)


@given(a=st.floats(0.1, 9.0), b=st.floats(0.1, 9.0))
@example(a=1.125, b=1.109375)  # the last weight vanishes slowly
def test_two_places_along_the_same_axes_have_the_weights_of_the_closed_form(a: float, b: float) -> None:
    """det(ω A + (1 − ω) B) is a parabola in ω where both are diagonal: its top, or an end."""
    first, second = np.diag([1.0, a]), np.diag([b, 1.0])
    found = of(np.array([[0.0, 0.0], [1.0, 1.0]]), np.array([first, second]))
    p, q = 1.0 - 1.0 / b, 1.0 / a - 1.0  # slopes of the two entries of ω A + (1 − ω) B
    square = p * q
    omega = 0.5 if square == 0 else -(p * 1.0 + q / b) / (2.0 * square)
    if square >= 0:  # no top between the ends
        omega = float(np.linalg.det(np.linalg.inv(first)) >= np.linalg.det(np.linalg.inv(second)))
    omega = min(max(omega, 0.0), 1.0)
    best = omega * np.linalg.inv(first) + (1.0 - omega) * np.linalg.inv(second)
    assert np.linalg.det(matrix(found.covariance_m2[0])) == pytest.approx(1.0 / np.linalg.det(best), rel=3e-4)
    assert found.weight.sum() == pytest.approx(1.0)


def test_equal_places_give_the_covariance_of_one_and_their_mean() -> None:
    covariance = np.array([[2.0, 0.5], [0.5, 1.0]])
    found = of(np.array([[0.0, 0.0], [1.0, 2.0], [2.0, 1.0]]), np.array([covariance] * 3))
    np.testing.assert_allclose(matrix(found.covariance_m2[0]), covariance)
    np.testing.assert_allclose(found.xy_m[0], [1.0, 1.0])


def test_a_place_that_is_worse_in_every_direction_has_no_say() -> None:
    found = of(np.array([[0.0, 0.0], [5.0, 5.0]]), np.array([np.eye(2), 4.0 * np.eye(2)]))
    assert found.weight[0] > 0.9999
    np.testing.assert_allclose(found.xy_m[0], [0.0, 0.0], atol=1e-3)


def test_with_a_common_share_two_equal_places_lie_between_one_and_two_independent_ones() -> None:
    """P / ω is c P / ω for the common part alone: with halves, (1 + c) P each, so P (1 + c) / 2 together."""
    both = np.array([np.eye(2)] * 2)
    for common in (0.0, 0.25, 0.6, 1.0):
        found = of(np.zeros((2, 2)), both, common)
        np.testing.assert_allclose(matrix(found.covariance_m2[0]), (1.0 + common) / 2.0 * np.eye(2))


def test_without_common_errors_it_is_the_mean_by_inverse_covariances() -> None:
    places, covariances = drawn(np.random.default_rng(5), 4)
    whole = np.linalg.inv(np.linalg.inv(covariances).sum(axis=0))
    found = of(places, covariances, 0.0)
    np.testing.assert_allclose(matrix(found.covariance_m2[0]), whole)
    np.testing.assert_allclose(found.xy_m[0], whole @ np.einsum("nij,nj->i", np.linalg.inv(covariances), places))


@settings(max_examples=25, deadline=None)
@given(seed=seeds, n=st.integers(2, 5), common=st.sampled_from([0.17, 0.5, 1.0]))
def test_an_independent_optimiser_finds_no_smaller_covariance(seed: int, n: int, common: float) -> None:
    """Sequential quadratic programming over the weights, with full matrices of the common and the independent part."""
    places, covariances = drawn(np.random.default_rng(seed), n)

    def whole(weights: np.ndarray) -> np.ndarray:
        safe = np.maximum(weights, 1e-9)[:, None, None]
        return np.linalg.inv(common * covariances / safe + (1.0 - common) * covariances).sum(axis=0)

    best = minimize(
        lambda w: -np.linalg.slogdet(whole(w))[1], np.full(n, 1.0 / n), method="SLSQP", bounds=[(0.0, 1.0)] * n,
        constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0}, options={"ftol": 1e-12, "maxiter": 500},
    )  # fmt: skip
    found = of(places, covariances, common)
    np.testing.assert_allclose(np.linalg.inv(whole(found.weight)), matrix(found.covariance_m2[0]), rtol=1e-5)
    assert np.linalg.slogdet(matrix(found.covariance_m2[0]))[1] <= best.fun + 5e-4


@settings(max_examples=25, deadline=None)
@given(seed=seeds)
def test_it_covers_the_error_whatever_the_errors_have_in_common(seed: int) -> None:
    """With any joint covariance of two errors that has these two on its diagonal."""
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(4, 4))
    joint = half @ half.T + 0.05 * np.eye(4)
    found = of(np.zeros((2, 2)), np.array([joint[:2, :2], joint[2:, 2:]]))
    covariance = matrix(found.covariance_m2[0])
    gains = [
        covariance @ (w * np.linalg.inv(p)) for w, p in zip(found.weight, (joint[:2, :2], joint[2:, 2:]), strict=True)
    ]
    both = np.concatenate(gains, axis=1)
    assert np.linalg.eigvalsh(covariance - both @ joint @ both.T).min() > -1e-9


def test_groups_are_each_as_alone_and_a_place_alone_stays() -> None:
    rng = np.random.default_rng(2)
    places, covariances = drawn(rng, 6)
    group = np.array([2, 0, 2, 1, 0, 2])
    parts = np.stack([covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]], axis=1)
    together = intersect(places, inverse(parts), group)
    for g in range(3):
        alone = of(places[group == g], covariances[group == g])
        np.testing.assert_allclose(together.xy_m[g], alone.xy_m[0])
        np.testing.assert_allclose(together.covariance_m2[g], alone.covariance_m2[0])
        np.testing.assert_allclose(together.weight[group == g], alone.weight)
    np.testing.assert_allclose(together.xy_m[1], places[3])
