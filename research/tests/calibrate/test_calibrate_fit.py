"""The calibration's file and its parts: what is broken is named; sight and regressions against plain definitions."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from scipy.special import expit

from research.calibrate.fit import BANDS as QUANTILES
from research.calibrate.fit import _below, _count_loss, _find_loss, _in_common, _iou, _pairs, _train
from sortie.perception.surrogate.draws import BANDS
from sortie.perception.surrogate.exchange import FUSED_COVARIATES
from sortie.perception.surrogate.model import (
    BAND,
    KINDS,
    NETS,
    SHIPPED,
    Parameters,
    _of_two,
    load,
)

RNG = np.random.Generator(np.random.PCG64(5))
START = RNG.bit_generator.state


@pytest.fixture(autouse=True)
def _the_same_draws_whatever_ran_before() -> None:
    RNG.bit_generator.state = START


@pytest.fixture(scope="module")
def parameters() -> Parameters:
    return load(SHIPPED)


def test_the_best_draw_places_best_among_what_was_predicted_as_vaguely(parameters: Parameters) -> None:
    x = scored(lonely(4000, range=0.7), 0.5)
    alone = replace(parameters, alike=np.append(parameters.alike[:3], np.float32(0)))
    off, _ = alone.place(x, np.linspace(0, 0.999, 4000, dtype=np.float32), offset_draw(4000))
    fits = _iou(off.astype(np.float64))
    assert fits[:1000].mean() + 0.2 < fits[-1000:].mean()
    rows = parameters.residuals.reshape(KINDS, -1, BAND, 6)
    assert (rows[..., 5] == rows[..., :1, 5]).all()
    assert (np.diff(rows[:, :, 0, 5], axis=1) >= 0).all()


def lonely(n: int, **look: float) -> np.ndarray:
    """Covariates [n, 28] of cars in sight that nobody else's map shows, 0 but for what is given of the `look`."""
    x = np.zeros((n, len(FUSED_COVARIATES)), np.float32)
    named = {"first": -8.0, "second": -8.0, "mean": -8.0, "own_visible": 1.0} | {f"own_{k}": v for k, v in look.items()}
    for name, value in named.items():
        x[:, FUSED_COVARIATES.index(name)] = value
    return x


def scored(x: np.ndarray, score: float) -> np.ndarray:
    """As the place network takes them."""
    return np.concatenate([x, np.full((len(x), 1), score, np.float32)], axis=1)


def offset_draw(n: int) -> np.ndarray:
    """As `Drawn.offset_draw`."""
    return np.column_stack([RNG.random(n), RNG.choice([-1.0, 1.0], (n, 3))]).astype(np.float32)


def test_what_pairs_have_in_common_is_found_again() -> None:
    """Cars that have their own draw in 0, 40 and 80 of 100, seen by five drones at other chances."""
    rng = np.random.default_rng(0)
    car = np.repeat(np.arange(40_000), 5)
    chance = rng.uniform(0.2, 0.9, len(car))
    for part in (0.0, 0.4, 0.8):
        own, each = rng.random(40_000), rng.random(len(car))
        happened = np.where((rng.random(40_000) < part)[car], own[car], each) < chance
        assert _in_common(happened, chance, car) == pytest.approx(part, abs=0.02)


def test_pairs_are_every_two_of_a_group() -> None:
    group = RNG.integers(0, 7, 40)
    a, b = _pairs(group)
    found = {(min(i, j), max(i, j)) for i, j in zip(a.tolist(), b.tolist(), strict=True)}
    wanted = {(i, j) for i in range(40) for j in range(i + 1, 40) if group[i] == group[j]}
    assert found == wanted
    assert len(a) == len(wanted)


def test_rates_of_false_alarms_are_found_where_they_bend() -> None:
    """Counts whose log rate is no straight line of what it hangs on, in bands that are frequent and rare."""
    x = RNG.normal(size=(40_000, NETS["alarms"][0]))
    rate = np.exp(0.5 - np.abs(x[:, :1]) + np.linspace(1.0, -2.0, NETS["alarms"][1]))
    net, _ = _train("alarms", x, {"count": RNG.poisson(rate).astype(float)}, _count_loss, 0, 1000)
    for at in (np.abs(x[:, 0]) < 0.3, np.abs(x[:, 0]) > 1.5):
        found = np.exp(net(x[at].astype(np.float32))).mean(axis=0)
        np.testing.assert_allclose(found, rate[at].mean(axis=0), rtol=0.15)


def test_as_many_bands_are_counted_as_a_moment_has_draws_for() -> None:
    assert len(QUANTILES) == BANDS == NETS["alarms"][1]


@pytest.mark.slow
def test_scores_are_found_as_they_are_spread_above_the_floor_below_which_they_are_not_told() -> None:
    """Two heaps of scores, the lower one half hidden; what is found, and the scores' quantiles, come back."""
    n, floor = 30_000, -1.0
    upper = RNG.random(n) < 0.4
    q = np.where(upper, RNG.normal(1.5, 0.2, n), RNG.normal(-0.8, 0.6, n))
    hit = (RNG.random(n) < 0.8) & (q > floor)
    x = RNG.normal(size=(n, NETS["find"][0]))
    loss = partial(_find_loss, floor=torch.tensor(floor))
    net, out = _train("find", x, {"hit": hit, "q": np.where(hit, q, 0.0)}, loss, 0, 1500)
    chance = expit(out[:, 0]) * (1.0 - _below(np.full(n, floor), out[:, 1:]))
    assert chance.mean() == pytest.approx(hit.mean(), abs=0.02)
    drawn = _of_two(net(x.astype(np.float32))[:, 1:], RNG.random(n).astype(np.float32))
    at = (0.2, 0.5, 0.8)
    np.testing.assert_allclose(np.quantile(drawn[drawn > floor], at), np.quantile(q[hit], at), atol=0.12)


def test_a_fit_returns_the_network_that_it_fitted() -> None:
    """Inputs of another scale are folded into the first layer, and the mean and spread are learned."""
    from research.calibrate.fit import _normal_loss

    x = RNG.normal(size=(4000, NETS["rank"][0])) * 3 + 1
    net, out = _train("rank", x, {"y": 0.5 * x[:, 0] + 0.2 * RNG.normal(size=4000)}, _normal_loss, 0, 400)
    np.testing.assert_allclose(net(x.astype(np.float32)), out, atol=2e-3)
    assert np.abs(out[:, 0] - 0.5 * x[:, 0]).mean() < 0.1
    assert abs(np.exp(out[:, 1]).mean() - 0.2) < 0.05
