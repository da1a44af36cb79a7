"""What an outcome is held to: bounds, tolerances, means over replications, and decisions in a window."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import record_by_hand as by_hand
from scipy import stats
from sim_examples import example

from sortie.policies.contract import PolicyError
from sortie.scenarios.intervals import mean_interval
from sortie.scenarios.reading.load import library, load
from sortie.scenarios.schema import DecisionExpectation, Expectation
from sortie.sim.check.checking import check_scenario, flights
from sortie.sim.check.expectations import Verdict, check
from sortie.sim.check.named import not_there
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import OutcomeDict, outcome


def judged(
    expectation: Expectation | DecisionExpectation,
    result: dict[str, Any],
    replications: list[dict[str, Any]] | None = None,
    record: Any = None,
) -> Verdict:
    """The verdict of one expectation."""
    of_decisions = isinstance(expectation, DecisionExpectation)
    held = {
        "expect": () if of_decisions else (expectation,),
        "expect_decisions": (expectation,) if of_decisions else (),
    }
    scenario = example().model_copy(update=held)
    (verdict,) = check(
        scenario, record or by_hand.record(), OutcomeDict(result), [*map(OutcomeDict, replications or ())]
    )
    return verdict


BOUNDS: list[tuple[dict[str, Any], bool]] = [
    ({"equals": 5.0, "at_most": 9.0}, True),
    ({"equals": 6.0, "at_most": 9.0}, False),  # the bound alone does not make it hold
    ({"equals": 5.0, "at_least": 6.0}, False),
    ({"at_least": 5.0, "at_most": 5.0}, True),
    ({"equals": 500.0, "tolerance": 400.0}, False),
    ({"equals": 5.0 + 1e-10}, True),
    ({"at_least": 5.2, "tolerance": 0.3}, True),
    ({"at_least": 5.4, "tolerance": 0.3}, False),
    ({"at_most": 4.8, "tolerance": 0.3}, True),
    ({"at_most": 4.8, "tolerance": 0.1}, False),
    ({"equals": 4.9, "tolerance": 0.2}, True),
    ({"equals": 4.9, "tolerance": 0.05}, False),
]


def test_every_bound_of_an_expectation_must_hold() -> None:
    got = [(bounds, judged(Expectation(metric="m", **bounds), {"m": 5.0}).holds) for bounds, _ in BOUNDS]
    assert got == BOUNDS


TRUTHS: list[tuple[str, dict[str, Any], bool]] = [
    ("drones.0.airborne", {"equals": True}, True),
    ("drones.0.airborne", {"equals": 1.0}, False),
    ("replication", {"equals": 0.0}, True),
    ("replication", {"equals": False}, False),
    ("scenario", {"equals": "by_hand"}, True),
    ("duration_s", {"equals": "4.0"}, False),
    ("duration_s", {"equals": 4.0}, True),
    ("payload_fates.lost/no_link", {"at_most": 0}, True),
    ("descriptor_drops.forged", {"at_most": 0}, True),
    ("distrusted_by.0", {"at_most": 0}, True),
    ("payload_fates.lost/no_lnk", {"at_most": 0}, False),
    ("distrusted_by.99", {"at_most": 0}, False),
    ("policies.decisions.other", {"at_most": 0}, False),
]


def test_a_truth_is_no_number_and_nothing_of_a_known_kind_is_a_count_of_zero() -> None:
    result = outcome(by_hand.record())
    got = [(metric, held, judged(Expectation(metric=metric, **held), result).holds) for metric, held, _ in TRUTHS]
    assert got == TRUTHS


def decisions() -> Any:
    """One drone's decisions about two peers: a region at 1 s, none at 2 s."""
    names = ("t_s", "peer", "representation", "rate_hz", "roi_radius_m", "reason")
    rows = [
        (1.0, 0, "features", 5.0, 32.0, "battery < 60 %"),
        (2.0, 1, "detections", 2.0, math.nan, "goodput 4 < 5 Mb/s"),
    ]
    made = [{"drone": 2, **dict(zip(names, row, strict=True))} for row in rows]
    return by_hand.record(tables=by_hand.tables_of({"directives": made}))


DECIDED: list[tuple[dict[str, Any], bool]] = [
    ({}, True),
    ({"drone": 1}, False),
    ({"from_s": 2.0, "until_s": 2.0}, True),
    ({"from_s": 2.1, "until_s": 3.0}, False),
    ({"from_s": 0.0, "until_s": 1.0}, True),
    ({"from_s": 0.0, "until_s": 0.9}, False),
    ({"peer": 1}, True),
    ({"peer": 3}, False),
    ({"peer": 1, "representation": "features"}, False),
    ({"peer": 1, "representation": "detections"}, True),
    ({"rate_at_most_hz": 2.0}, True),
    ({"rate_at_most_hz": 1.9}, False),
    ({"peer": 0, "roi": True}, True),
    ({"peer": 0, "roi": False}, False),
    ({"peer": 1, "roi": False}, True),
    ({"peer": 1, "roi": True}, False),
    ({"reason": "battery"}, True),
    ({"peer": 1, "reason": "battery"}, False),
    ({"representation": "features", "rate_at_most_hz": 5.0, "roi": True, "reason": "60 %"}, True),
    ({"representation": "features", "rate_at_most_hz": 2.0}, False),  # each holds of a row, of no row both
]


def test_one_row_in_the_window_must_have_all_that_is_expected() -> None:
    record, window = decisions(), {"drone": 2, "from_s": 0.0, "until_s": 3.0}
    got = [(asked, judged(DecisionExpectation(**(window | asked)), {}, record=record).holds) for asked, _ in DECIDED]
    assert got == DECIDED
    assert judged(DecisionExpectation(**window), {}, record=record).got.startswith("1.00 s: 2 → 0 features")


def test_changes_of_links_are_counted_and_no_others_may_be_beside_them() -> None:
    """By hand: a directive that is repeated and a disc that moves are no changes, and links count one by one."""
    names = ("t_s", "drone", "peer", "representation", "rho", "rate_hz", "roi_radius_m", "reason")
    rows = [
        (1.0, 2, 0, "features", 0.1, 10.0, math.nan, "battery ≥ 60 %"),
        (1.0, 2, 1, "features", 0.1, 10.0, math.nan, "battery ≥ 60 %"),
        (1.5, 2, 1, "features", 0.1, 10.0, math.nan, "repeated"),
        (2.0, 3, 1, "none", 0.0, 0.0, math.nan, "says nothing, as before"),
        (2.0, 2, 1, "features", 0.1, 10.0, 32.0, "track"),
        (2.1, 2, 1, "features", 0.1, 10.0, 32.0, "the disc has moved"),
        (3.0, 3, 1, "detections", 0.0, 2.0, math.nan, "goodput 4 < 5 Mb/s"),
    ]
    made = [dict(zip(names, row, strict=True)) for row in rows]
    record = by_hand.record(tables=by_hand.tables_of({"directives": made}))
    window = {"from_s": 0.0, "until_s": 3.0}
    counted: list[tuple[dict[str, Any], bool]] = [
        ({"changes": 4}, True),
        ({"changes": 3}, False),
        ({"changes": 5}, False),
        ({"drone": 2, "changes": 3}, True),
        ({"drone": 2, "peer": 1, "changes": 2}, True),
        ({"drone": 2, "roi": False, "changes": 2}, True),
        ({"roi": True, "changes": 1}, True),
        ({"representation": "none", "changes": 0}, True),
        ({"from_s": 1.1, "changes": 2}, True),
        ({"reason": "repeated", "changes": 0}, True),
        ({"reason": "repeated"}, True),  # it was decided, and changed nothing
    ]
    got = [(asked, judged(DecisionExpectation(**(window | asked)), {}, record=record).holds) for asked, _ in counted]
    assert got == counted

    def others(*expected: dict[str, Any]) -> str:
        held = tuple(DecisionExpectation(**(window | each)) for each in expected)
        scenario = example().model_copy(update={"expect_decisions": held, "expect_no_other_changes": True})
        *_, verdict = check(scenario.model_copy(update={"expect": ()}), record, OutcomeDict())
        assert verdict.holds == verdict.got.startswith("0 others")
        return verdict.got

    assert others({}) == others({"drone": 2}, {"reason": "goodput"}) == "0 others"
    assert others({"drone": 2}).startswith("1 other; 3.00 s: 3 → 1 detections")
    assert others({"drone": 2, "until_s": 2.5}, {"drone": 3, "until_s": 2.5}).startswith("1 other; 3.00 s")
    assert others().startswith("4 others; 1.00 s: 2 → 0 features")


# Student's t of two degrees at 90 %, one-sided, is 1.8856: of 4, 5 and 6 the mean is surely above 5 − 1.0887
MEANS: list[tuple[dict[str, float], list[float], bool, int]] = [
    ({"at_least": 3.90}, [4.0, 5.0, 6.0], True, 0),
    ({"at_least": 3.93}, [4.0, 5.0, 6.0], False, 0),
    ({"at_most": 6.10}, [4.0, 5.0, 6.0], True, 0),
    ({"at_most": 6.07}, [4.0, 5.0, 6.0], False, 2),
    ({"at_least": 4.00, "tolerance": 0.1}, [4.0, 5.0, 6.0], True, 0),
    ({"at_most": 6.00, "tolerance": 0.1}, [4.0, 5.0, 6.0], True, 0),
    ({"at_most": 6.00, "tolerance": 0.05}, [4.0, 6.0, 5.0], False, 1),
    ({"at_least": 4.50}, [6.0, 5.0, 4.0], False, 2),
    ({"at_least": 3.90, "at_most": 6.10}, [4.0, 5.0, 6.0], True, 0),
    ({"at_least": 3.90}, [4.0, 5.0, 6.0, -90.0], True, 0),  # more were flown for another expectation
    ({"at_least": 5.0}, [5.0, 5.0, 5.0], True, 0),
]


def of_three(**bounds: float) -> Expectation:
    return Expectation(metric="m", replications=3, confidence=0.9, **bounds)


def test_a_mean_is_within_its_bound_by_one_end_of_its_interval() -> None:
    wrong = {}
    for bound, values, holds, shown in MEANS:
        verdict = judged(of_three(**bound), {"m": -1.0}, [{"m": v} for v in values])
        if (verdict.holds, verdict.replication) != (holds, shown) or not verdict.got.startswith("5"):
            wrong[str(bound), str(values)] = verdict
    assert wrong == {}
    assert judged(of_three(at_least=5.0), {}, [{"m": 5.0}] * 3).expected == "m ≥ 5 with 90 % over 3"


def test_a_mean_of_too_few_replications_or_of_one_without_the_metric_is_none() -> None:
    for metric, replications, got in (
        ("m", [{"m": 5.0}] * 2, "2 replications flown"),
        ("m", [{"m": 6.0}, {"m": None}, {"m": 6.0}], "replication 1: None, no number"),
        ("n", [{"m": 6.0}] * 3, "replication 0: n: "),
    ):
        asked = of_three(at_least=0.0).model_copy(update={"metric": metric})
        verdict = judged(asked, {}, replications)
        assert not verdict.holds
        assert verdict.got.startswith(got)


def test_the_limit_is_students() -> None:
    values = np.random.default_rng(1).normal(3, 2, 12)
    low = stats.ttest_1samp(values, 0, alternative="greater").confidence_interval(0.95).low
    for bound, holds in ((low - 1e-6, True), (low + 1e-6, False)):
        asked = Expectation(metric="m", at_least=bound, replications=12, confidence=0.95)
        verdict = judged(asked, {}, [{"m": v} for v in values.tolist()])
        assert verdict.holds is holds
        assert verdict.got.startswith(f"{values.mean():.6g} [{low:.6g}, ")


@pytest.mark.slow
def test_a_mean_at_its_bound_is_called_shown_as_seldom_as_asked() -> None:
    """With a true mean of 0 the expectation `≥ 0 with 90 %` is wrongly called held in 10 % of cases, within 3 σ."""
    rng, cases = np.random.default_rng(2), 4000
    held = sum(mean_interval(rng.normal(0, 1, 8), level=0.8).low >= 0 for _ in range(cases))
    assert abs(held / cases - 0.1) < 3 * math.sqrt(0.09 / cases)


def test_of_a_time_that_was_not_flown_nothing_is_held_to_be_so() -> None:
    """Missions may be flown shortened: the phase at 3 s is not in the outcome, and no bound on it holds for that."""
    late = "{metric: phases.1.data_rate_mbps, at_most: 1.0e9}"
    scenario = example("duration_s=0.5", f"expect=[{late}]", "expect_decisions=[{drone: 0, from_s: 3, until_s: 4}]")
    record = run_sortie(scenario)
    assert [(v.holds, v.got) for v in check(scenario, record, outcome(record))] == [
        (False, "phases.1.data_rate_mbps: phases has no '1', it has 0 … 0"),
        (False, "no decision"),
    ]


OVER: list[tuple[dict[str, Any], list[float], list[float], bool, str]] = [
    ({"at_least": 0.1}, [0.5], [0.3], True, "0.2 (0.5, 0.3 under silence)"),
    ({"at_least": 0.1}, [0.5], [0.5], False, "0 (0.5, 0.5 under silence)"),
    ({"at_most": -0.1}, [0.3], [0.5], True, "-0.2 (0.3, 0.5 under silence)"),
    ({"at_least": 0.1}, [0.5], [], False, "silence not flown"),
    # the differences are alike where the values are not: only pairs show it
    (
        {"at_least": 1.0, "replications": 3, "confidence": 0.9},
        [9.0, 5.0, 1.0],
        [8.0, 4.0, 0.0],
        True,
        "1 (all equal) over 3",
    ),
    (
        {"at_least": 1.1, "replications": 3, "confidence": 0.9},
        [9.0, 5.0, 1.0],
        [8.0, 4.0, 0.0],
        False,
        "1 (all equal) over 3",
    ),
]


def test_a_bound_over_another_policy_is_of_the_difference_within_pairs() -> None:
    wrong = []
    for bound, own, other, holds, got in OVER:
        scenario = example().model_copy(update={"expect": (Expectation(metric="m", over="silence", **bound),)})
        results, theirs = ([OutcomeDict({"m": value}) for value in values] for values in (own, other))
        (verdict,) = check(scenario, by_hand.record(), results[0], results, {"silence": theirs})
        if verdict.holds is not holds or not verdict.got.startswith(got):
            wrong.append((bound, verdict))
    assert wrong == []


def test_silence_fails_each_paired_expectation_of_the_library() -> None:
    """Silence minus silence is 0 of every metric."""
    paired = {name: [e for e in load(name).expect if e.over is not None] for name in library()}
    zero = [OutcomeDict({"value": 0.0})]
    held = [
        (name, e.metric)
        for name, expectations in paired.items()
        for e in expectations
        if judged_over(e.model_copy(update={"metric": "value", "replications": None}), zero).holds
    ]
    assert held == []
    assert {name for name, each in paired.items() if each} == {
        "person_crossing",
        "track_target",
        "two_groups",
        "two_makes",
    }


def judged_over(expectation: Expectation, results: list[OutcomeDict]) -> Verdict:
    """The verdict of an expectation where both policies came to the same."""
    scenario = example().model_copy(update={"expect": (expectation,)})
    (verdict,) = check(scenario, by_hand.record(), results[0], results, {str(expectation.over): results})
    return verdict


def test_a_check_flies_the_other_policy_once_and_refuses_an_unknown_one(tmp_path: Path) -> None:
    head = "name: mine\nduration_s: 2\nperception: {detector: none}\nexpect:\n"
    sent = "  - {metric: bytes.data_sent, over: silence, at_least: 1}\n"
    path = tmp_path / "mine.yaml"
    for policy, lines, holds in (
        ("worked", sent * 2, [True, True]),
        ("silence", sent, [False]),
        ("worked", sent.replace("1}", "1, replications: 2, confidence: 0.9}"), [True]),
    ):
        path.write_text(head + lines, "utf-8")
        times: list[float] = []
        checked = check_scenario(str(path), [f"policy.name={policy}"], progress=times.append)
        assert [v.holds for v in checked.verdicts] == holds
        assert flights(checked.scenario) == (4 if "replications" in lines else 2)
        assert times == sorted(times)
        assert flights(checked.scenario) * 2 - 2 <= times[-1] <= flights(checked.scenario) * 2
    path.write_text(head + sent.replace("silence", "silnce"), "utf-8")
    assert not_there(load(str(path)))[0].startswith("expect.0.over: unknown policy 'silnce', did you mean silence?")
    with pytest.raises(PolicyError, match="did you mean silence"):
        check_scenario(str(path))
