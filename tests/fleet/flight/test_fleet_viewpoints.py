"""Viewpoints: whatever is asked for, places keep their distance and the fence; and what is flown hangs together."""

from __future__ import annotations

import math
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sortie.fleet.flight.displaced import displaced
from sortie.fleet.flight.motion import MotionError, Trajectories, fly
from sortie.fleet.flight.rotor import fleet_power_w
from sortie.fleet.flight.viewpoints import (
    LEAST_MOVE_M,
    Bounds,
    Course,
    Move,
    Plan,
    bounds_of,
    course_of,
    grant,
    least_m,
    shift_m,
    shifts,
)
from sortie.scenarios.schema import Fleet

FRAME_S = 0.1
SHAPES = ("cross", "line", "wedge", "grid", "circle")


def fleet_with(**changed: object) -> Fleet:
    """Five drones round a corner."""
    base: dict[str, object] = {"drones": 5, "route": {"waypoints_m": [[-40, 0], [20, 0], [20, 60]]}}
    return Fleet.model_validate(base | changed)


def course_and_bounds(fleet: Fleet, duration_s: float = 30.0) -> tuple[Course, Bounds]:
    return course_of(fleet, np.arange(0, duration_s, FRAME_S)), bounds_of(fleet)


wishes = st.tuples(st.integers(0, 5), st.integers(0, 299), st.floats(-60, 60), st.floats(-60, 60))
fences = st.none() | st.tuples(st.floats(-120, -70), st.floats(-80, -40), st.floats(50, 90), st.floats(90, 130))


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from(SHAPES),
    st.floats(4, 30),
    st.floats(1, 25),
    st.floats(0.5, 8),
    st.floats(0.2, 3),
    st.floats(0, 50),
    fences,
    st.lists(wishes, min_size=1, max_size=40),
)
def test_no_wish_breaks_a_bound(
    shape: str,
    spacing_m: float,
    separation_m: float,
    speed_mps: float,
    acceleration_mps2: float,
    reach_m: float,
    fence: tuple[float, float, float, float] | None,
    asked: list[tuple[int, int, float, float]],
) -> None:
    """At every instant, a hundredth of a second apart: distance, fence, reach, speed and acceleration."""
    viewpoints = {
        "reach_m": reach_m, "speed_mps": speed_mps, "acceleration_mps2": acceleration_mps2,
        "separation_m": separation_m, "fence_m": fence,
    }  # fmt: skip
    fleet = fleet_with(
        drones=6, formation={"shape": shape, "spacing_m": spacing_m}, viewpoints=viewpoints,
        motion={"pose_jitter_m": 0.2},
    )  # fmt: skip
    try:
        course, bounds = course_and_bounds(fleet)
    except MotionError:
        return  # a fence that the formation itself leaves
    plans: list[Plan] = [()] * 6
    for drone, frame, x_m, y_m in sorted(asked, key=lambda wish: wish[1]):
        answer = grant(drone, (x_m, y_m), plans, course, bounds, frame)
        if isinstance(answer, Move):
            plans[drone] = (*plans[drone], answer)

    fine_s = np.arange(0, 60, 0.01)
    places = np.stack([course.slot_m[i] + shift_m(plans[i], fine_s) for i in range(6)], axis=1)
    for i in range(6):
        shift, rate, push = (np.linalg.norm(v, axis=-1) for v in shifts(plans[i], fine_s))
        assert shift.max() <= reach_m + 1e-9
        assert rate.max() <= speed_mps + 1e-9
        assert push.max() <= acceleration_mps2 + 1e-9
        for j in range(i):
            apart = np.linalg.norm(places[:, i] - places[:, j], axis=-1)
            assert apart.min() >= least_m(course, bounds, i, j) - 1e-6
    if bounds.fence_m is not None:
        for i in range(6):
            flown = course.world_m(course.slot_m[i] + shift_m(plans[i], course.time_s))
            assert (flown >= np.array(bounds.fence_m[:2]) - 1e-9).all()
            assert (flown <= np.array(bounds.fence_m[2:]) + 1e-9).all()


def test_a_free_wish_is_granted_whole_and_in_the_shortest_time() -> None:
    course, bounds = course_and_bounds(fleet_with())
    move = grant(2, (3.0, 30.0), [()] * 5, course, bounds, 10)
    assert isinstance(move, Move)
    assert (move.begin_s, move.start_m, move.end_m) == (pytest.approx(1.0), (0.0, 0.0), (3.0, 30.0))
    assert move.speed_mps == pytest.approx(bounds.speed_mps)  # 30 m: speed decides
    assert move.acceleration_mps2 < bounds.acceleration_mps2
    short = grant(2, (0.0, 4.0), [()] * 5, course, bounds, 10)
    assert isinstance(short, Move)
    assert short.acceleration_mps2 == pytest.approx(bounds.acceleration_mps2)  # 4 m: acceleration decides
    assert short.speed_mps < bounds.speed_mps


def test_a_repeated_wish_restarts_nothing() -> None:
    course, bounds = course_and_bounds(fleet_with())
    move = grant(2, (0.0, 20.0), [()] * 5, course, bounds, 0)
    assert isinstance(move, Move)
    plans: list[Plan] = [(), (), (move,), (), ()]
    for frame in range(0, 299, 7):
        assert grant(2, (0.0, 20.0 + 0.9 * LEAST_MOVE_M), plans, course, bounds, frame) is None


def test_a_wish_through_another_drone_is_cut_short_or_refused() -> None:
    """In a cross the left drone (slot 20 m left) may come to 12.8 m beside the middle one and no nearer."""
    course, bounds = course_and_bounds(fleet_with())
    assert bounds.separation_m == pytest.approx(10 + math.sqrt(2) * 5 * 0.4)
    move = grant(2, (0.0, -20.0), [()] * 5, course, bounds, 0)
    assert isinstance(move, Move)
    assert move.end_m == (0.0, -5.0)  # a quarter of it
    assert grant(2, (0.0, -39.0), [()] * 5, course, bounds, 0) == "would come too near drone 0"
    assert isinstance(grant(2, (0.0, -39.0), [()] * 5, course, bounds, 0, gone={0}), Move), "nobody is there any more"


def test_a_wish_for_where_another_is_going_waits_and_is_cut_short() -> None:
    course, bounds = course_and_bounds(fleet_with(drones=2, formation={"shape": "line"}))  # at (0, 0) and (0, 20)
    other = grant(1, (30.0, -20.0), [(), ()], course, bounds, 0)
    assert isinstance(other, Move)
    assert other.end_m == (30.0, -20.0)  # to (30, 0), as drone 0 wishes too
    assert grant(0, (30.0, 0.0), [(), (other,)], course, bounds, 1) == "would come too near drone 1"
    move = grant(0, (30.0, 0.0), [(), (other,)], course, bounds, 280)
    assert isinstance(move, Move)
    assert move.end_m == (15.0, 0.0)


def test_a_wish_that_would_leave_the_fence_some_day_is_cut_short_now() -> None:
    """Drone 4 flies 20 m right of the track, on the last leg at x = 40: there 15 m farther out is within 58, 30 m not."""
    fleet = fleet_with(viewpoints={"fence_m": [-100, -100, 60, 100]})
    course, bounds = course_and_bounds(fleet)
    assert bounds.fence_m == (-98, -98, 58, 98)
    move = grant(4, (0.0, -30.0), [()] * 5, course, bounds, 0)
    assert isinstance(move, Move)
    assert move.end_m == (0.0, -15.0)
    assert grant(4, (0.0, -40.0), [(), (), (), (), (move,)], course, bounds, 200) == "would leave the fence"


def test_a_fence_that_the_formation_leaves_is_no_fence_to_fly_in() -> None:
    with pytest.raises(
        MotionError, match=r"fence_m \(-100.0, -100.0, 30.0, 100.0\) must hold every slot's way .* drone"
    ):
        course_and_bounds(fleet_with(viewpoints={"fence_m": [-100, -100, 30, 100]}))


def flown_with_moves(**changed: object) -> tuple[Fleet, Trajectories, Trajectories, list[Plan], Course]:
    fleet = fleet_with(**changed)
    base = fly(fleet, 30.0, FRAME_S, seed=3)
    course, bounds = course_of(fleet, np.asarray(base.time_s)), bounds_of(fleet)
    plans: list[Plan] = [()] * 5
    for drone, wish in ((2, (5.0, 30.0)), (4, (0.0, -25.0))):
        move = grant(drone, wish, plans, course, bounds, 50)
        assert isinstance(move, Move)
        plans[drone] = (move,)
    return fleet, base, displaced(base, base, course, plans, 50), plans, course


def test_the_flight_before_a_move_and_of_others_stays_bit_for_bit() -> None:
    _, base, flown, _, _ = flown_with_moves()
    for each in fields(base):
        before, after = getattr(base, each.name), getattr(flown, each.name)
        assert np.array_equal(before[:50], after[:50]), each.name
        if before.ndim >= 2 and before.shape[1] == 5:
            assert np.array_equal(before[:, [0, 1, 3]], after[:, [0, 1, 3]]), each.name
    assert not flown.position_m.flags.writeable


def test_positions_velocities_and_accelerations_belong_together() -> None:
    """Central differences, round a corner, without gusts and jitter, whose own derivatives are tested elsewhere."""
    still = {"pose_jitter_m": 0.0, "gust_sigma_mps": 0.0, "pose_error_m": 0.0}
    _, base, flown, plans, course = flown_with_moves(motion=still)
    for drone in (2, 4):
        place = course.world_m(course.slot_m[drone] + shift_m(plans[drone], course.time_s))
        assert np.allclose(flown.position_m[:, drone, :2], place, atol=1e-9)
        velocity = (flown.position_m[2:, drone] - flown.position_m[:-2, drone]) / (2 * FRAME_S)
        assert np.abs(velocity - flown.velocity_mps[1:-1, drone]).max() < 0.01
        acceleration = (flown.velocity_mps[2:, drone] - flown.velocity_mps[:-2, drone]) / (2 * FRAME_S)
        assert np.abs(acceleration - flown.acceleration_mps2[1:-1, drone]).max() < 0.05
    assert np.abs(np.linalg.norm(flown.orientation_xyzw, axis=-1) - 1).max() < 1e-12
    assert np.abs(flown.body_rates_radps).max() < 1.0
    assert np.array_equal(flown.est_position_m - flown.position_m, base.est_position_m - base.position_m)


@pytest.mark.parametrize("model", ["level", "momentum"])
def test_a_move_changes_what_the_rotors_draw_and_nobody_else_pays(model: str) -> None:
    fleet, base, flown, plans, _ = flown_with_moves(airframe={"power_model": model})
    before, after = fleet_power_w(fleet, base), fleet_power_w(fleet, flown)
    assert np.array_equal(before[:, [0, 1, 3]], after[:, [0, 1, 3]])
    moving = slice(51, round(plans[2][-1].end_s / FRAME_S))
    assert np.abs(after[moving, 2] - before[moving, 2]).max() > 1.0
