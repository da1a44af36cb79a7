"""Courses of views: signals become views, each number is another course, shrinking leaves what a failure needs."""

from __future__ import annotations

from functools import partial

import pytest

from sortie.policies.contract import COVERAGE_BYTES, PERSON_FLAG, Directive, Disc, FleetView, TaskPhase
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.kit.courses import Course, draw_course, shrink_course, values_at
from sortie.policies.verification.shield import shield
from sortie.policies.verification.subject import constants_of

STILL = Course(3, 20, 0.1, 0.1, 10.0, {})
VALUES = values_at(())
SIGNALS = {
    ("soc", 0, -1): ((0, 0.8), (2, 0.5), (4, 0.9)),  # charge never rises
    ("lost", 0, -1): ((0, 1.0),),
    ("lost", 1, -1): ((0, 1.0), (3, 0.0)),
    ("cpu", 1, -1): ((0, 0.25),),
    ("gpu", 1, -1): ((0, 0.75),),
    ("phase", 2, -1): ((0, 2.0), (5, 4.0)),
    ("person", 2, -1): ((0, 0.0), (1, 1.0)),
    ("region", 0, -1): ((0, 0.0),),
    ("targets", 1, -1): ((0, 1.0),),
    ("goodput", 0, 2): ((0, 20.0),),
    ("goodput", 2, 0): ((0, 5.0),),
    ("x_m", 1, -1): ((0, 10.0),),
    ("y_m", 1, -1): ((0, 20.0),),
    ("vx_mps", 1, -1): ((0, 1.0),),
    ("vy_mps", 1, -1): ((0, -2.0),),
}


def test_the_views_of_a_course_by_hand() -> None:
    """A lost descriptor grows older and stays as it was, and the ego hears itself."""
    views = list(Course(3, 6, 0.1, 0.2, 7.0, SIGNALS).views())
    assert [(v.ego, v.period_s, v.detached_after_periods) for v in views] == [(0, 0.2, 7.0)] * 6
    assert [v.descriptors[0].battery_soc for v in views] == [0.8, 0.8, 0.5, 0.5, 0.5, 0.5]
    assert [v.age_s[0] for v in views] == [0.0] * 6
    assert [v.age_s[1] for v in views] == pytest.approx([0.02, 0.12, 0.22, 0.02, 0.02, 0.02])
    assert [v.age_s[2] for v in views] == pytest.approx([0.02] * 6)
    stamps_ms = [[v.descriptors[i].stamp_ns / 1e6 for v in views] for i in range(3)]
    assert stamps_ms[0] == stamps_ms[2] == [0, 100, 200, 300, 400, 500]
    assert stamps_ms[1] == [0, 0, 0, 300, 400, 500]
    assert [v.descriptors[2].task_phase for v in views] == [TaskPhase.TRACK] * 5 + [TaskPhase.LANDING]
    assert [v.descriptors[2].novelty_flags for v in views] == [0] + [PERSON_FLAG] * 5
    last = views[-1].descriptors
    assert (last[1].cpu_headroom, last[1].gpu_headroom) == (0.25, 0.75)
    assert (last[0].region, last[1].region) == (None, Disc(50.0, 0.0, 32.0))
    assert [bool(last[i].priority_target_ids) for i in range(3)] == [False, True, False]
    assert [last[i].peer_goodput_mbps for i in range(3)] == [(50.0, 20.0), (50.0, 50.0), (5.0, 50.0)]
    assert last[1].position_m == pytest.approx((10.5, 19.0, 60.0))
    assert (last[1].velocity_mps, last[2].position_m) == ((1.0, -2.0, 0.0), (0.0, 0.0, 60.0))
    assert last[2].coverage_grid == bytes(COVERAGE_BYTES)


def test_drawn_values_lie_on_both_sides_of_a_constant_that_can_be_one() -> None:
    usual, values = values_at(()), values_at({0.25, 8.0, -1.0, 1e6})
    assert set(values["soc"]) - set(usual["soc"]) == {0.25 - 1e-4, 0.25, 0.25 + 1e-4}
    rates = {0.9 * 0.25, 0.25, 1.2 * 0.25, 0.9 * 8.0, 8.0, 1.2 * 8.0}
    assert set(values["goodput"]) - set(usual["goodput"]) == rates
    assert set(values_at({0.0, 1.0})["cpu"]) - set(usual["cpu"]) == {0.0, 1e-4, 1.0 - 1e-4}


AT_MODULE = {"a": 0.1357, 0.9753: "b"}


def decide(view: FleetView, by_place: float = 0.1122, *, by_name: float = 0.3344) -> list[Directive]:
    limits = AT_MODULE, by_place, by_name, 0.5566
    return [] if len(limits) > view.ego else list[Directive]()


def test_the_numbers_of_a_policy_are_found_wherever_its_code_keeps_them() -> None:
    found = constants_of(partial(decide, by_name=0.1100 + 1e-5), parse("when battery < 0.4321: rho <= 0.8765"))
    assert found >= {0.1357, 0.9753, 0.1122, 0.3344, 0.5566, 0.1100 + 1e-5, 0.4321, 0.8765}
    assert constants_of(shield(decide, parse("rho <= 1"))) >= {0.1357, 0.5566}


def test_each_number_is_another_course_of_all_signals_and_the_same_again() -> None:
    drawn = [draw_course(n, STILL, VALUES).signals for n in range(60)]
    assert drawn[:8] == [draw_course(n, STILL, VALUES).signals for n in range(8)]
    assert all(a != b for k, a in enumerate(drawn[:8]) for b in drawn[:k])
    values = dict[str, set[float]]()
    for signals in drawn:
        for (name, _, _), steps in signals.items():
            times = [k for k, _ in steps]
            assert (times[0], times) == (0, sorted(set(times)))
            values.setdefault(name, set()).update(v for _, v in steps)
    goodput = {("goodput", i, j) for i in range(3) for j in range(3) if i != j}
    others = {(name, i, -1) for name in VALUES if name != "goodput" for i in range(3)} - {("lost", 0, -1)}
    assert {key for signals in drawn for key in signals} == others | goodput
    assert values == {name: set(one) for name, one in VALUES.items()}


def test_shrinking_leaves_what_the_failure_needs_and_ends_at_the_decision_that_shows_it() -> None:
    steps = ((0, 0.9), (3, 0.6), (7, 0.2), (12, 0.1))
    others = {("cpu", 1, -1): ((0, 0.5), (4, 0.2)), ("goodput", 0, 3): ((0, 5.0),), ("x_m", 2, -1): ((0, 9.0),)}
    course, tried = Course(4, 30, 0.1, 0.1, 10.0, {("soc", 0, -1): steps, **others}), []

    def tired(candidate: Course) -> int:
        tried.append(candidate)
        return next((k + 1 for k, v in enumerate(candidate.views()) if v.descriptors[0].battery_soc < 0.3), 0)

    small = shrink_course(course, tired)
    assert small == Course(2, 8, 0.1, 0.1, 10.0, {("soc", 0, -1): ((0, 0.9), (7, 0.2))})
    assert all(candidate.drones >= 2 for candidate in tried)
    course = Course(5, 9, 0.1, 0.1, 10.0, {("lost", 2, -1): ((0, 0.0), (4, 1.0)), ("x_m", 2, -1): ((0, 50.0),)})

    def away(candidate: Course) -> int:
        views = enumerate(candidate.views())
        return next((k + 1 for k, v in views if v.age_s.get(2, 0.0) > 0.2 and v.descriptors[2].position_m[0] > 0), 0)

    assert shrink_course(course, away) == course._replace(drones=3, decisions=6)
