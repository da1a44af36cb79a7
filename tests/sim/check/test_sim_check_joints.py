"""What a scenario is held to, part by part: decisions in a window, means over replications, and what a flight of a line keeps of its scenario."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import record_by_hand as by_hand
from policies_examples import fleet_of
from sim_examples import example

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.policies.plane_rules import PlaneRules
from sortie.policies.registry import resolve
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.kit.views import from_json
from sortie.scenarios.schema import DecisionExpectation, Expectation
from sortie.sim.check.checking import Checked
from sortie.sim.check.counterexample import replay_scenario, unused
from sortie.sim.check.discovery import is_scenario
from sortie.sim.check.expectations import Verdict, check
from sortie.sim.check.golden import differences, with_relative_files, write_golden
from sortie.sim.check.junit import Suite, junit
from sortie.sim.check.model_rules import Subject as RuleSubject
from sortie.sim.check.model_rules import conform
from sortie.sim.check.once import Flown, flown_once
from sortie.sim.check.over_time import ClosedLoop, Subject, course_scenario, flights_of


def _record_of_decisions() -> Any:
    """One drone's decisions about two peers: a region at 1 s, none at 2 s."""
    rows = [
        {
            "t_s": t_s, "drone": 2, "peer": peer, "representation": rung, "rate_hz": rate_hz, "roi_radius_m": radius_m,
            "reason": reason,
        }
        for t_s, peer, rung, rate_hz, radius_m, reason in (
            (1.0, 0, "features", 5.0, 32.0, "battery < 60 %"),
            (2.0, 1, "detections", 2.0, math.nan, "goodput 4 < 5 Mb/s"),
        )
    ]  # fmt: skip
    return by_hand.record(tables=by_hand.tables_of({"directives": rows}))


@pytest.mark.parametrize(
    ("wanted", "holds"),
    [
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
    ],
)
def test_one_row_in_the_window_must_have_all_that_is_expected(wanted: dict[str, Any], holds: bool) -> None:
    e = DecisionExpectation(**{"drone": 2, "from_s": 0.0, "until_s": 3.0} | wanted)
    (verdict,) = check(
        example().model_copy(update={"expect": (), "expect_decisions": (e,)}), _record_of_decisions(), {}
    )
    assert verdict.holds is holds
    if not wanted:
        assert verdict.got.startswith("1.00 s: 2 → 0 features")


@pytest.mark.parametrize(
    ("bound", "values", "holds", "shown"),
    [
        # Student's t of two degrees at 90 %, one-sided, is 1.8856: of 4, 5 and 6 the mean is surely above 5 − 1.0887
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
    ],
)
def test_a_mean_is_within_its_bound_by_one_end_of_its_interval(
    bound: dict[str, float], values: list[float], holds: bool, shown: int
) -> None:
    e = Expectation(metric="m", replications=3, confidence=0.9, **bound)
    scenario = example().model_copy(update={"expect": (e,), "expect_decisions": ()})
    (verdict,) = check(scenario, by_hand.record(), {"m": -1.0}, [{"m": v} for v in values])
    assert (verdict.holds, verdict.replication) == (holds, shown)
    assert verdict.got.startswith("5 [")


def test_a_mean_of_too_few_replications_is_none() -> None:
    e = Expectation(metric="m", replications=3, confidence=0.9, at_least=0.0)
    scenario = example().model_copy(update={"expect": (e,), "expect_decisions": ()})
    (verdict,) = check(scenario, by_hand.record(), {}, [{"m": 5.0}, {"m": 5.0}])
    assert (verdict.holds, verdict.got) == (False, "2 replications flown")


@pytest.mark.parametrize(
    ("bounds", "holds"),
    [
        ({"equals": 5.0, "at_most": 9.0}, True),
        ({"equals": 6.0, "at_most": 9.0}, False),  # the bound alone does not make it hold
        ({"equals": 5.0, "at_least": 6.0}, False),
        ({"at_least": 5.0, "at_most": 5.0}, True),
        ({"equals": 500.0, "tolerance": 400.0}, False),
        ({"equals": 5.0 + 1e-10}, True),
    ],
)
def test_every_bound_of_an_expectation_must_hold(bounds: dict[str, float], holds: bool) -> None:
    scenario = example().model_copy(update={"expect": (Expectation(metric="m", **bounds),), "expect_decisions": ()})
    (verdict,) = check(scenario, by_hand.record(), {"m": 5.0})
    assert verdict.holds is holds


def test_a_replay_of_a_verdict_plays_its_own_replication() -> None:
    verdict = Verdict("m ≥ 1", "0", False, "", "m")
    checked = Checked(example(), (verdict,), ("sortie", "fly", "x.yaml", "--set", "a=1"))
    assert checked.replay(verdict) == "sortie fly x.yaml --set a=1 --view"
    assert checked.replay(replace(verdict, replication=3)) == "sortie fly x.yaml --set a=1 --replication 3 --view"


def test_a_report_counts_what_failed_and_what_did_not_fly() -> None:
    good, bad = Verdict("a", "1", True, ""), Verdict("b", "2", False, "why it must")
    checked = Checked(example(), (good, bad, good), ("sortie", "fly", "x"))
    text = junit([Suite("x", checked), Suite("y", None, "no such file")])
    assert '<testsuite name="x" tests="3" failures="1" errors="0">' in text
    assert '<testsuite name="y" tests="1" failures="0" errors="1">' in text
    assert "because: why it must\nsee it: sortie fly x --view" in text
    assert "the record:" not in text


def test_files_that_a_counterexample_would_overwrite_are_passed_by(tmp_path: Path) -> None:
    folder = tmp_path / "new"
    assert unused(folder, "rule") == folder / "rule"
    (folder / "rule.yaml").touch()
    assert unused(folder, "rule") == folder / "rule_2"
    (folder / "rule_2.json").touch()
    assert unused(folder, "rule") == folder / "rule_3"


def test_a_view_with_gaps_in_its_ids_flies_in_a_fleet_that_has_them() -> None:
    view = fleet_of(5)
    view = view._replace(descriptors={i: d for i, d in view.descriptors.items() if i in (0, 4)}, age_s={0: 0.1, 4: 0.1})
    scenario = replay_scenario("r", "", "worked", {}, view, invariant="rate_hz <= 20", raised_age_s={0: 0.1, 4: 2.0})
    assert scenario.fleet.drones == 5
    assert scenario.policy.invariants == "rate_hz <= 20"
    first, second = scenario.policy.replays
    assert (first.at_s, second.at_s) == pytest.approx((5 * view.period_s, 6 * view.period_s))
    assert from_json(first.view).age_s == {0: 0.1, 4: 0.1}
    assert from_json(second.view).age_s == {0: 0.1, 4: 2.0}


def _subject() -> Subject:
    return Subject(resolve("worked"), "worked", {"rho": 0.1})


def test_flights_of_a_line_are_the_scenario_then_other_seeds_with_more_links_that_drop() -> None:
    scenario = example("seed=7", "events=[{kind: drone_lost, at_s: 1, drone: 1}]", "context.rate_hz=5")
    (rule,) = parse("within 1 s: rate_hz > 0")
    own, *others = flights_of(_subject(), rule, scenario, 5)
    assert own.events == scenario.events
    assert own.seed == 7
    assert [flown.seed for flown in others] == [8, 9, 10, 11]
    for flown in (own, *others):
        assert (flown.policy.name, flown.policy.params, flown.policy.invariants) == ("worked", {"rho": 0.1}, rule.text)
        assert flown.events[0] == scenario.events[0]
        assert flown.context.rate_hz == 5
        assert all(e.kind == "link_drop" and e.at_s < e.until_s for e in flown.events[1:])
    drops = [flown.events[1:] for flown in others]
    assert all(1 <= len(each) <= 3 for each in drops)
    assert len(set(drops)) == len(drops), "each flight has draws of its own"


def test_a_course_is_shown_under_the_plane_of_its_scenario() -> None:
    sets = ["policy.dwell_s=0.7", "context.publish_every=2", "context.degraded_after_periods=4", "context.rate_hz=5"]
    base = example(*sets, "context.detached_after_periods=12", "policy.shield=true", "policy.invariants=rate_hz <= 20")
    (rule,) = parse("rate_hz <= 10")
    shown = course_scenario(_subject(), rule, "", base, [fleet_of(3), fleet_of(3)])
    for name in ("rate_hz", "publish_every", "degraded_after_periods", "detached_after_periods"):
        assert getattr(shown.context, name) == getattr(base.context, name)
    assert (shown.policy.dwell_s, shown.policy.shield) == (0.7, True)
    assert shown.duration_s == pytest.approx(2.5 * 0.2)
    assert [(r.at_s, r.drone, r.read_by) for r in shown.policy.replays] == [(0.0, 0, "drone"), (0.2, 0, "drone")]


def test_scenarios_of_one_name_in_two_folders_do_not_share_verdicts(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    one, other = (Flown(error=e) for e in ("one", "other"))
    assert flown_once(shared, tmp_path / "a" / "x.yaml", lambda: one) == one
    assert flown_once(shared, tmp_path / "b" / "x.yaml", lambda: other) == other
    assert flown_once(shared, tmp_path / "a" / "x.yaml", lambda: other) == one


def test_a_golden_outcome_tells_what_is_gone_what_is_new_and_what_moved(tmp_path: Path) -> None:
    path = tmp_path / "x.golden.json"
    write_golden(path, {"kept": 1.0, "gone": 2, "moved": 3.0, "near_zero": 0.0, "word": "a", "wall_s": 1})
    now = {"kept": 1.0 + 1e-8, "new": {"x": [4]}, "moved": 3.1, "near_zero": 1e-10, "word": "a", "wall_s": 2}
    assert differences(path, now) == {
        "gone": (2, "nothing"), "moved": (3.0, 3.1), "new.x.0": ("nothing", 4),
    }  # fmt: skip


def test_a_file_whose_name_begins_with_another_file_s_name_is_renamed_whole(tmp_path: Path, monkeypatch: Any) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for name in ("a.py", "a.py.txt"):
        Path(name).touch()
    given = {"own_files": {"a.py": "1", "a.py.txt": "2"}, "policy": "a.py:decide", "n": 3}
    assert with_relative_files(tmp_path, given, ["a.py", "a.py.txt", "not_there.py"]) == {
        "own_files": {"here/a.py": "1", "here/a.py.txt": "2"},
        "policy": "here/a.py:decide",
        "n": 3,
    }
    Path("b").mkdir()
    Path("c.py").touch()
    assert with_relative_files(tmp_path, {"x": "b", "y": "b/../c.py"}, ["b", "b/../c.py"]) == {
        "x": "here/b",
        "y": "here/c.py",
    }


def test_a_period_is_that_of_publishing_and_a_frame_that_of_deciding() -> None:
    times = PlaneRules.of(example("context.rate_hz=5", "context.publish_every=3"))
    assert (times.period_s, times.descriptor_period_s) == pytest.approx((0.2, 0.6))


@pytest.mark.parametrize(("age_s", "cause"), [(0.1, "policy"), (5.0, "staleness")])
def test_the_step_that_breaks_a_line_is_named_in_a_closed_loop_too(age_s: float, cause: str) -> None:
    """A policy that sends at 5 Hz, and where its peer's descriptor is too old nothing is sent."""
    times = PlaneRules(0.1, 100, 3.0, 10.0, 0.0, 0.0)
    line = "rate_hz <= 4" if cause == "policy" else "rate_hz >= 4"

    def policy(view: FleetView) -> list[Directive]:
        return [Directive(view.ego, p, Representation.DETECTIONS, rate_hz=5.0, reason="r") for p in view.peers]

    loop = ClosedLoop(policy, parse(line), times)
    view = fleet_of(2)._replace(age_s={0: 0.1, 1: age_s})
    assert [v.cause for v in loop.step(view, 0.0)] == [cause]


def test_a_scenario_is_of_a_run_where_its_outcome_lies_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "scenario.yaml"
    path.write_text("name: x\nexpect: []\n")
    assert is_scenario(path)
    (tmp_path / "record.json").touch()
    assert is_scenario(path)
    (tmp_path / "outcome.json").touch()
    assert not is_scenario(path)


def test_a_model_that_draws_when_it_is_loaded_gives_another_answer_when_it_is_loaded_anew() -> None:
    numbers = iter(range(100))

    def load() -> RuleSubject:
        drawn = next(numbers)
        return RuleSubject(lambda case: drawn, {"a": 0, "b": 1})

    verdicts = {check.name: check.verdict for check in conform(load)}
    assert verdicts == {"answers": "holds", "same answer again": "fails", "no memory": "holds"}
