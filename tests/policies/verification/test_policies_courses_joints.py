"""Courses of views and views at a policy's constants: what is read at each decision, what is drawn, what shrinking leaves.

1. Signals become views: charge never rises, a lost descriptor grows older and stays as it was, the ego hears itself.
2. Numbers in a policy's code are found wherever its code keeps them, and drawn values lie on both sides of them.
3. Each number is another course.
4. Shrinking leaves what the failure needs, and ends at the decision that shows it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import pytest

from sortie.policies.contract import COVERAGE_BYTES, PERSON_FLAG, Directive, Disc, FleetView, TaskPhase
from sortie.policies.verification.invariants.language import parse
from sortie.policies.verification.kit.courses import (
    Course,
    draw_course,
    shrink_course,
    values_at,
)
from sortie.policies.verification.kit.drawn import views_at_sizes
from sortie.policies.verification.kit.views import AT_CONSTANTS, draw_views
from sortie.policies.verification.shield import shield
from sortie.policies.verification.subject import constants_of

STILL = Course(3, 20, 0.1, 0.1, 10.0, {})
VALUES = values_at(())
COURSE = Course(
    drones=3,
    decisions=6,
    frame_s=0.1,
    period_s=0.2,
    detached_after_periods=7.0,
    signals={
        ("soc", 0, -1): ((0, 0.8), (2, 0.5), (4, 0.9)),
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
    },
)


def test_the_views_of_a_course_by_hand() -> None:
    views = list(COURSE.views())
    assert [(v.ego, v.period_s, v.detached_after_periods) for v in views] == [(0, 0.2, 7.0)] * 6
    assert [v.descriptors[0].battery_soc for v in views] == [0.8, 0.8, 0.5, 0.5, 0.5, 0.5]
    assert [v.age_s[0] for v in views] == [0.0] * 6
    assert [v.age_s[1] for v in views] == pytest.approx([0.02, 0.12, 0.22, 0.02, 0.02, 0.02])
    assert [v.age_s[2] for v in views] == pytest.approx([0.02] * 6)
    stamps_ns = [[v.descriptors[i].stamp_ns for v in views] for i in range(3)]
    ms = 1_000_000
    assert stamps_ns[0] == stamps_ns[2] == [0, 100 * ms, 200 * ms, 300 * ms, 400 * ms, 500 * ms]
    assert stamps_ns[1] == [0, 0, 0, 300 * ms, 400 * ms, 500 * ms]
    assert [v.descriptors[2].task_phase for v in views] == [TaskPhase.TRACK] * 5 + [TaskPhase.LANDING]
    assert [v.descriptors[2].novelty_flags for v in views] == [0] + [PERSON_FLAG] * 5
    last = views[-1].descriptors
    assert (last[1].cpu_headroom, last[1].gpu_headroom) == (0.25, 0.75)
    assert (last[0].region, last[1].region) == (None, Disc(50.0, 0.0, 32.0))
    assert [bool(last[i].priority_target_ids) for i in range(3)] == [False, True, False]
    assert [last[i].peer_goodput_mbps for i in range(3)] == [(50.0, 20.0), (50.0, 50.0), (5.0, 50.0)]
    assert last[1].position_m == pytest.approx((10.5, 19.0, 60.0))
    assert last[1].velocity_mps == (1.0, -2.0, 0.0)
    assert last[2].position_m == (0.0, 0.0, 60.0)
    assert last[2].coverage_grid == bytes(COVERAGE_BYTES)


def test_drawn_values_lie_on_both_sides_of_a_constant_that_can_be_one() -> None:
    usual, values = values_at(()), values_at({0.25, 8.0, -1.0, 1e6})
    assert set(values["soc"]) - set(usual["soc"]) == {0.25 - 1e-4, 0.25, 0.25 + 1e-4}
    rates = {0.9 * 0.25, 0.25, 1.2 * 0.25, 0.9 * 8.0, 8.0, 1.2 * 8.0}
    assert set(values["goodput"]) - set(usual["goodput"]) == rates
    assert set(values_at({0.0, 1.0})["cpu"]) - set(usual["cpu"]) == {0.0, 1e-4, 1.0 - 1e-4}


AT_MODULE = {"a": 0.1357, 0.9753: "b"}


def _decide(view: FleetView, by_place: float = 0.1122, *, by_name: float = 0.3344) -> list[Directive]:
    limits = AT_MODULE, by_place, by_name, 0.5566
    return [] if len(limits) > view.ego else list[Directive]()


def test_the_numbers_of_a_policy_are_found_wherever_its_code_keeps_them() -> None:
    found = constants_of(partial(_decide, by_name=0.1100 + 1e-5), parse("when battery < 0.4321: rho <= 0.8765"))
    assert found >= {0.1357, 0.9753, 0.1122, 0.3344, 0.5566, 0.1100 + 1e-5, 0.4321, 0.8765}
    assert constants_of(shield(_decide, parse("rho <= 1"))) >= {0.1357, 0.5566}


def test_each_number_is_another_course_and_the_same_again() -> None:
    drawn = [draw_course(n, STILL, VALUES).signals for n in range(8)]
    assert drawn == [draw_course(n, STILL, VALUES).signals for n in range(8)]
    assert all(a != b for k, a in enumerate(drawn) for b in drawn[:k])


def test_every_signal_is_drawn_and_begins_at_the_first_decision() -> None:
    keys, values = set(), dict[str, set[float]]()
    for number in range(60):
        for (name, i, j), steps in draw_course(number, STILL, VALUES).signals.items():
            times = [k for k, _ in steps]
            assert times[0] == 0
            assert times == sorted(set(times))
            keys.add((name, i, j))
            values.setdefault(name, set()).update(v for _, v in steps)
    goodput = {("goodput", i, j) for i in range(3) for j in range(3) if i != j}
    assert (
        keys == {(name, i, -1) for name in VALUES if name != "goodput" for i in range(3)} - {("lost", 0, -1)} | goodput
    )
    assert values == {name: set(one) for name, one in VALUES.items()}


def test_shrinking_leaves_what_the_failure_needs() -> None:
    steps = ((0, 0.9), (3, 0.6), (7, 0.2), (12, 0.1))
    others = {("cpu", 1, -1): ((0, 0.5), (4, 0.2)), ("goodput", 0, 3): ((0, 5.0),), ("x_m", 2, -1): ((0, 9.0),)}
    course, tried = Course(4, 30, 0.1, 0.1, 10.0, {("soc", 0, -1): steps, **others}), []

    def failing(candidate: Course) -> int:
        tried.append(candidate)
        return next((k + 1 for k, v in enumerate(candidate.views()) if v.descriptors[0].battery_soc < 0.3), 0)

    small = shrink_course(course, failing)
    assert small == Course(2, 8, 0.1, 0.1, 10.0, {("soc", 0, -1): ((0, 0.9), (7, 0.2))})
    assert all(candidate.drones >= 2 for candidate in tried)


def test_shrinking_keeps_the_drones_and_the_places_that_the_failure_needs() -> None:
    signals = {("lost", 2, -1): ((0, 0.0), (4, 1.0)), ("x_m", 2, -1): ((0, 50.0),)}
    course = Course(5, 9, 0.1, 0.1, 10.0, signals)

    def failing(candidate: Course) -> int:
        views = enumerate(candidate.views())
        return next((k + 1 for k, v in views if v.age_s.get(2, 0.0) > 0.2 and v.descriptors[2].position_m[0] > 0), 0)

    assert shrink_course(course, failing) == course._replace(drones=3, decisions=6)


# --- views at constants ---------------------------------------------------------------------------


def _shares(views: Sequence[FleetView]) -> set[float]:
    return {x for v in views for d in v.descriptors.values() for x in (d.battery_soc, d.cpu_headroom, d.gpu_headroom)}


def test_views_at_constants_have_them_and_the_floats_beside_them() -> None:
    c, rate_mbps, age_s = 0.4321, 77.25, 1234.5
    views = list(draw_views(5, 80 * AT_CONSTANTS, {c, rate_mbps, age_s, 2.0}))[::AT_CONSTANTS]
    assert {c, math.nextafter(c, 0), math.nextafter(c, 1)} <= _shares(views)
    assert all(0 <= x <= 1 for x in _shares(views))
    goodputs = {x for v in views for d in v.descriptors.values() for x in d.peer_goodput_mbps}
    assert {rate_mbps, math.nextafter(rate_mbps, 0), math.nextafter(rate_mbps, 100)} <= goodputs
    assert any(v.age_s[i] == age_s for v in views for i in v.peers)
    assert any(v.ego == 2 for v in views)
    assert all(v.ego in v.descriptors and v.age_s.keys() == v.descriptors.keys() for v in views)
    assert all(a.descriptors != b.descriptors for k, a in enumerate(views) for b in views[:k] if len(a.descriptors) > 2)
    assert list(draw_views(5, 5, {c})) == list(draw_views(5, 5, {c})) != list(draw_views(5, 5))


def test_where_only_the_ego_is_at_constants_it_is_the_ego_of_the_view() -> None:
    """The others then have the numbers that they were drawn with, which are no constants."""
    apart, chosen = 0, {float(i) for i in range(3, 20)}
    for view in draw_views(5, 80 * AT_CONSTANTS, {0.4321, *chosen}):
        at = {i for i, d in view.descriptors.items() if 0.4321 in (d.battery_soc, d.cpu_headroom, d.gpu_headroom)}
        apart += at == {view.ego} and len(view.descriptors) > 2
    assert apart >= 10


def test_fleets_are_as_large_as_the_constants_of_a_policy() -> None:
    large = [view for seed in range(4) for view in views_at_sizes({0.5, 30.0}, seed)]
    assert {v.ego for v in large} >= {30}
    listed = {len(d.peer_goodput_mbps) + 1 for v in large for d in v.descriptors.values() if d.roster is None}
    assert listed == {30, 31, 32}
