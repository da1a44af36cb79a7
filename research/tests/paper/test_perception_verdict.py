"""The rule of verdicts: every branch, over made intervals."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from research.paper import verdict
from research.paper.verdict import HALF_AN_ORDER, ClaimVerdict, Judgement, MeasuredValue, Paper, Size

UP, DOWN, NOTHING = Paper(4.8, 3.8, 5.8), Paper(-4.8, -5.8, -3.8), Paper(0.8, -0.8, 2.3, margin=1.0)
R, N, O, X = ClaimVerdict.REPRODUCED, ClaimVerdict.NOT_REPRODUCED, ClaimVerdict.OPPOSITE, ClaimVerdict.NOT_MEASURABLE  # noqa: E741
OPEN = ClaimVerdict.INCONCLUSIVE


def m(value: float, low: float, high: float) -> MeasuredValue:
    """A normal figure: its 90 % interval is 0.84 times as wide as that of 95 %."""
    return MeasuredValue(value, low, high, value + 0.84 * (low - value), value + 0.84 * (high - value), 0.5)


@pytest.mark.parametrize(
    ("paper", "ours", "expected"),
    [
        (UP, m(5.0, 4.0, 6.0), Judgement(R, Size.SAME)),
        (UP, m(5.0, 5.8, 6.0), Judgement(R, Size.SAME)),  # intervals that touch overlap
        (UP, m(9.0, 8.0, 10.0), Judgement(R, Size.LARGER)),
        (UP, m(1.0, 0.5, 1.5), Judgement(R, Size.SMALLER)),
        (UP, m(1.0, -0.1, 4.5), Judgement(N, Size.SAME)),
        (UP, m(0.1, -0.1, 0.3), Judgement(N, Size.SMALLER)),
        (UP, m(0.1, 0.0, 0.3), Judgement(N, Size.SMALLER)),  # an interval that touches zero holds it
        (UP, m(-2.0, -3.0, -1.0), Judgement(O, Size.SMALLER)),
        (UP, m(-9.0, -9.9, -8.0), Judgement(O, Size.LARGER)),
        (DOWN, m(-5.0, -6.0, -4.0), Judgement(R, Size.SAME)),
        (DOWN, m(2.0, 1.0, 3.0), Judgement(O, Size.SMALLER)),
        (Paper(58.0), m(55.0, 50.0, 60.0), Judgement(R, Size.SAME)),  # no interval in the paper: ours holds its value
        (Paper(58.0), m(75.0, 70.0, 80.0), Judgement(R, Size.LARGER)),
        (Paper(-24.0), m(-9.0, -10.0, -8.0), Judgement(R, Size.SMALLER)),
        (Paper(58.0), m(1.0, -1.0, 2.0), Judgement(N, Size.SMALLER)),
        (UP, None, Judgement(X)),
        (UP, MeasuredValue(4.8), Judgement(X)),
        (UP, m(math.nan, math.nan, math.nan), Judgement(X)),
    ],
)
def test_a_difference_is_judged_by_sign_and_significance(
    paper: Paper, ours: MeasuredValue | None, expected: Judgement
) -> None:
    assert verdict.contrast(paper, ours) == expected


@pytest.mark.parametrize(
    ("ours", "expected"),
    [
        (m(0.2, -0.5, 0.9), R),
        (m(0.0, 0.0, 0.0), R),
        (m(0.25, 0.12, 0.38), R),  # significant, and of no weight
        (m(0.2, -3.0, 3.4), OPEN),  # noise shows nothing
        (m(-2.0, -5.0, 0.1), OPEN),
        (m(0.5, -0.1, 1.1), OPEN),  # the 90 % interval ends at 1.004
        (m(0.5, -0.09, 1.09), R),  # and here at 0.9956
        (m(1.0, 0.5, 1.5), N),
        (m(-3.0, -4.0, -2.0), N),
        (None, X),
        (MeasuredValue(0.0), X),
        (m(math.nan, math.nan, math.nan), X),
    ],
)
def test_no_difference_takes_an_equivalence_test(ours: MeasuredValue | None, expected: ClaimVerdict) -> None:
    for paper in (NOTHING, Paper(margin=1.0)):
        assert verdict.no_difference(paper, ours) == Judgement(expected)


@pytest.mark.parametrize(
    ("ours", "expected"),
    [
        (m(60.0, 56.0, 64.0), Judgement(R)),
        (m(64.4, 61.0, 67.9), Judgement(N, Size.LARGER)),  # far from zero, and from what is claimed
        (m(30.0, 20.0, 40.0), Judgement(N, Size.SMALLER)),
        (m(58.0, 40.0, 76.0), Judgement(OPEN)),
        (None, Judgement(X)),
        (MeasuredValue(58.0), Judgement(X)),
    ],
)
def test_a_size_is_tested_against_the_papers(ours: MeasuredValue | None, expected: Judgement) -> None:
    assert verdict.same_value(Paper(58.0, margin=7.0), ours) == expected


def test_a_claim_of_a_value_needs_a_margin() -> None:
    with pytest.raises(ValueError, match="a claim of a value needs a margin"):
        verdict.no_difference(Paper(0.0), m(0.0, -1.0, 1.0))


@given(st.floats(-5, 5), st.floats(0.001, 10), st.floats(0.1, 3))
def test_more_noise_never_makes_none_of_a_difference(value: float, wide: float, more: float) -> None:
    """What a wide interval shows a narrower one about the same value shows as well."""
    narrow, noisy = (m(value, value - w, value + w) for w in (wide, wide + more))
    if verdict.no_difference(NOTHING, noisy).verdict == R:
        assert verdict.no_difference(NOTHING, narrow).verdict == R


@given(st.floats(-30, 30), st.floats(0.001, 10), st.floats(-30, 30), st.floats(0.001, 10))
def test_signs_turned_on_both_sides_turn_nothing(a: float, wide_a: float, b: float, wide_b: float) -> None:
    def both(sign: int) -> Judgement:
        ends = sorted((sign * (a - wide_a), sign * (a + wide_a)))
        ours = m(sign * b, *sorted((sign * (b - wide_b), sign * (b + wide_b))))
        rule = verdict.no_difference if ends[0] <= 0 <= ends[1] else verdict.contrast
        return rule(Paper(sign * a, *ends, margin=1.2), ours)

    assert both(1) == both(-1)


@given(st.floats(-30, 30), st.floats(0.001, 10))
def test_the_papers_own_figures_reproduce_it(value: float, wide: float) -> None:
    low, high = value - wide, value + wide
    if not low <= 0 <= high:
        assert verdict.contrast(Paper(value, low, high), m(value, low, high)) == Judgement(R, Size.SAME)
    assert verdict.same_value(Paper(value, margin=wide), m(value, low, high)) == Judgement(R)


@pytest.mark.parametrize(
    ("ours", "expected"),
    [
        (m(88.0, 80.0, 95.0), Judgement(R, Size.SAME)),
        (m(70.0, 51.0, 80.0), Judgement(R, Size.SMALLER)),
        (m(55.0, 50.0, 60.0), Judgement(N, Size.SMALLER)),
        (m(40.0, 30.0, 49.9), Judgement(O, Size.SMALLER)),
        (MeasuredValue(70.0), Judgement(X)),
        (None, Judgement(X)),
    ],
)
def test_most_is_more_than_a_half(ours: MeasuredValue | None, expected: Judgement) -> None:
    assert verdict.most(Paper(89.0), ours) == expected


def test_absolute_levels_are_not_compared() -> None:
    assert verdict.level(Paper(0.371), m(0.371, 0.35, 0.39)) == Judgement(ClaimVerdict.NOT_COMPARABLE)
    assert verdict.level(Paper(0.371), None) == Judgement(X)


@pytest.mark.parametrize(
    ("value", "expected"),
    [(10.08, R), (10.05, R), (10.149, R), (10.151, N), (9.9, N), (math.nan, X)],
)
def test_what_follows_by_counting_has_to_round_to_the_print(value: float, expected: ClaimVerdict) -> None:
    assert verdict.exact(Paper(10.1), MeasuredValue(value)).verdict == expected
    assert verdict.exact(Paper(10.1), None).verdict == X


@pytest.mark.parametrize(
    ("times", "most", "least", "order"),
    [
        (1.0, R, R, R),
        (0.999 * HALF_AN_ORDER, R, R, R),
        (1.001 * HALF_AN_ORDER, N, R, N),
        (1.001 / HALF_AN_ORDER, R, R, R),
        (0.999 / HALF_AN_ORDER, R, N, N),
    ],
)
def test_quantities_are_judged_to_half_an_order_of_magnitude(
    times: float, most: ClaimVerdict, least: ClaimVerdict, order: ClaimVerdict
) -> None:
    paper, ours = Paper(0.1), MeasuredValue(0.1 * times)
    assert verdict.at_most(paper, ours).verdict == most
    assert verdict.at_least(paper, ours).verdict == least
    assert verdict.same_order(paper, ours).verdict == order


def test_a_quantity_that_is_not_there_is_not_measurable() -> None:
    for rule in (verdict.at_most, verdict.at_least, verdict.same_order):
        assert [rule(Paper(9.0), o).verdict for o in (None, MeasuredValue(math.nan), MeasuredValue(0.0))] == [X, X, X]


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (5.0, Judgement(R, Size.SAME)),
        (10.0, Judgement(R, Size.SAME)),
        (4.9, Judgement(N, Size.SMALLER)),
        (25.0, Judgement(N, Size.LARGER)),
        (math.nan, Judgement(N)),
    ],
)
def test_a_place_is_reproduced_inside_the_papers_bracket(value: float, expected: Judgement) -> None:
    assert verdict.same_place(Paper(low=5.0, high=10.0), MeasuredValue(value)) == expected
    assert verdict.same_place(Paper(low=5.0, high=10.0), None) == Judgement(X)
