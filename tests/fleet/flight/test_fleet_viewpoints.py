"""Moves and descents: whatever is asked for, places keep their distance, and what is flown hangs together."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sortie.fleet.flight.descent import descending, level_again
from sortie.fleet.flight.displaced import displaced
from sortie.fleet.flight.motion import MotionError, Trajectories, fly
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
STILL = {"pose_jitter_m": 0.0, "gust_sigma_mps": 0.0}


def fleet_with(**changed: object) -> Fleet:
    """Five drones round a corner."""
    base: dict[str, object] = {"drones": 5, "route": {"waypoints_m": [[-40, 0], [20, 0], [20, 60]]}}
    return Fleet.model_validate(base | changed)


def course_and_bounds(fleet: Fleet, duration_s: float = 30.0) -> tuple[Course, Bounds]:
    return course_of(fleet, np.arange(0, duration_s, FRAME_S)), bounds_of(fleet)


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
    formation: dict[str, Any], limits: dict[str, Any], asked: list[tuple[int, int, float, float]]
) -> None:
    """At every instant, a hundredth of a second apart: distance, fence, reach, speed and acceleration."""
    fleet = fleet_with(drones=6, formation=formation, viewpoints=limits, motion={"pose_jitter_m": 0.2})
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
    """Drone 4 flies 20 m right of the track, on the last leg at x = 40: 15 m farther out is within 58, 30 m is not."""
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


def test_a_wish_beyond_the_reach_is_cut_short_in_its_direction_and_has_to_be_flown_before_the_next() -> None:
    fleet = fleet_with(drones=3, formation={"shape": "line", "spacing_m": 30.0}, route={"waypoints_m": [[0, 0]]})
    course, bounds = course_and_bounds(fleet)
    far = grant(0, (300.0, -400.0), [()] * 3, course, bounds, 0)
    assert isinstance(far, Move)
    assert far.end_m == pytest.approx((24.0, -32.0))  # forty metres that way
    assert grant(0, (300.0, -400.0), [(far,), (), ()], course, bounds, 10) is None


# --- flights that other parts change ----------------------------------------------------------------------


def moved(flown: Trajectories, base: Trajectories, fleet: Fleet, wish: tuple[float, float], frame: int) -> Trajectories:
    """Drone 2 moves there within the formation, from this frame on."""
    course = course_of(fleet, np.asarray(base.time_s))
    plans: list[Plan] = [()] * 5
    move = grant(2, wish, plans, course, bounds_of(fleet), frame)
    assert isinstance(move, Move)
    plans[2] = (move,)
    return displaced(flown, base, course, plans, frame)


def test_a_move_changes_its_drone_alone_from_its_begin_on_and_keeps_the_errors_of_its_belief() -> None:
    fleet = fleet_with(motion={"pose_error_m": 2.0, "heading_error_deg": 5.0})
    base = fly(fleet, 30.0, FRAME_S, seed=3)
    flown = moved(base, base, fleet, (5.0, 30.0), 50)
    for each in fields(base):
        before, after = getattr(base, each.name), getattr(flown, each.name)
        assert np.array_equal(before[:50], after[:50]), each.name
        if before.ndim >= 2 and before.shape[1] == 5:
            assert np.array_equal(np.delete(before, 2, 1), np.delete(after, 2, 1)), each.name
    assert not flown.position_m.flags.writeable
    assert np.abs(flown.position_m[-1, 2] - base.position_m[-1, 2]).max() > 10
    off = [m.est_position_m - m.position_m for m in (base, flown)]
    np.testing.assert_allclose(off[1], off[0], atol=1e-9)
    turn = [np.mod(m.est_yaw_rad - m.yaw_rad + np.pi, 2 * np.pi) for m in (base, flown)]
    np.testing.assert_allclose(turn[1], turn[0], atol=1e-9)


def test_a_move_in_a_turn_has_the_velocity_and_acceleration_of_its_place() -> None:
    """Turning frame, moving slot: no term of the derivatives is missing. A drone that descends goes on descending."""
    turning = {"waypoints_m": [(0.0, 0.0), (60.0, 0.0), (60.0, 200.0)], "speed_mps": 5.0}
    fleet = Fleet.model_validate({"route": turning, "motion": {**STILL, "wind_mps": (0.0, 0.0)}})
    base = fly(fleet, 40.0, 0.05, 3)
    down = descending(base, 2, 100, 1.0)
    flown = moved(down, base, fleet, (18.0, -20.0), 200)
    rest = slice(202, 780)
    for value, rate in ((flown.position_m, flown.velocity_mps), (flown.velocity_mps, flown.acceleration_mps2)):
        numeric = np.gradient(value[:, 2, :2], 0.05, axis=0)
        np.testing.assert_allclose(rate[rest, 2, :2], numeric[rest], atol=0.03)
    assert np.abs(flown.acceleration_mps2[rest, 2, :2]).max() > 0.5
    assert flown.velocity_mps[250, 2, 2] == -1.0
    np.testing.assert_array_equal(flown.position_m[..., 2], down.position_m[..., 2])
    assert ((flown.orientation_xyzw[1:] * flown.orientation_xyzw[:-1]).sum(axis=-1) > 0).all()


def test_whatever_follows_whatever_a_velocity_is_the_slope_of_its_place() -> None:
    """A drone goes home, moves within the formation and comes back, in any order: each keeps what it leaves alone."""
    fleet = Fleet.model_validate({"motion": STILL})
    base = fly(fleet, 30.0, 0.1, 3)
    for order in (("descends", "moves"), ("moves", "descends"), ("descends", "moves", "climbs")):
        flown = base
        for frame, what in zip((50, 100, 200), order, strict=False):
            match what:
                case "moves":
                    flown = moved(flown, base, fleet, (5.0, 15.0), frame)
                case "descends":
                    flown = descending(flown, 2, frame, 1.5)
                case _:
                    flown = level_again(flown, base, 2, frame)
        slope = (flown.position_m[2:, 2] - flown.position_m[:-2, 2]) / 0.2
        off = np.abs(slope - flown.velocity_mps[1:-1, 2])
        jumps = np.zeros(len(off), bool)  # a descent begins at once, and who joins appears in its slot
        for frame in (50, 100, 200):
            jumps[frame - 2 : frame + 1] = True
        assert off[~jumps].max() < 0.02, order
        assert np.abs(flown.velocity_mps[60:, 2, 2]).max() == pytest.approx(1.5)
        errors = [m.est_position_m[:, 2] - m.position_m[:, 2] for m in (base, flown)]
        np.testing.assert_allclose(errors[1], errors[0], atol=1e-9)


def test_a_descent_changes_the_height_of_one_drone_and_keeps_its_error_until_it_comes_back() -> None:
    """Of a fleet that believes to be 3 m higher than it is. Who comes back is where it would have been."""
    true = fly(Fleet(drones=3), 30.0, 0.1, 2)
    flown = replace(true, est_position_m=true.est_position_m + np.array([0.0, 0.0, 3.0]))
    down = descending(flown, 1, 40, 4.0)
    wanted = np.maximum(0.0, flown.position_m[40, 1, 2] - 4.0 * (flown.time_s[40:] - flown.time_s[40]))
    np.testing.assert_allclose(down.position_m[40:, 1, 2], wanted)
    np.testing.assert_allclose(down.est_position_m[..., 2] - down.position_m[..., 2], 3.0)
    assert (wanted <= 0.0).any()
    np.testing.assert_array_equal(down.velocity_mps[40:, 1, 2], np.where(wanted <= 0.0, 0.0, -4.0))
    back = level_again(down, flown, 1, 120)
    for name in ("position_m", "velocity_mps", "est_position_m"):
        was, now, then = (getattr(m, name) for m in (flown, down, back))
        np.testing.assert_array_equal(now[:40], was[:40])
        np.testing.assert_array_equal(now[:, [0, 2]], was[:, [0, 2]])
        np.testing.assert_array_equal(now[..., :2], was[..., :2])
        np.testing.assert_array_equal(then[120:], was[120:])
        np.testing.assert_array_equal(then[:120], now[:120])
