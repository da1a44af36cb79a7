"""Lines about time over the closed loop: courses against flights, searches, counterexamples that fly, and proofs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sortie.policies.contract import Directive, FleetView, PolicyError, Representation
from sortie.policies.plane_rules import PlaneRules
from sortie.policies.registry import resolve
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.kit.courses import Course, draw_course, values_at
from sortie.policies.verification.subject import constants_of
from sortie.scenarios.reading.load import loads
from sortie.sim.check import over_time
from sortie.sim.check.few_states import NotFinite, prove_over_time
from sortie.sim.check.over_time import ClosedLoop, Subject, course_scenario, flights_of, judge_over_time
from sortie.sim.engine.sortie import run_sortie

pytestmark = pytest.mark.slow

TIMES = PlaneRules(0.1, 100, 3.0, 10.0, 0.4, 0.0)
STILL = Course(3, 30, 0.1, 0.1, 10.0, {})
POLICIES = """
from sortie import Directive, Representation, TaskPhase

def send(view, rate_hz):
    rung = Representation.DETECTIONS if rate_hz else Representation.NONE
    return [Directive(view.ego, p, rung, rate_hz=rate_hz, reason="r") for p in view.peers]

def two_rates(view):
    return send(view, 2.0 if view.me is not None and view.me.battery_soc < 0.3 else 5.0)

def silent_when_tired(view):
    return send(view, 0.0 if view.me is not None and view.me.battery_soc < 0.123 else 5.0)

def by_charge(view):
    return send(view, 30.0 * view.me.battery_soc if view.me is not None else 0.0)

def hasty(view):
    me = view.me
    late_s = 0.1 if me is not None and me.task_phase == TaskPhase.TRACK else 0.2
    return [d._replace(deadline_s=late_s) for d in send(view, 2.0)]

def within(view, region_of):
    me = view.me
    if me is None or any(view.descriptors[i].region is None for i in view.descriptors):
        return send(view, 0.0)
    return [d._replace(roi=region_of(d.destination)) for d in send(view, 2.0)]

def own_region(view):
    return within(view, lambda peer: view.me.region)

def one_of_two_regions(view):
    searching = view.me is not None and view.me.task_phase == TaskPhase.SEARCH
    return within(view, lambda peer: view.me.region if searching else view.descriptors[peer].region)

def moved_region(view):
    far_m = 100.0 if view.me is not None and view.me.task_phase == TaskPhase.TRACK else 0.0
    return within(view, lambda peer: view.me.region._replace(x_m=view.me.region.x_m + far_m))

def flips(view):
    return send(view, 0.0 if any(view.me.goodput_to(p) < 33.0 for p in view.peers) else 5.0)

def by_a_flag(view):
    return send(view, {0: 2.0}[view.me.novelty_flags & 1])

def too_fast_by_a_flag(view):
    return send(view, 31.0 if view.me.novelty_flags & 1 else 2.0)
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("policies") / "mine.py"
    path.write_text(POLICIES)
    return path


COURSES = [("worked", False, 0), ("worked", True, 1), ("worked", False, 2), ("adaptive", False, 0)]


@pytest.mark.parametrize(("policy", "shield", "number"), COURSES)
def test_a_flight_of_a_course_enforces_what_the_loop_enforces(policy: str, shield: bool, number: int) -> None:
    decide, (rule,) = resolve(policy), parse("when human: within 0.3 s: any_link(rate_hz >= 5)")
    base = loads("name: base", overrides=["policy.dwell_s=0.4"])
    base = base.model_copy(update={"policy": base.policy.model_copy(update={"shield": shield})})
    course = draw_course(number, STILL, values_at(constants_of(decide)))
    views, loop, times = list(course.views()), ClosedLoop(decide, [rule], PlaneRules.of(base)), PlaneRules.of(base)
    expected, last, breaks = [], {}, []
    for k, view in enumerate(views):
        breaks += [k] * bool(loop.step(view, k * times.period_s))
        for d in (link.enforced for link in loop._loop.links.values()):
            if d != last.get(d.destination, d._replace(representation=0, rho=0.0, rate_hz=0.0, roi=None)):
                expected.append((k, d.destination, int(d.representation), round(d.rate_hz, 3)))
            last[d.destination] = d
    record = run_sortie(course_scenario(Subject(decide, policy, {}), rule, "", base, views))
    rows = [row for row in record.tables["directives"].to_pylist() if row["drone"] == 0]
    rungs = ["none", "tracks", "detections", "features", "raw"]
    flown = [(int(r["t_s"] / 0.1), r["peer"], rungs.index(r["representation"]), round(r["rate_hz"], 3)) for r in rows]
    flown = [row for row in flown if row[0] < len(views)]
    assert flown == expected
    assert flown
    after = record.totals["violated_ticks"] - len(breaks)
    assert after in (0, 1), "after the course, the flight has one more decision, at which a break may end"


VERDICTS = [
    ("silent_when_tired", "when peers >= 1: within 1.5 s: any_link(rate_hz > 0)", "refuted"),
    ("two_rates", "when peers >= 1: within 1.5 s: any_link(rate_hz > 0)", "proved"),
    ("two_rates", "within 0.5 s: rate_hz > 0", "refuted"),  # the dwell time after take-off
    ("two_rates", "climbs_in(dwell) <= 1", "proved"),
    ("flips", "climbs_in(4) <= 1", "refuted"),
    ("by_charge", "climbs_in(dwell) <= 1", "tried"),
    ("own_region", "climbs_in(dwell) <= 1", "proved"),
    ("one_of_two_regions", "switches_in(0.5) <= 2", "refuted"),
]


def test_the_verdict_of_a_line_about_time(file: Path) -> None:
    base = loads("name: base", overrides=["policy.dwell_s=1.0"])
    for name, line, outcome in VERDICTS:
        reference = f"{file}:{name}"
        subject = Subject(resolve(reference), reference, {})
        (verdict,) = judge_over_time(subject, parse(line), drones=2, scenario=base, courses=150)
        assert verdict.outcome == outcome, (name, line, verdict.what)
        if outcome == "refuted":
            assert verdict.scenario is not None
            assert run_sortie(verdict.scenario).totals["invariant_violations"] > 0
            assert "of a course: →1 " in verdict.what
        else:
            assert "150 courses of up to 2 drones keep it, at a dwell time of 1 s" in verdict.what
            assert ("all sequences of views of up to 2 drones" in verdict.what) == (outcome == "proved")


A_BREAK = "a sequence of views breaks it"
OTHER_REGIONS = "regions other than the drone's own"
NO_PROOF = [
    ("by_charge", "climbs_in(dwell) <= 1", "a number of the view goes into them"),
    ("two_rates", "climbs_in(0.5) <= 1", A_BREAK),
    ("two_rates", "within 0.7 s: rate_hz > 0", A_BREAK),
    ("two_rates", "when peers >= 1: within 0.3 s: any_link(rate_hz > 0)", A_BREAK),
    ("two_rates", "rate_hz <= fresh.rate_hz and climbs_in(1) <= 9", "fresh directives"),
    ("hasty", "switches_in(1.2) <= 9", "a link changes more than 9 times within 1.2 s"),
    ("one_of_two_regions", "switches_in(0.5) <= 2", OTHER_REGIONS),
    ("moved_region", "switches_in(0.5) <= 2", OTHER_REGIONS),
    ("two_rates", "count_links(climbs_in(1) > 1) <= 1", "counts of changes together with functions over links"),
    ("by_a_flag", "climbs_in(dwell) <= 1", "it raises KeyError: 1"),
    ("too_fast_by_a_flag", "climbs_in(dwell) <= 1", "it breaks the contract: .* rate_hz is 31.0"),
]


def test_what_no_proof_is_given_for(file: Path) -> None:
    for name, line, why in NO_PROOF:
        with pytest.raises(NotFinite, match=why):
            prove_over_time(resolve(f"{file}:{name}"), parse(line)[0], TIMES, 2)


def test_no_proof_follows_what_a_scenario_adds(file: Path) -> None:
    for override, why in (
        ("policy.shield=true", "a shield"),
        ("context.roster=true", "rosters"),
        ("context.detached_after_periods=20", "another limit"),
    ):
        scenario = loads("name: base", overrides=[override, "policy.invariants='rate_hz <= 30'"])
        with pytest.raises(NotFinite, match=f"no proof follows {why}"):
            prove_over_time(resolve(f"{file}:two_rates"), parse("climbs_in(dwell) <= 1")[0], PlaneRules.of(scenario), 2)


def test_the_policies_of_a_scenario_do_not_fly_for_the_one_that_is_verified() -> None:
    text = """
name: changing
fleet: {drones: 2, makes: [{name: quiet, drones: [1], policy: silence}]}
policy: {changes: [{at_s: 1, name: silence}, {command: hush, name: silence}], commands: [{at_s: 1, command: hush}]}
"""
    (rule,) = parse("within 0.5 s: rate_hz > 0")
    (flown,) = flights_of(Subject(resolve("worked"), "worked", {}), rule, loads(text), 1)
    assert (flown.policy.name, flown.policy.changes, flown.policy.commands) == ("worked", (), ())
    assert not flown.policy.of_makes


def test_the_longest_wait_for_a_link_is_proved_to_the_frame(file: Path) -> None:
    """Dwell 0.4 s: a link that carries nothing and is asked for 2 or 5 Hz at once waits that long."""
    decide = resolve(f"{file}:two_rates")
    (longer,) = parse("when age_periods <= 3: within 0.4 s: rate_hz > 0")
    (shorter,) = parse("when age_periods <= 3: within 0.3 s: rate_hz > 0")
    prove_over_time(decide, longer, TIMES, 2)
    with pytest.raises(NotFinite):
        prove_over_time(decide, shorter, TIMES, 2)


def test_views_of_a_course_come_frame_by_frame_and_count_in_the_plane_s_periods() -> None:
    for every in (1, 3):
        course = Course(2, 4, 0.1, 0.1 * every, 10.0, {("lost", 1, -1): ((0, 0.0), (2, 1.0))})
        views = list(course.views())
        assert [view.period_s for view in views] == [0.1 * every] * 4
        assert [view.descriptors[0].stamp_ns for view in views] == [0, 100_000_000, 200_000_000, 300_000_000]
        assert [view.age_s[1] for view in views] == pytest.approx([0.02, 0.02, 0.12, 0.22])


def test_a_break_that_does_not_come_again_refutes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(over_time, "shows_in_flight", lambda scenario: True)
    decided = [0]

    def once(view: FleetView) -> list[Directive]:
        decided[0] += 1
        rate_hz = 0.0 if decided[0] < 20 else 2.0
        kind = Representation.DETECTIONS if rate_hz else Representation.NONE
        return [Directive(view.ego, p, kind, rate_hz=rate_hz, reason="r") for p in view.peers]

    rules = parse("when age_s < 0.5: within 1.5 s: rate_hz > 0")
    (verdict,) = judge_over_time(Subject(once, "once", {}), rules, drones=2, courses=2)
    assert verdict.outcome == "tried"


RAISES = """
from sortie import Directive

def decide(view):
    if view.me is not None and view.me.battery_soc < {limit}:
        raise {error}
    return [Directive(view.ego, p, reason="r") for p in view.peers]
"""


def test_a_policy_that_fails_in_a_course_is_refuted_by_a_flight_of_it(tmp_path: Path) -> None:
    for number, (error, said) in enumerate(
        (("LookupError('gone')", "raises LookupError: gone"), ("SystemExit(3)", "exit code 3, must return"))
    ):
        path = tmp_path / f"mine{number}.py"
        path.write_text(RAISES.format(limit=0.3137, error=error))
        subject = Subject(resolve(f"{path}:decide"), f"{path}:decide", {})
        (verdict,) = judge_over_time(subject, parse("climbs_in(dwell) <= 1"), drones=2)
        assert verdict.outcome == "refuted", verdict.what
        assert verdict.what.startswith("the policy fails after ")
        assert said in verdict.what
        assert verdict.scenario is not None
        with pytest.raises(PolicyError, match=re.escape(said)):
            run_sortie(verdict.scenario)


def test_an_error_of_the_contract_keeps_its_text_in_the_loop() -> None:
    def refuses(view: FleetView) -> list[Directive]:
        raise PolicyError("gone")

    with pytest.raises(PolicyError, match=r"^gone$"):
        ClosedLoop(refuses, parse("climbs_in(dwell) <= 1"), TIMES).step(next(STILL.views()), 0.0)
