"""Intervals of means: Student's, in their range, and how often they cover; differences; every metric's range."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from sortie.scenarios.intervals import (
    AMOUNT,
    ANY,
    FLAG,
    SHARE,
    Range,
    mean_interval,
    p_value,
    paired,
    percentile_interval,
    resamples,
)
from sortie.sim.results.outcome import possible


def test_an_interval_without_a_range_is_students() -> None:
    values = np.random.default_rng(0).normal(5, 2, 23)
    found = mean_interval(values)
    wanted = stats.t.interval(0.95, 22, values.mean(), stats.sem(values))
    assert (found.low, found.high) == pytest.approx(wanted, rel=1e-12)
    assert (found.mean, found.count) == (pytest.approx(values.mean()), 23)
    assert mean_interval([math.nan, 3.0]).count == 1
    assert math.isnan(mean_interval([3.0]).half_width)
    assert math.isnan(mean_interval([]).mean)


@pytest.mark.parametrize("level", [0.5, 0.95, 0.999])
def test_every_kind_of_interval_has_the_level_that_is_asked_for(level: float) -> None:
    """Student's by scipy, carried over to the logarithm and to the logit; the binomial's exact one by scipy."""
    values = [0.2, 0.5, 0.3, 0.4, 0.7]
    mean, error = np.mean(values), stats.sem(values)
    low, high = stats.t.interval(level, 4, loc=mean, scale=error)
    plain = mean_interval(values, ANY, level)
    assert (plain.low, plain.high) == pytest.approx((low, high))
    amount = mean_interval(values, AMOUNT, level)
    off = (high - mean) / mean
    assert (math.log(amount.low / mean), math.log(amount.high / mean)) == pytest.approx((-off, off))
    share, off = mean_interval(values, SHARE, level), (high - mean) / (mean * (1 - mean))
    odds = [math.log(v / (1 - v)) for v in (share.low, mean, share.high)]
    assert np.diff(odds) == pytest.approx([off, off])
    for k, n in ((2, 5), (0, 8), (8, 8), (3, 8), (1, 200)):
        flag = mean_interval([1.0] * k + [0.0] * (n - k), FLAG, level)
        exact = stats.binomtest(k, n).proportion_ci(level, "exact")
        assert (flag.mean, flag.count) == (k / n, n)
        assert (flag.low, flag.high) == pytest.approx((exact.low, exact.high), abs=1e-9)


def test_averages_of_a_yes_or_no_have_the_interval_of_a_share() -> None:
    """A campaign's unit is the mean over its replications, which is neither 0 nor 1 where they differ."""
    for values in ([0.5, 0.0, 0.0], [0.5] * 10, [1.0, 0.0, 0.25, 1.0]):
        assert mean_interval(values, FLAG) == mean_interval(values, SHARE)
    assert mean_interval([0.5, 0.0, 0.0], FLAG).mean == pytest.approx(1 / 6)


@given(st.lists(st.floats(0, 1), min_size=2, max_size=12), st.sampled_from([0.5, 0.95, 0.9999]))
def test_a_rate_stays_a_rate_and_an_amount_is_never_negative(values: list[float], level: float) -> None:
    for within in (SHARE, AMOUNT):
        found = mean_interval(values, within, level)
        assert within.low <= found.low <= found.mean + 1e-12
        assert found.mean - 1e-12 <= found.high <= within.high
    gain = mean_interval([a - b for a, b in zip(values, values[1:] + values[:1], strict=True)], SHARE.of_differences())
    assert -1 <= gain.low <= gain.high <= 1


def test_equal_values_are_their_own_interval_and_impossible_ones_are_refused() -> None:
    """A value that rounding has left beside an end is the end."""
    assert mean_interval([1.0, 1.0, 1.0], SHARE).low == 1.0
    for within in (ANY, AMOUNT, SHARE, FLAG):
        found = mean_interval([0.0, 0.0], within)
        assert {type(v) for v in (found.mean, found.low, found.high)} == {float}, "no truth value in place of 0"
    assert mean_interval([0.0, 0.0], AMOUNT).high == 0.0
    for beside in (1 - 1e-16, 1 + 2e-16):
        assert mean_interval([beside, 1.0, 1.0], SHARE).high == 1.0
    assert mean_interval([1.0 + 1e-14, -1e-14], SHARE).mean == 0.5
    for beyond in (1.5, 1.0 + 1e-9):
        with pytest.raises(ValueError, match="must be 0 to 1"):
            mean_interval([0.2, beyond], SHARE)


@pytest.mark.parametrize(
    ("draw", "within", "true"),
    [
        (lambda rng: rng.normal(0.02, 0.1, 8), Range(-1, 1), 0.02),
        (lambda rng: rng.beta(2, 6, 8), SHARE, 0.25),
        (lambda rng: rng.beta(0.4, 0.6, 8), SHARE, 0.4),
        (lambda rng: rng.gamma(3, 1e6, 8), AMOUNT, 3e6),
    ],
    ids=["differences", "rates", "rates near both ends", "bytes"],
)
def test_eight_units_cover_as_promised(draw: object, within: Range, true: float) -> None:
    """93 to 98 %, within which Student's interval of eight stays here; a percentile bootstrap covers about 90 %."""
    rng = np.random.default_rng(0)
    found = [mean_interval(draw(rng), within) for _ in range(4000)]  # type: ignore[operator]
    assert 0.93 < np.mean([e.low <= true <= e.high for e in found]) < 0.98


# --- pairs ----------------------------------------------------------------------------------------


def test_what_pairing_saves_follows_from_each_side_s_own_spread() -> None:
    a, b = np.array([1.0, 3.0, 5.0, math.nan, 2.0]), np.array([2.0, 8.0, 14.0, 1.0, math.nan])
    both, other = paired(a, b), paired(b, a)
    assert (both.difference.mean, both.difference.count) == (pytest.approx((1 + 5 + 9) / 3), 3)
    assert both.saved == pytest.approx((4.0 + 36.0) / 16.0)  # the variances of 1, 3, 5 and of 2, 8, 14
    assert (other.saved, other.difference.mean) == (pytest.approx(both.saved), pytest.approx(-both.difference.mean))
    one = paired(np.array([1.0, math.nan]), np.array([3.0, 5.0]))
    assert (one.difference.mean, one.difference.count) == (2.0, 1)
    none = paired(np.array([math.nan]), np.array([3.0]))
    assert none.difference.count == 0
    assert math.isnan(one.saved)
    assert math.isnan(none.saved)


def test_a_difference_of_rates_stays_between_the_ends_of_differences() -> None:
    a, b = np.zeros(4), np.array([0.9, 0.95, 1.0, 1.0])
    rates = paired(a, b, SHARE).difference
    assert rates == mean_interval(b - a, Range(-1.0, 1.0))
    assert rates.high < 1.0 < paired(a, b).difference.high
    assert Range(0.0, 1.0).of_differences() == (-1.0, 1.0, False)
    assert Range(2.0, 5.0).of_differences() == (-3.0, 3.0, False)
    assert paired(a, b, AMOUNT).difference == mean_interval(b - a)


# --- resampling -----------------------------------------------------------------------------------


def test_an_interval_leaves_out_as_much_below_as_above() -> None:
    draws = np.arange(1001.0)
    for level in (0.5, 0.8, 0.95):
        low, high = percentile_interval(draws, level)
        assert (low, high) == pytest.approx((500 - 500 * level, 500 + 500 * level))
        assert percentile_interval(np.append(draws, math.nan), level) == (low, high)


def test_a_draw_of_no_difference_speaks_for_no_difference() -> None:
    """Zeros count on both sides; the smaller side counts twice, and the observed one with it."""
    up = np.array([1.0, 2.0, 3.0, 4.0])
    found = [p_value(draws) for draws in (up, -up, np.array([-1.0, 1, 2, 3]), np.array([0.0, 1, 2, 3]))]
    assert found == pytest.approx([2 / 5, 2 / 5, 4 / 5, 4 / 5])
    assert p_value(np.array([0.0, 0.0, 0.0, 3.0, math.nan])) == 1.0


def test_resamples_draw_as_many_as_there_are_alike_often() -> None:
    weights = resamples(7, 4000, 3)
    assert (weights.sum(axis=1) == 7).all()
    assert weights.mean(axis=0) == pytest.approx(np.ones(7), abs=0.08)
    assert not np.array_equal(weights, resamples(7, 4000, 4))


# --- metrics --------------------------------------------------------------------------------------

RANGES = {
    SHARE: "deadline_miss_rate phases.1.deadline_miss_rate ap50.mission ap50.grounded_blind.mission "
    "mission.target_detected_share phases.0.ap50.full_scene battery.3 drones.2.soc medium_busy_fraction",
    AMOUNT: "mission.target_longest_undetected_s drones.2.energy_j bytes.data_sent payload_fates.delivered age_s.p99 "
    "ap50.scored_fusions",
    FLAG: "drones.2.airborne",
    ANY: "nothing.like_it bytes.nothing events.0.drone",
}


def test_every_metric_has_its_range() -> None:
    wanted = {metric: within for within, metrics in RANGES.items() for metric in metrics.split()}
    assert {metric: possible(metric) for metric in wanted} == wanted
