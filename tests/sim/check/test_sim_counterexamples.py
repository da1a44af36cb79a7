"""What a verdict about a policy keeps of its scenario: counterexamples, flights and courses of a line, model rules."""

from __future__ import annotations

from pathlib import Path

import pytest
from policies_examples import fleet_of
from sim_examples import example

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.policies.plane_rules import PlaneRules
from sortie.policies.registry import resolve
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.kit.views import from_json
from sortie.sim.check.counterexample import replay_scenario, unused
from sortie.sim.check.model_rules import Subject as RuleSubject
from sortie.sim.check.model_rules import conform
from sortie.sim.check.over_time import ClosedLoop, Subject, course_scenario, flights_of


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


def test_a_period_is_that_of_publishing_and_a_frame_that_of_deciding() -> None:
    times = PlaneRules.of(example("context.rate_hz=5", "context.publish_every=3"))
    assert (times.period_s, times.descriptor_period_s) == pytest.approx((0.2, 0.6))


def test_the_step_that_breaks_a_line_is_named_in_a_closed_loop_too() -> None:
    """A policy that sends at 5 Hz, and where its peer's descriptor is too old nothing is sent."""
    times = PlaneRules(0.1, 100, 3.0, 10.0, 0.0, 0.0)

    def policy(view: FleetView) -> list[Directive]:
        return [Directive(view.ego, p, Representation.DETECTIONS, rate_hz=5.0, reason="r") for p in view.peers]

    for age_s, line, cause in ((0.1, "rate_hz <= 4", "policy"), (5.0, "rate_hz >= 4", "staleness")):
        view = fleet_of(2)._replace(age_s={0: 0.1, 1: age_s})
        assert [v.cause for v in ClosedLoop(policy, parse(line), times).step(view, 0.0)] == [cause]


def test_a_model_that_draws_when_it_is_loaded_gives_another_answer_when_it_is_loaded_anew() -> None:
    numbers = iter(range(100))

    def load() -> RuleSubject:
        drawn = next(numbers)
        return RuleSubject(lambda case: drawn, {"a": 0, "b": 1})

    verdicts = {check.name: check.verdict for check in conform(load)}
    assert verdicts == {"answers": "holds", "same answer again": "fails", "no memory": "holds"}
