"""Age of information: closed forms against each other, against a plain chain, and in the simulation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from radio_flights import Hover, trace

from research.validation.age import Chain, mean_age_s, mean_peak_age_s, share_older
from sortie.radio.settings import AirSettings, BurstSettings
from sortie.scenarios.intervals import mean_interval

PERIOD_S = 0.1


@given(p=st.floats(0.0, 0.95), k=st.integers(0, 12), r=st.floats(0.05, 0.95))
def test_a_chain_without_memory_is_independent_loss(p: float, k: int, r: float) -> None:
    chain = Chain(1.0 - r, r, p, p)
    assert mean_age_s(1.0, chain) == pytest.approx(mean_age_s(1.0, p))
    assert mean_peak_age_s(1.0, chain) == pytest.approx(mean_peak_age_s(1.0, p))
    assert share_older(k, chain) == pytest.approx(p**k, abs=1e-12)


def test_the_forms_of_independent_loss() -> None:
    assert mean_age_s(0.1, 0.2, 0.01) == pytest.approx(0.01 + 0.1 * 1.2 / 1.6)
    assert mean_peak_age_s(0.1, 0.2, 0.01) == pytest.approx(0.01 + 0.1 / 0.8)
    assert share_older(3, 0.2) == pytest.approx(0.008)


def test_bursts_against_a_plain_chain() -> None:
    chain, rng = Chain(0.05, 0.28, 0.02, 0.9), np.random.default_rng(1)
    gaps, bad, gap = [], False, 0
    for u, v in rng.random((300_000, 2)).tolist():
        bad = u >= chain.bad_to_good if bad else u < chain.good_to_bad
        gap += 1
        if v >= (chain.loss_bad if bad else chain.loss_good):
            gaps.append(gap)
            gap = 0
    x = np.array(gaps)
    assert mean_age_s(1.0, chain) == pytest.approx((x**2).mean() / (2 * x.mean()), rel=0.02)
    assert mean_peak_age_s(1.0, chain) == pytest.approx(x.mean(), rel=0.005)
    for k in (3, 10):
        assert share_older(k, chain) == pytest.approx(np.maximum(x - k, 0).sum() / x.sum(), rel=0.05)


def test_a_link_that_is_always_lost_has_no_age() -> None:
    with pytest.raises(ValueError, match=r"loss is 1\.0, must be in \[0, 1\)"):
        mean_age_s(1.0, 1.0)
    with pytest.raises(ValueError, match=r"mean loss is 1\.0, must be below 1"):
        mean_age_s(1.0, Chain(0.5, 0.5, 1.0, 1.0))


# --- in the simulation ---------------------------------------------------------------------------------


def flown_ages(config: AirSettings, duration_s: float, *, seed: int = 1) -> dict[int, np.ndarray]:
    """[arrivals, 2] of drone 0's descriptors at each of the others: when sent, when heard."""
    flight = Hover(config, n=5, seed=seed, spread=0.0)
    flight.fly(duration_s, lambda frame: flight.publish(0))
    at: dict[int, list[tuple[float, float]]] = {}
    for t_s, _, heard in flight.heard:
        for i in heard:
            at.setdefault(i, []).append((np.floor(t_s / PERIOD_S + 1e-9) * PERIOD_S, t_s))
    return {i: np.array(rows) for i, rows in at.items()}


def mean_age(rows: np.ndarray) -> tuple[float, float, float]:
    """Time average of age, mean peak, and share of time above three periods, from the second arrival on."""
    sent, heard = rows.T
    begin, end = heard[:-1] - sent[:-1], heard[1:] - sent[:-1]  # ages right after an arrival, and just before the next
    span = np.diff(heard)
    above = np.maximum(end - 3 * PERIOD_S, 0.0)
    return float((span * (begin + end) / 2).sum() / span.sum()), float(end.mean()), float(above.sum() / span.sum())


def within(values: list[float], expected: float) -> bool:
    """Whether what is expected lies in the 99.9 % interval of the mean of independent values."""
    found = mean_interval(values, level=0.999)
    return found.low <= expected <= found.high


@pytest.mark.parametrize("loss", [0.1, 0.4])
def test_independent_loss_in_the_air_has_its_age(loss: float, tmp_path: Path) -> None:
    rows = [f"0,0,{i},,{loss}," for i in range(1, 5)]
    config = AirSettings(trace=trace(tmp_path, *rows))
    found = [mean_age(r) for seed in (1, 2, 3) for r in flown_ages(config, 600.0, seed=seed).values()]
    delay_s = np.mean([(r[:, 1] - r[:, 0]).mean() for r in flown_ages(config, 60.0).values()])
    assert delay_s < 1e-3  # a frame of 0.5 ms and its backoff
    means, peaks, above = (list(v) for v in zip(*found, strict=True))
    assert within(means, mean_age_s(PERIOD_S, loss, float(delay_s)))
    assert within(peaks, mean_peak_age_s(PERIOD_S, loss, float(delay_s)))
    assert np.mean(above) == pytest.approx(share_older(3, loss), rel=0.2, abs=0.01)


def test_bursts_in_the_air_have_their_age() -> None:
    bursts = BurstSettings(good_to_bad=0.05, bad_to_good=0.28, step_s=PERIOD_S)
    config = AirSettings(bursts=bursts, shadowing_sigma_db=0.0)
    found = [mean_age(r) for seed in (1, 2, 3) for r in flown_ages(config, 900.0, seed=seed).values()]
    chain = Chain(0.05, 0.28, 0.0, 1.0)
    means, peaks, above = (list(v) for v in zip(*found, strict=True))
    delay_s = 0.0006
    assert within(means, mean_age_s(PERIOD_S, chain, delay_s))
    assert within(peaks, mean_peak_age_s(PERIOD_S, chain, delay_s))
    assert np.mean(above) == pytest.approx(share_older(3, chain), rel=0.1)
    assert not within(means, mean_age_s(PERIOD_S, chain.mean_loss, delay_s))  # bursts are not independent losses
    assert np.mean(above) > 10 * share_older(3, chain.mean_loss)
