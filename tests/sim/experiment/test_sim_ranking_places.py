"""Places of a ranking by closed forms and drawn rankings, and the figures of a standing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from sortie.scenarios.intervals import SHARE, Estimate
from sortie.scenarios.schema.conditions import ConditionSet
from sortie.sim.experiment import rank
from sortie.sim.experiment.board import _spread
from sortie.sim.experiment.flight import Flight
from sortie.sim.experiment.places import (
    METRICS,
    Control,
    PairDifference,
    Scored,
    differences,
    places,
    scores,
    standings,
)
from sortie.sim.experiment.rank import FURTHER, SUITE, _further
from sortie.sim.folders import RunError


def suite_of(count: int, metric: str = "full_scene") -> ConditionSet:
    conditions = [{"name": f"c{k}", "budget": 0.1, "metric": metric} for k in range(count)]
    return ConditionSet.model_validate({"base": "track_target", "seeds": (), "conditions": tuple(conditions)})


def flights_of(aps: Mapping[str, list[float | None]], metric: str = "full_scene") -> dict[str, dict[str, Flight]]:
    """Flights with these APs; NaN is a failure."""

    def flight(ap: float | None) -> Flight:
        failed = ap is not None and math.isnan(ap)
        values = dict.fromkeys(METRICS) | {f"ap50.{metric}": None if failed else ap}
        return Flight("boom" if failed else "", "", values)

    return {policy: {f"c{k}": flight(ap) for k, ap in enumerate(values)} for policy, values in aps.items()}


def test_places_are_ranges_where_the_intervals_do_not_separate() -> None:
    rng = np.random.default_rng(0)
    base = 0.4 + 0.1 * rng.random(30)
    near = base - 0.001 + 0.02 * rng.standard_normal(30)
    far = base - 0.2 + 0.02 * rng.standard_normal(30)
    rows, pairs = standings(suite_of(30), flights_of({"far": list(far), "best": list(base), "near": list(near)}))
    assert {r.policy: r.place for r in rows} == {"best": (1, 2), "near": (1, 2), "far": (3, 3)}
    assert rows[-1].policy == "far"
    assert len(pairs) == 3
    alike = base.tolist()
    rows, _ = standings(suite_of(30), flights_of({"a": alike, "b": alike}))
    assert [r.place for r in rows] == [(1, 2), (1, 2)], "equal policies share their places"


def test_intervals_of_pairs_are_students_corrected_for_their_number() -> None:
    rng = np.random.default_rng(1)
    aps = {p: 0.4 + 0.01 * rng.standard_normal(20) for p in "abcd"}
    pair = differences({p: Scored(a, np.zeros(0)) for p, a in aps.items()})[0]
    d = aps["a"] - aps["b"]
    off = stats.t.ppf(1 - 0.05 / 6 / 2, 19) * d.std(ddof=1) / math.sqrt(20)
    assert pair.difference.mean == pytest.approx(d.mean())
    width = pair.difference.high - pair.difference.low  # one of six pairs; the scale is flat here
    assert width == pytest.approx(2 * off, rel=1e-3)


def test_a_failure_is_last_in_its_condition_and_loses_nothing_else() -> None:
    aps = {"fails": [0.5, math.nan, 0.5], "flies": [0.4, 0.1, 0.4]}
    scored = scores(suite_of(3), flights_of(aps))
    assert scored["fails"].ap.tolist() == [0.5, 0.0, 0.5]
    rows, _ = standings(suite_of(3), flights_of(aps))
    failed = next(r for r in rows if r.policy == "fails")
    assert failed.failed == ("c1",)
    assert (failed.figures["ap50.full_scene"].mean, failed.figures["ap50.full_scene"].count) == (0.5, 2)


def test_a_condition_without_a_car_counts_for_nobody() -> None:
    scored = scores(suite_of(2), flights_of({"a": [0.5, None], "b": [0.4, 0.9]}))
    assert {p: s.ap.tolist() for p, s in scored.items()} == {"a": [0.5], "b": [0.4]}
    with pytest.raises(RunError, match="no condition has an accuracy"):
        scores(suite_of(1), flights_of({"a": [None]}))


def test_the_condition_says_which_ap_counts() -> None:
    aps = {"a": [0.5, 0.6]}
    assert scores(suite_of(2, "mission"), flights_of(aps, "mission"))["a"].ap.tolist() == [0.5, 0.6]
    with pytest.raises(RunError):
        scores(suite_of(2, "mission"), flights_of(aps, "full_scene"))


def test_true_places_lie_within_their_ranges_as_often_as_is_said() -> None:
    """Drawn rankings of five policies with known means: all ranges hold at once in at least 95 % of them."""
    rng, means, held = np.random.default_rng(2), np.array([0.4, 0.41, 0.42, 0.45, 0.5]), 0
    for _ in range(200):
        aps = means[:, None] + 0.03 * rng.standard_normal((5, 30))
        scored = {p: Scored(a, np.zeros(0)) for p, a in zip("abcde", aps, strict=True)}
        found = places("abcde", differences(scored))
        held += all(found[p][0] <= 5 - k <= found[p][1] for k, p in enumerate("abcde"))
    assert held >= 190


@pytest.mark.slow
def test_the_surrogate_narrows_intervals_and_its_errors_shift_nothing() -> None:
    """200 rankings of two policies that torch finds equal, over 30 conditions and 90 further ones; the surrogate
    favours one of them by 0.2."""
    rng, differences_, narrower, held = np.random.default_rng(3), [], 0, 0
    for _ in range(200):
        condition = 0.1 * rng.standard_normal((2, 120)) + 0.5
        torch = condition[:, :30] + 0.02 * rng.standard_normal((2, 30))
        cheap = condition + 0.02 * rng.standard_normal((2, 120)) + np.array([[0.2], [0.0]])
        flights_, control = (flights_of(dict(zip("ab", map(list, aps), strict=True))) for aps in (torch, cheap))
        rows, (pair,) = standings(suite_of(30), flights_, Control(suite_of(120), control))
        (alone,) = standings(suite_of(30), flights_)[1]
        differences_.append(pair.difference.mean)
        narrower += pair.difference.half_width < alone.difference.half_width
        held += pair.difference.low <= 0.0 <= pair.difference.high
    error = np.std(differences_, ddof=1) / math.sqrt(200)
    assert abs(np.mean(differences_)) < 3 * error, "0.2 without the correction"
    assert narrower >= 190
    assert held >= 182, "95 % of 200, less 2.6 standard errors"
    assert {r.policy for r in rows} == {"a", "b"}


def test_the_surrogates_flights_are_of_the_same_conditions_as_torchs() -> None:
    """Torch's AP is twice the surrogate's: so is the mean over all conditions, if those without a car go in pairs."""
    cheap = [0.1, 0.2, 0.3, 0.15, 0.25, 0.35, 0.3, None, 0.2]
    torch: list[float | None] = [2 * v for v in (0.1, 0.2, 0.3)] + [None] + [2 * v for v in (0.25, 0.35)]
    scored = scores(suite_of(6), flights_of({"a": torch}), Control(suite_of(9), flights_of({"a": cheap})))["a"]
    assert len(scored.ap) == 5
    found = scored.mean(SHARE)
    assert found.mean == pytest.approx(2 * np.mean([0.1, 0.2, 0.3, 0.25, 0.35, 0.3, 0.2]))
    assert found.count == 5


def test_the_sign_of_a_pair_turns_with_it() -> None:
    pair = PairDifference("a", "b", Estimate(0.2, 0.1, 0.3, 30))
    ranked = SimpleNamespace(pairs=[pair], rows=[SimpleNamespace(policy="a"), SimpleNamespace(policy="b")])
    turned = rank.Ranked.against(ranked, "b")["a"]  # type: ignore[arg-type]
    assert (turned.sign, turned.difference) == (-1, Estimate(-0.2, -0.3, -0.1, 30))
    assert rank.Ranked.against(ranked, "a")["b"].sign == 1  # type: ignore[arg-type]


def test_a_difference_subtracts_the_surrogate_s_own_difference_too() -> None:
    a = Scored(np.array([0.5, 0.7]), np.array([0.4, 0.6, 0.2]))
    b = Scored(np.array([0.1, 0.4]), np.array([0.1, 0.1, 0.1]))
    off = a.minus(b)
    assert (off.ap.tolist(), off.surrogate.tolist()) == (pytest.approx([0.4, 0.3]), pytest.approx([0.3, 0.5, 0.1]))
    assert [(p.policy, p.other) for p in differences({"x": a, "y": b, "z": a})] == [("x", "y"), ("x", "z"), ("y", "z")]


def test_widths_are_compared_pair_by_pair() -> None:
    def pairs(*reach: float) -> list[PairDifference]:
        return [PairDifference("a", "b", Estimate(0.1, 0.1 - r, 0.1 + r, 9)) for r in reach]

    assert rank._width(pairs(0.1, 0.3, 0.2), pairs(0.2, 0.3, 0.1)) == pytest.approx(1.0)
    assert rank._width(pairs(0.1, 0.3), pairs(0.4, 0.0)) == pytest.approx(0.25)
    assert rank._width([], []) == 1.0


def test_as_many_draws_are_further_ones_as_are_asked_for_also_none() -> None:
    assert _further(SUITE, 0) == []
    assert len(_further(SUITE, 2)) == 60
    assert len(_further(SUITE, None)) == 30 * FURTHER
    assert _further("mine.yaml", None) == _further("mine.yaml", 0) == []
    with pytest.raises(RunError, match=r"--further 2: --suite mine.yaml has 0 further draws"):
        _further("mine.yaml", 2)
    with pytest.raises(RunError, match="--further 11: --suite ranking_v1 has 10 further draws"):
        _further(SUITE, 11)


def test_labels_stand_apart_and_within_the_axes() -> None:
    """What would be pushed below the axes goes up again."""
    for heights, labels in (
        ([0.9, 0.5, 0.1], [0.9, 0.5, 0.1]),
        ([0.5, 0.49, 0.48], [0.5, 0.4, 0.3]),
        ([0.9, 0.05, 0.02], [0.9, 0.1, 0.0]),
        ([], []),
    ):
        assert _spread(heights, 0.1) == pytest.approx(labels)
