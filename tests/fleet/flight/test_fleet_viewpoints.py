"""Viewpoints: whatever is asked for, places keep their distance."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sortie.fleet.flight.motion import MotionError
from sortie.fleet.flight.safety import grant
from sortie.fleet.flight.viewpoints import (
    LEAST_MOVE_M,
    Bounds,
    Course,
    Move,
    Plan,
    ViewpointWish,
    bounds_of,
    course_of,
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


def asked(drone: int, wanted_m: tuple[float, float], plans: list[Plan], *rest: Any, **gone: Any) -> Move | str | None:
    return grant(ViewpointWish(drone, wanted_m, plans, *rest, **gone))


wishes = st.tuples(st.integers(0, 5), st.integers(0, 299), st.floats(-60, 60), st.floats(-60, 60))


fences = st.none() | st.tuples(st.floats(-120, -70), st.floats(-80, -40), st.floats(50, 90), st.floats(90, 130))


formations = st.fixed_dictionaries({"shape": st.sampled_from(SHAPES), "spacing_m": st.floats(4, 30)})
limits = st.fixed_dictionaries(
    {
        "reach_m": st.floats(0, 50),
        "speed_mps": st.floats(0.5, 8),
        "acceleration_mps2": st.floats(0.2, 3),
        "separation_m": st.floats(1, 25),
        "fence_m": fences,
    }
)


@settings(max_examples=75, deadline=None)
@given(formations, limits, st.lists(wishes, min_size=1, max_size=40))
def test_no_wish_breaks_a_bound(
    formation: dict[str, Any], limits: dict[str, Any], wished: list[tuple[int, int, float, float]]
) -> None:
    """At every instant, a hundredth of a second apart: distance, fence, reach, speed and acceleration."""
    fleet = fleet_with(drones=6, formation=formation, viewpoints=limits, motion={"pose_jitter_m": 0.2})
    try:
        course, bounds = course_and_bounds(fleet)
    except MotionError:
        return  # a fence that the formation itself leaves
    plans: list[Plan] = [()] * 6
    for drone, frame, x_m, y_m in sorted(wished, key=lambda wish: wish[1]):
        answer = asked(drone, (x_m, y_m), plans, course, bounds, frame)
        if isinstance(answer, Move):
            plans[drone] = (*plans[drone], answer)

    fine_s = np.arange(0, 60, 0.01)
    places = np.stack([course.slot_m[i] + shift_m(plans[i], fine_s) for i in range(6)], axis=1)
    for i in range(6):
        shift, rate, push = (np.linalg.norm(v, axis=-1) for v in shifts(plans[i], fine_s))
        assert shift.max() <= limits["reach_m"] + 1e-9
        assert rate.max() <= limits["speed_mps"] + 1e-9
        assert push.max() <= limits["acceleration_mps2"] + 1e-9
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
    move = asked(2, (3.0, 30.0), [()] * 5, course, bounds, 10)
    assert isinstance(move, Move)
    assert (move.begin_s, move.start_m, move.end_m) == (pytest.approx(1.0), (0.0, 0.0), (3.0, 30.0))
    assert move.speed_mps == pytest.approx(bounds.speed_mps)  # 30 m: speed decides
    assert move.acceleration_mps2 < bounds.acceleration_mps2
    short = asked(2, (0.0, 4.0), [()] * 5, course, bounds, 10)
    assert isinstance(short, Move)
    assert short.acceleration_mps2 == pytest.approx(bounds.acceleration_mps2)  # 4 m: acceleration decides
    assert short.speed_mps < bounds.speed_mps


def test_a_repeated_wish_restarts_nothing() -> None:
    course, bounds = course_and_bounds(fleet_with())
    move = asked(2, (0.0, 20.0), [()] * 5, course, bounds, 0)
    assert isinstance(move, Move)
    plans: list[Plan] = [(), (), (move,), (), ()]
    for frame in range(0, 299, 7):
        assert asked(2, (0.0, 20.0 + 0.9 * LEAST_MOVE_M), plans, course, bounds, frame) is None


def test_a_wish_through_another_drone_is_cut_short_or_refused() -> None:
    """In a cross the left drone (slot 20 m left) may come to 12.8 m beside the middle one and no nearer."""
    course, bounds = course_and_bounds(fleet_with())
    assert bounds.separation_m == pytest.approx(10 + math.sqrt(2) * 5 * 0.4)
    move = asked(2, (0.0, -20.0), [()] * 5, course, bounds, 0)
    assert isinstance(move, Move)
    assert move.end_m == (0.0, -5.0)  # a quarter of it
    assert asked(2, (0.0, -39.0), [()] * 5, course, bounds, 0) == "would come too near drone 0"
    assert isinstance(asked(2, (0.0, -39.0), [()] * 5, course, bounds, 0, gone={0}), Move), "nobody is there any more"


def test_a_wish_for_where_another_is_going_waits_and_is_cut_short() -> None:
    course, bounds = course_and_bounds(fleet_with(drones=2, formation={"shape": "line"}))  # at (0, 0) and (0, 20)
    other = asked(1, (30.0, -20.0), [(), ()], course, bounds, 0)
    assert isinstance(other, Move)
    assert other.end_m == (30.0, -20.0)  # to (30, 0), as drone 0 wishes too
    assert asked(0, (30.0, 0.0), [(), (other,)], course, bounds, 1) == "would come too near drone 1"
    move = asked(0, (30.0, 0.0), [(), (other,)], course, bounds, 280)
    assert isinstance(move, Move)
    assert move.end_m == (15.0, 0.0)


def test_a_wish_that_would_leave_the_fence_some_day_is_cut_short_now() -> None:
    """Drone 4 flies 20 m right of the track, on the last leg at x = 40: 15 m farther out is within 58, 30 m is not."""
    fleet = fleet_with(viewpoints={"fence_m": [-100, -100, 60, 100]})
    course, bounds = course_and_bounds(fleet)
    assert bounds.fence_m == (-98, -98, 58, 98)
    move = asked(4, (0.0, -30.0), [()] * 5, course, bounds, 0)
    assert isinstance(move, Move)
    assert move.end_m == (0.0, -15.0)
    assert asked(4, (0.0, -40.0), [(), (), (), (), (move,)], course, bounds, 200) == "would leave the fence"


def test_a_fence_that_the_formation_leaves_is_no_fence_to_fly_in() -> None:
    with pytest.raises(
        MotionError, match=r"fence_m \(-100.0, -100.0, 30.0, 100.0\) must hold every slot's way .* drone"
    ):
        course_and_bounds(fleet_with(viewpoints={"fence_m": [-100, -100, 30, 100]}))


def test_a_wish_beyond_the_reach_is_cut_short_in_its_direction_and_has_to_be_flown_before_the_next() -> None:
    fleet = fleet_with(drones=3, formation={"shape": "line", "spacing_m": 30.0}, route={"waypoints_m": [[0, 0]]})
    course, bounds = course_and_bounds(fleet)
    far = asked(0, (300.0, -400.0), [()] * 3, course, bounds, 0)
    assert isinstance(far, Move)
    assert far.end_m == pytest.approx((24.0, -32.0))  # forty metres that way
    assert asked(0, (300.0, -400.0), [(far,), (), ()], course, bounds, 10) is None
