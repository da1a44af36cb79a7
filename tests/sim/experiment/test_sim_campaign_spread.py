"""How fields are drawn: quantiles, weights, and designs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from sortie.scenarios.schema.campaign import (
    Choice,
    Integers,
    LogNormal,
    Normal,
    SampledField,
    Spread,
    Triangular,
    Uniform,
)
from sortie.sim.experiment.spread import design, quantiles

U = st.floats(0.001, 0.999)


@given(u=U)
def test_quantiles_are_those_of_scipy(u: float) -> None:
    pairs: list[tuple[Spread, object]] = [
        (Uniform(kind="uniform", low=-2, high=3), stats.uniform(-2, 5)),
        (Normal(kind="normal", mean=1, sd=2), stats.norm(1, 2)),
        (Normal(kind="normal", mean=1, sd=2, low=0), stats.truncnorm(-0.5, np.inf, 1, 2)),
        (Normal(kind="normal", mean=1, sd=2, low=0, high=2), stats.truncnorm(-0.5, 0.5, 1, 2)),
        (LogNormal(kind="log_normal", median=3, sigma=0.5), stats.lognorm(0.5, scale=3)),
        (Triangular(kind="triangular", low=1, mode=2, high=5), stats.triang(0.25, 1, 4)),
        (Triangular(kind="triangular", low=1, mode=5, high=5), stats.triang(1, 1, 4)),
    ]
    for spread, reference in pairs:
        assert quantiles(spread, np.array([u]))[0] == pytest.approx(reference.ppf(u), abs=1e-9)  # type: ignore[attr-defined]


def test_a_normal_cut_off_in_its_tail_is_that_of_scipy() -> None:
    """Beyond 8 sd above the mean the distribution function is 1, beyond 38 sd either tail is 0."""
    cuts = ((9, None), (40, None), (9, 9.5), (1, 2), (0, None), (-9.5, -9), (None, -40))
    for low, high in cuts:
        ends = [None if end is None else 1.0 + 2.0 * end for end in (low, high)]
        spread = Normal(kind="normal", mean=1, sd=2, low=ends[0], high=ends[1])
        reference = stats.truncnorm(-np.inf if low is None else low, np.inf if high is None else high, 1, 2)
        for u in (0.0, 1e-12, 0.001, 0.3, 0.5, 0.9, 1 - 1e-12):
            if math.isfinite(reference.ppf(u)):
                assert quantiles(spread, np.array([u]))[0] == pytest.approx(reference.ppf(u), rel=1e-9), (low, high, u)


def test_choices_and_integers_come_as_often_as_they_should() -> None:
    u = (np.arange(1000) + 0.5) / 1000
    choice = Choice(kind="choice", values=("a", "b", "c"), weights=(1, 0, 3))
    drawn = list(quantiles(choice, np.array([*u.tolist(), 1.0])))
    assert (drawn.count("a"), drawn.count("b"), drawn.count("c")) == (250, 0, 751)
    whole = list(quantiles(Integers(kind="integers", low=3, high=6), np.array([*u.tolist(), 1.0])))
    assert [whole.count(v) for v in (3, 4, 5, 6)] == [250, 250, 250, 251]


def test_even_designs_have_one_draw_in_every_slice_and_a_random_one_grows_at_its_end() -> None:
    for method in ("latin_hypercube", "sobol"):
        points = design(SampledField(method=method, count=64), 3, seed=2)  # type: ignore[arg-type]
        for column in points.T:
            assert sorted((column * 64).astype(int).tolist()) == list(range(64)), method
    short, longer = (design(SampledField(method="random", count=n), 2, seed=3) for n in (5, 9))
    assert np.array_equal(short, longer[:5])
