"""A mean with a control variate: closed forms, an independent implementation, properties, and how often it covers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import stats

from sortie.scenarios.control_variates import Controlled, Plan, controlled_mean, plan_units, widened
from sortie.scenarios.intervals import Estimate, mean_interval

NUMBERS = st.floats(-100, 100).map(lambda v: round(v, 3))


def drawn(n: int, correlation: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    z = np.random.default_rng(seed).normal(size=(n, 2))
    return correlation * z[:, 0] + math.sqrt(1 - correlation**2) * z[:, 1], z[:, 0]


def test_it_is_what_leaving_each_unit_out_by_hand_gives() -> None:
    """Slopes by scipy, one regression a unit; the interval by Welch's degrees of freedom."""
    (y, x), more = drawn(9, 0.8), np.random.default_rng(5).normal(size=30)
    slopes = np.array([stats.linregress(np.delete(x, k), np.delete(y, k)).slope for k in range(9)])
    coefficients = 30 / 39 * slopes
    corrected = y - coefficients * (x - more.mean())
    found = controlled_mean(y, x, more)
    assert found.coefficient == pytest.approx(coefficients.mean(), rel=1e-12)
    assert found.estimate.mean == pytest.approx(corrected.mean(), rel=1e-12)
    parts = corrected.var(ddof=1) / 9, coefficients.mean() ** 2 * more.var(ddof=1) / 30
    freedom = sum(parts) ** 2 / (parts[0] ** 2 / 7 + parts[1] ** 2 / 29)
    assert found.estimate.half_width == pytest.approx(stats.t.ppf(0.975, freedom) * math.sqrt(sum(parts)), rel=1e-9)
    left_out = [y[k] - np.polyval(np.polyfit(np.delete(x, k), np.delete(y, k), 1), x[k]) for k in range(9)]
    without = [y[k] - np.delete(y, k).mean() for k in range(9)]
    assert found.explained == pytest.approx(1 - np.square(left_out).sum() / np.square(without).sum(), rel=1e-9)
    assert found.correlation == pytest.approx(stats.pearsonr(x, y).statistic, rel=1e-12)
    assert found.variance == pytest.approx(y.var(ddof=1), rel=1e-12)


PAIRS = st.lists(st.tuples(NUMBERS, NUMBERS), min_size=5, max_size=12)


@given(PAIRS, st.lists(NUMBERS, min_size=2, max_size=20), NUMBERS, st.floats(0.1, 10))
def test_units_and_offsets_of_the_cheap_measurement_do_not_matter(
    pairs: list[tuple[float, float]], more: list[float], offset: float, factor: float
) -> None:
    y, x = map(np.array, zip(*pairs, strict=True))
    assume(np.ptp(x) > 1 and np.ptp(y) > 1)
    assume(min(np.ptp(np.delete(x, k)) for k in range(len(x))) > 1)  # else some slope is not defined
    one, other = controlled_mean(y, x, more), controlled_mean(y, offset + factor * x, offset + factor * np.array(more))
    assert other.estimate.mean == pytest.approx(one.estimate.mean, rel=1e-6, abs=1e-6)
    assert other.estimate.half_width == pytest.approx(one.estimate.half_width, rel=1e-6, abs=1e-6)
    moved = controlled_mean(y + offset, x, more)
    assert moved.estimate.mean == pytest.approx(one.estimate.mean + offset, rel=1e-6, abs=1e-6)
    order = np.random.default_rng(0).permutation(len(y))
    assert controlled_mean(y[order], x[order], more[::-1]).estimate.mean == pytest.approx(one.estimate.mean, abs=1e-6)


UNUSABLE: dict[str, tuple[list[float], list[float], list[float]]] = {
    "three pairs": ([1.0, 2.0, 4.0], [1.0, 2.0, 3.0], [1.0, 2.0, 3.0]),
    "a constant": ([1.0, 2.0, 4.0, 3.0], [2.0, 2.0, 2.0, 2.0], [1.0, 2.0, 3.0]),
    "one further unit": ([1.0, 2.0, 4.0, 3.0], [1.0, 2.0, 3.0, 5.0], [1.0]),
    "three pairs without NaN": ([1.0, 2.0, 4.0, 3.0, math.nan], [1.0, 2.0, 3.0, math.nan, 4.0], [1.0, 2.0]),
}


def test_without_a_usable_control_variate_the_interval_is_students() -> None:
    for name, (y, x, more) in UNUSABLE.items():
        found = controlled_mean(y, x, more)
        kept = [a for a, b in zip(y, x, strict=True) if not math.isnan(a + b)]
        assert (found.estimate, found.coefficient) == (mean_interval(kept), 0), name
    with pytest.raises(ValueError, match="2 expensive and 3 cheap measurements, must be of the same units"):
        controlled_mean([1.0, 2.0], [1.0, 2.0, 3.0], [])


def test_the_expensive_measurement_alone_is_the_plain_mean_and_further_units_without_a_value_are_left_out() -> None:
    (y, x), more = drawn(10, 0.9), drawn(50, 0.9, 1)[1]
    plain, used = (controlled_mean(y, x, more, control=control) for control in (False, True))
    assert (plain.estimate, plain.coefficient) == (mean_interval(y), 0.0)
    assert used.coefficient > 0.5
    assert plain.correlation == used.correlation
    assert controlled_mean(y, x, np.insert(more, [0, 7, 20], math.nan)) == used


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_the_interval_covers_and_the_mean_is_unbiased_whatever_the_cheap_error(correlation: float) -> None:
    """800 repetitions, the cheap measurement off by 7: three standard errors."""
    hits, errors = 0, []
    for seed in range(800):
        (y, x), more = drawn(10, correlation, seed), drawn(40, correlation, 10_000 + seed)[1]
        found = controlled_mean(y, 7 + x, 7 + more).estimate
        hits += found.low <= 0 <= found.high
        errors.append(found.mean)
    assert abs(hits / 800 - 0.95) < 3 * math.sqrt(0.95 * 0.05 / 800)
    assert abs(np.mean(errors)) < 3 * np.std(errors) / math.sqrt(800)


def quantity(variance: float, explained: float) -> Controlled:
    return Controlled(Estimate(0.0, -1.0, 1.0, 12), 0.0, math.sqrt(max(explained, 0.0)), explained, variance)


def test_the_ratio_of_the_units_is_that_of_the_closed_form() -> None:
    """The least of (1 − ρ² + ρ² / q) (c + q) is at q = sqrt(ρ² c / (1 − ρ²))."""
    cost, squared = 20.0, 0.81
    total = math.sqrt(squared * cost / (1 - squared))
    plan = plan_units([quantity(1.0, squared)], 0.05, cost, 1.0)
    assert (plan.expensive + plan.cheap) / plan.expensive == pytest.approx(total, rel=0.01)
    assert plan.cost_ratio == pytest.approx((1 - squared + squared / total) * (1 + total / cost), rel=1e-6)
    variance = (1 - squared + squared / total) / plan.expensive
    off = float(stats.t.ppf(0.975, plan.expensive - 2)) * math.sqrt(variance * (1 + 3 / plan.expensive))
    assert off <= 0.05 < off * math.sqrt(plan.expensive / (plan.expensive - 1)) * 1.01


@pytest.mark.parametrize("explained", [-0.5, 0.0, 0.05])
def test_a_useless_cheap_measurement_is_not_planned(explained: float) -> None:
    plan = plan_units([quantity(1.0, explained)], 0.5, 10.0, 1.0)
    alone = plan_units([quantity(1.0, 0.99)], 0.5, 10.0, 1.0, control=False)
    assert plan == alone == Plan(plan.expensive, 0, 1.0)
    n = plan.expensive
    off = [float(stats.t.ppf(0.975, k - 1)) * math.sqrt((1 + 3 / k) / k) for k in (n - 1, n)]
    assert off[1] <= 0.5 < off[0]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_quantity_that_needs_most_decides_a_plan(order: tuple[int, int]) -> None:
    """With and without a cheap measurement, before and after units were measured, whichever stands first."""
    of = (quantity(1.0, 0.9), quantity(9.0, 0.5))
    pilot, hard = [of[i] for i in order], [of[1]]
    alone = plan_units(hard, 0.5, 100.0, 1.0, control=False)
    assert plan_units(pilot, 0.5, 100.0, 1.0, control=False) == alone
    assert plan_units(pilot, 0.5, 100.0, 1.0).expensive == plan_units(hard, 0.5, 100.0, 1.0).expensive
    measured = plan_units(pilot, 0.5, 100.0, 1.0).expensive + 10
    more = plan_units(pilot, 0.5, 100.0, 1.0, measured=measured)
    assert more.expensive == measured
    assert more.cheap == max(plan_units([q], 0.5, 100.0, 1.0, measured=measured).cheap for q in of) > 0
    assert plan_units(pilot, 0.5, 100.0, 1.0, measured=10_000, control=False).expensive == 10_000


def test_units_that_are_measured_already_are_not_planned_away() -> None:
    one = quantity(1.0, 0.8)
    free = plan_units([one], 0.5, 20.0, 1.0)
    assert plan_units([one], 0.5, 20.0, 1.0, measured=free.expensive) == free
    more = plan_units([one], 0.5, 20.0, 1.0, measured=free.expensive + 3)
    assert more.expensive == free.expensive + 3
    assert more.cheap < free.cheap
    n, m = more.expensive, more.cheap
    variances = [(1 - 0.8 * k / (n + k)) / n for k in (m, m - 1)]
    t = float(stats.t.ppf(0.975, n - 2)) * math.sqrt(1 + 3 / n)
    assert t * math.sqrt(variances[0]) <= 0.5 < t * math.sqrt(variances[1])
    assert plan_units([one], 0.5, 20.0, 1.0, measured=100) == Plan(100, 0, pytest.approx(free.cost_ratio))


def test_intervals_are_widened_by_less_the_more_units_there_are() -> None:
    few, many = (widened(Estimate(2.0, 1.0, 3.0, n)) for n in (12, 300))
    assert (few.low, few.high) == pytest.approx((2 - math.sqrt(1.25), 2 + math.sqrt(1.25)))
    assert many.half_width == pytest.approx(math.sqrt(1.01))
    assert math.isnan(widened(mean_interval([])).half_width)
