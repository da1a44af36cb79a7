"""Measures, verdicts and report texts at their edges: ties, losses, frames with nothing to find, figures of another region."""

from __future__ import annotations

import math

import numpy as np
import pytest
from paper_examples import Made

from research.paper import report, verdict
from research.paper.claims import all_4
from research.paper.measures import ApOf, Contrast, Kept, Peak, Region, Widest, under
from research.paper.rows import points
from research.paper.verdict import ClaimVerdict, MeasuredValue, Paper
from research.paper.ways import FULL_SHARING, SINGLE, Sharing


def region_alone(region: str) -> Made:
    """Scores of one region; in the other there was nothing to find."""
    return Made({}, lambda c, r: 0.3 + 0.1 * (c.received_budget == 0.1) if r == region else math.nan)


@pytest.mark.parametrize("region", ["full", "mission"])
def test_a_peak_is_of_its_own_region(region: Region) -> None:
    curve = tuple(map(all_4, (0.02, 0.1, 1.0)))
    there = Peak(curve, region).measure(region_alone(region))
    assert (there.value, there.note) == (pytest.approx(10.0), "")
    nothing = Peak(curve, region).measure(region_alone({"full": "mission", "mission": "full"}[region]))
    assert math.isnan(nothing.value)
    assert nothing.note == "nothing was there to be found"


def test_of_equally_wide_contrasts_the_first_is_told() -> None:
    scores = Made({("all-4@0.05", "full"): 0.26, ("all-4@0.1", "full"): 0.26}, noise=0.0)
    among = tuple(Contrast((all_4(b),), (FULL_SHARING,)) for b in (0.05, 0.1))
    assert Widest(among).measure(scores).note == "at a budget of 0.05"
    assert Widest(among[::-1]).measure(scores).note == "at a budget of 0.1"


def test_a_part_of_a_loss_is_a_part_too() -> None:
    """Where sharing all is worse than a drone alone, half of the way there is a half."""
    scores = Made({("single", "full"): 0.3, ("all-4@1", "full"): 0.2, ("all-4@0.1", "full"): 0.25}, noise=0.0)
    assert Kept(all_4(0.1)).measure(scores).value == pytest.approx(50.0)


def test_a_steered_condition_stays_so_under_another_instrument() -> None:
    got = under(Sharing(0.1, roi=True), "masked", "norm")
    assert got == Sharing(0.1, unsent="masked", cells_by="norm", roi=True)


class Patchy(Made):
    """Some resamples have nothing to find."""

    def draws(self, condition: Sharing, region: Region) -> np.ndarray:
        drawn = super().draws(condition, region)
        drawn[::7] = math.nan
        return drawn


def test_draws_with_nothing_to_find_are_left_out_of_the_interval() -> None:
    scores = Patchy({})
    got = ApOf(SINGLE).measure(scores)
    some = scores.draws(SINGLE, "full")
    assert (got.low, got.high) == pytest.approx(np.nanpercentile(some, [2.5, 97.5]))
    assert got.p is None, "an absolute AP is not tested"


def test_points_are_of_their_region_and_without_an_interval_where_there_is_none() -> None:
    made = points({"masked": region_alone("full")})  # type: ignore[dict-item]
    assert {p.instrument for p in made} == {"masked"}
    for p in made:
        assert all(isinstance(v, float) for v in (p.ap, p.low, p.high))
        assert math.isfinite(p.ap) == math.isfinite(p.low) == math.isfinite(p.high) == (p.region == "full")
        assert p.region != "full" or p.low < p.ap < p.high


@pytest.mark.parametrize(
    ("value", "low", "high", "expected"),
    [
        (55.0, 51.0, 59.0, ClaimVerdict.REPRODUCED),
        (55.0, 50.0, 60.0, ClaimVerdict.NOT_REPRODUCED),
        (45.0, 35.0, 55.0, ClaimVerdict.NOT_REPRODUCED),
        (45.0, 41.0, 49.0, ClaimVerdict.OPPOSITE),
        (45.0, 40.0, 50.0, ClaimVerdict.NOT_REPRODUCED),
    ],
)
def test_most_is_kept_or_not_where_the_whole_interval_says_so(
    value: float, low: float, high: float, expected: ClaimVerdict
) -> None:
    assert verdict.most(Paper(89.0), MeasuredValue(value, low, high)).verdict == expected


@pytest.mark.parametrize(
    ("q", "text"),
    [(None, ""), (math.nan, ""), (0.0099, "< 0.01"), (0.01, "0.010"), (0.0994, "0.099"), (0.1, "0.10"), (1.3, "1.00")],
)
def test_a_level_has_two_digits_and_is_at_most_one(q: float | None, text: str) -> None:
    assert report._level(q) == text
