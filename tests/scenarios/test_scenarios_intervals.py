"""Intervals of means: Student's, in their range, and how often they cover; every metric has its range."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from sortie.scenarios.intervals import AMOUNT, ANY, FLAG, SHARE, Range, mean_interval, paired
from sortie.sim.results.outcome_fields import possible


def test_an_interval_without_a_range_is_students() -> None:
    values = np.random.default_rng(0).normal(5, 2, 23)
    found = mean_interval(values)
    assert (found.low, found.high) == pytest.approx(
        stats.t.interval(0.95, 22, values.mean(), stats.sem(values)), rel=1e-12
    )
    assert (found.mean, found.count) == (pytest.approx(values.mean()), 23)
    assert mean_interval([math.nan, 3.0]).count == 1
    assert math.isnan(mean_interval([3.0]).half_width)
    assert math.isnan(mean_interval([]).mean)


@pytest.mark.parametrize("level", [0.5, 0.8, 0.95, 0.999])
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
    flag, exact = mean_interval([1, 0, 0, 0, 1], FLAG, level), stats.binomtest(2, 5).proportion_ci(level, "exact")
    assert (flag.low, flag.high) == pytest.approx((exact.low, exact.high))


def test_averages_of_a_yes_or_no_have_the_interval_of_a_share() -> None:
    """A campaign's unit is the mean over its replications, which is neither 0 nor 1 where they differ."""
    for values in ([0.5, 0.0, 0.0], [0.5] * 10, [1.0, 0.0, 0.25, 1.0]):
        assert mean_interval(values, FLAG) == mean_interval(values, SHARE)
    assert mean_interval([0.5, 0.0, 0.0], FLAG).mean == pytest.approx(1 / 6)


def test_far_from_its_ends_a_range_changes_nothing() -> None:
    values = np.random.default_rng(1).normal(0.01, 0.005, 8)
    plain = mean_interval(values)
    for within in (Range(-1, 1), Range(-1e6)):
        found = mean_interval(values, within)
        assert (found.low, found.high) == pytest.approx((plain.low, plain.high), abs=1e-4)


@given(st.lists(st.floats(0, 1), min_size=2, max_size=12), st.sampled_from([0.5, 0.95, 0.9999]))
def test_a_rate_stays_a_rate_and_an_amount_is_never_negative(values: list[float], level: float) -> None:
    for within in (SHARE, AMOUNT):
        found = mean_interval(values, within, level)
        assert within.low <= found.low <= found.mean + 1e-12
        assert found.mean - 1e-12 <= found.high <= within.high
    gain = mean_interval([a - b for a, b in zip(values, values[1:] + values[:1], strict=True)], SHARE.of_differences())
    assert -1 <= gain.low <= gain.high <= 1


def test_equal_values_are_their_own_interval_and_impossible_ones_are_refused() -> None:
    assert mean_interval([1.0, 1.0, 1.0], SHARE).low == 1.0
    assert mean_interval([0.0, 0.0], AMOUNT).high == 0.0
    for within in (ANY, AMOUNT, SHARE, FLAG):
        found = mean_interval([0.0, 0.0], within)
        assert {type(v) for v in (found.mean, found.low, found.high)} == {float}, "no truth value in place of 0"
    with pytest.raises(ValueError, match=r"1\.5, must be 0 to 1"):
        mean_interval([0.2, 1.5], SHARE)


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
    """93 to 98 %, within which Student's interval of eight stays for these; a percentile bootstrap covers about 90 %."""
    rng = np.random.default_rng(0)
    found = [mean_interval(draw(rng), within) for _ in range(4000)]  # type: ignore[operator]
    assert 0.93 < np.mean([e.low <= true <= e.high for e in found]) < 0.98


def test_pairing_saves_what_the_common_part_was() -> None:
    """With a = c + x, b = c + y the difference has Var x + Var y, unpaired Var x + Var y + 2 Var c: here 1 + 2·25/2 = 26."""
    rng = np.random.default_rng(1)
    c, x, y = rng.normal(0, 5, 20_000), rng.normal(0, 1, 20_000), rng.normal(1, 1, 20_000)
    found = paired(c + x, c + y)
    assert found.saved == pytest.approx(26, rel=0.05)
    assert found.difference.low < 1 < found.difference.high
    assert found.difference.half_width == pytest.approx(1.96 * math.sqrt(2 / 20_000), rel=0.05)


@pytest.mark.parametrize(
    ("metric", "within"),
    [
        ("deadline_miss_rate", SHARE), ("phases.1.deadline_miss_rate", SHARE), ("ap50.mission", SHARE), ("ap50.grounded_blind.mission", SHARE),
        ("mission.target_detected_share", SHARE), ("mission.target_longest_undetected_s", AMOUNT),
        ("phases.0.ap50.full_scene", SHARE), ("battery.3", SHARE), ("drones.2.soc", SHARE), ("medium_busy_fraction", SHARE),
        ("drones.2.airborne", FLAG), ("drones.2.energy_j", AMOUNT), ("bytes.data_sent", AMOUNT), ("payload_fates.delivered", AMOUNT),
        ("age_s.p99", AMOUNT), ("ap50.scored_fusions", AMOUNT), ("nothing.like_it", ANY), ("bytes.nothing", ANY),
    ],
)  # fmt: skip
def test_every_metric_has_its_range(metric: str, within: Range) -> None:
    assert possible(metric) == within


@pytest.mark.parametrize(("k", "n"), [(0, 8), (8, 8), (3, 8), (1, 200)])
def test_a_yes_or_no_has_the_exact_interval_also_where_all_are_equal(k: int, n: int) -> None:
    found = mean_interval([1.0] * k + [0.0] * (n - k), FLAG)
    exact = stats.binomtest(k, n).proportion_ci(method="exact")
    assert (found.mean, found.count) == (k / n, n)
    assert (found.low, found.high) == pytest.approx((exact.low, exact.high), abs=1e-9)


def test_a_share_that_rounding_left_beside_its_end_is_at_the_end() -> None:
    for beside in (1 - 1e-16, 1 + 2e-16):
        assert mean_interval([beside, 1.0, 1.0], SHARE).high == 1.0


def test_an_events_drone_may_be_the_fleets() -> None:
    assert possible("events.0.drone") == ANY
