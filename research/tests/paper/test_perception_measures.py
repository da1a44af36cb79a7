"""What is measured for a claim, worked out from made APs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from paper_examples import Made, papers_world

from research.paper.claims import CLAIMS, POLICIES, all_4, conditions, two
from research.paper.measures import (
    ApOf,
    Contrast,
    Crossover,
    Kept,
    MeanLevel,
    Oracle,
    Peak,
    UnequalBytes,
    Widest,
    WrongChoice,
    held_out,
    under,
)
from research.paper.ways import FULL_SHARING, SINGLE, Sharing

PAPER = Made({}, papers_world)


def test_a_contrast_is_the_paired_difference_in_points() -> None:
    got = Contrast((FULL_SHARING,), (SINGLE,)).measure(PAPER)
    draws = 100 * (PAPER.draws(FULL_SHARING, "full") - PAPER.draws(SINGLE, "full"))
    assert got.value == pytest.approx(18.6)
    assert (got.low, got.high) == pytest.approx(np.percentile(draws, [2.5, 97.5]))
    assert got.p == pytest.approx(2 / 401)
    assert got.significant


def test_p_is_the_level_at_which_zero_leaves_the_interval() -> None:
    close = Made({("best-2@0.02", "full"): 0.300, ("worst-2@0.02", "full"): 0.303}, noise=0.004)
    got = Contrast((Sharing(0.02, "best-2"),), (Sharing(0.02, "worst-2"),)).measure(close)
    draws = close.draws(Sharing(0.02, "best-2"), "full") - close.draws(Sharing(0.02, "worst-2"), "full")
    assert got.p == pytest.approx(2 * (np.count_nonzero(draws >= 0) + 1) / 401)
    assert got.significant == (got.p < 0.05)


def test_of_several_policies_the_best_of_that_region_is_taken() -> None:
    scores = Made({("worst-2@0.25", "full"): 0.31, ("random-2@0.25", "mission"): 0.32, ("all-4@0.25", "full"): 0.35})
    assert Contrast((all_4(0.25),), two(0.25)).measure(scores).value == pytest.approx(4.0)
    assert Contrast((all_4(0.25),), two(0.25)).measure(scores).note == "all-4 − worst-2"
    assert Contrast((all_4(0.25),), two(0.25), "mission").measure(scores).note == "all-4 − random-2"


def test_the_same_policy_against_itself_is_nothing_and_not_significant() -> None:
    got = Contrast((all_4(0.1),), (all_4(0.1),)).measure(PAPER)
    assert (got.value, got.low, got.high, got.p, got.significant) == (0, 0, 0, 1.0, False)


def test_the_widest_of_several() -> None:
    scores = Made({("all-4@0.05", "mission"): 0.26, ("all-4@0.1", "mission"): 0.32})
    against = tuple(Contrast((all_4(rho),), (FULL_SHARING,), "mission") for rho in (0.05, 0.1))
    got = Widest(against).measure(scores)
    assert got.value == pytest.approx(-4.0)
    assert got.note == "at a budget of 0.05"


def test_the_part_of_the_gain_that_is_kept() -> None:
    got = Kept(all_4(0.05)).measure(PAPER)
    assert got.value == pytest.approx(100 * (0.293 - 0.185) / (0.371 - 0.185))
    assert got.low is not None
    assert got.high is not None
    assert got.low < got.value < got.high
    assert math.isnan(Kept(all_4(0.05)).measure(Made({}, noise=0.0)).value), "no gain to keep a part of"


def test_the_wrong_choice_loses_what_the_winner_there_gains() -> None:
    assert WrongChoice(POLICIES, chosen_at=3, judged_at=0).measure(PAPER).value == pytest.approx(-7.7)
    assert WrongChoice(POLICIES, chosen_at=0, judged_at=3).measure(PAPER).value == pytest.approx(-4.8)
    one_wins = Made({}, lambda c, r: 0.4 if c.rule == "all" else 0.3)
    got = WrongChoice(POLICIES, chosen_at=3, judged_at=0).measure(one_wins)
    assert (got.value, got.significant, got.note) == (0.0, False, "all-4 wins")


def test_the_oracle_switches_and_the_best_fixed_policy_does_not() -> None:
    got = Oracle(POLICIES).measure(PAPER)
    switched = np.mean([0.257, 0.307, 0.351, 0.361])
    fixed = max(np.mean([0.180, 0.293, 0.351, 0.361]), np.mean([0.257, 0.307, 0.311, 0.313]))
    assert got.value == pytest.approx(100 * (switched - fixed))
    assert MeanLevel(POLICIES, fixed=False).measure(PAPER).value == pytest.approx(switched)
    assert MeanLevel(POLICIES, fixed=True).measure(PAPER).value == pytest.approx(fixed)


def test_an_oracle_without_a_choice_to_make_gains_nothing() -> None:
    one_wins = Made({}, lambda c, r: 0.4 if c.rule == "all" else 0.3)
    assert Oracle(POLICIES).measure(one_wins).value == 0.0
    assert not Oracle(POLICIES).measure(one_wins).significant
    assert Oracle(POLICIES, held_out=True).measure(one_wins).value == pytest.approx(0.0)


def test_held_out_judges_each_half_by_the_others_choice() -> None:
    # Two policies, two budgets, one split: the halves disagree about the first budget, so the choice there is wrong twice.
    halves = np.array([[[[0.5, 0.1]], [[0.4, 0.4]]], [[[0.2, 0.3]], [[0.2, 0.2]]]])
    # chosen on half 0: policy 0 at both budgets and as the fixed one; judged on half 1: no difference
    # chosen on half 1: policy 1, then 0, against policy 0 fixed (0.25 = 0.25, the first); on half 0: (0.2+0.4)/2 − 0.45
    assert held_out(halves) == pytest.approx([(0.0 + (0.3 - 0.45)) / 2])


def test_choosing_among_equals_pays_in_the_sample_and_not_held_out() -> None:
    equal = Made({}, lambda c, r: 0.3, noise=0.02)
    got = Oracle(POLICIES, held_out=True).measure(equal)
    assert got.value < 0.2
    assert not got.significant


@pytest.mark.parametrize(
    ("leads", "at", "note"),
    [
        ((7.7, 1.4, -4.0, -4.8), 100 * (0.05 + 0.05 * 1.4 / 5.4), "between 0.05 and 0.1"),
        ((3.0, -3.0, -4.0, -5.0), 100 * 0.035, "between 0.02 and 0.05"),
        ((-1.5, -3.0, -4.0, -5.0), math.nan, "concentrating never leads"),
        ((1.5, 3.0, 4.0, 5.0), math.nan, "concentrating never trails"),
        ((0.0, 0.0, 0.0, 0.0), math.nan, "no significant lead"),
        ((3.0, -3.0, 3.0, -3.0), math.nan, "the lead changes more than once"),
    ],
)
def test_the_crossover_is_where_the_lead_changes(leads: tuple[float, ...], at: float, note: str) -> None:
    known = {
        (c.label, "full"): 0.3 + lead / 100
        for rho, lead in zip((0.02, 0.05, 0.1, 0.25), leads, strict=True)
        for c in two(rho)
    }
    got = Crossover(tuple(Contrast(two(r), (all_4(r),)) for r in (0.02, 0.05, 0.1, 0.25))).measure(
        Made(known, noise=0.001)
    )
    assert got.value == pytest.approx(at, nan_ok=True)
    assert got.note == note


def test_the_peak_is_a_budget_in_per_cent() -> None:
    curve = tuple(all_4(rho) for rho in (0.05, 0.1, 1.0))
    assert Peak(curve, "mission").measure(PAPER).value == pytest.approx(10.0)
    nowhere = Peak(curve, "mission").measure(Made({}, lambda c, r: math.nan))
    assert math.isnan(nowhere.value)
    assert nowhere.note == "nothing was there to be found"


def test_matched_bytes_are_compared_at_the_same_budget() -> None:
    assert UnequalBytes(POLICIES).measure(PAPER).value == 0.0
    uneven = Made({}, bytes_of=lambda c: 1e6 * c.received_budget * (0.9 if c.label == "best-2@0.05" else 1.0))
    assert UnequalBytes(POLICIES).measure(uneven).value == pytest.approx(10.0)


def test_a_level_has_an_interval_and_no_test() -> None:
    got = ApOf(FULL_SHARING).measure(PAPER)
    assert got.value == 0.371
    assert got.p is None


def test_unsent_cells_concern_conditions_that_leave_some() -> None:
    assert under(Sharing(0.1), "masked") == Sharing(0.1, unsent="masked")
    assert under(FULL_SHARING, "masked") == FULL_SHARING
    assert under(SINGLE, "masked", "norm") == SINGLE
    assert under(Sharing(0.1), "zero", "norm") == Sharing(0.1, cells_by="norm")
    assert under(Sharing(1.0, "best-2"), "masked").unsent == "masked", "a peer sends all it has, not all is sent"


def test_the_claims_need_few_conditions_and_have_ids_of_their_own() -> None:
    assert len({c.id for c in CLAIMS}) == len(CLAIMS)
    assert len(conditions()) == 23
    assert all(c.unsent == "zero" and c.cells_by == "confidence" and not c.roi for c in conditions())
