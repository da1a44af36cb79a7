"""Flights that other parts change: descents, moves and steering, traces in place of models, and what a drone believes of each.

1. A descent changes the height alone, and keeps the error of what is believed of it; who comes back flies level again.
2. Moves in a turning formation: velocity and acceleration are those of the place, whoever descends meanwhile.
3. Steering: who is beyond a bound may come nearer to it, and the fence keeps room for the jitter.
4. Traces: places on the globe, compass headings, gaps, and what a traced drone believes.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sortie.fleet.flight.descent import descending, level_again
from sortie.fleet.flight.displaced import displaced, steered
from sortie.fleet.flight.motion import DRAG_PER_S, GRAVITY_MPS2, Trajectories, attitude, fly
from sortie.fleet.flight.steering import GoTo, Hold, SteeredWay, Velocity, nearest_m, refusal, steer, steered_area_m
from sortie.fleet.flight.viewpoints import Move, bounds_of, course_of, grant, shifts
from sortie.fleet.traces import flown_at, flown_motion, follow, read_traces
from sortie.scenarios.schema import Fleet, Origin, Steering

STILL_AIR = {"wind_mps": (0.0, 0.0), "gust_sigma_mps": 0.0}
TURNING = {"waypoints_m": [(0.0, 0.0), (60.0, 0.0), (60.0, 200.0)], "speed_mps": 5.0}


def off_in_height(motion: Trajectories) -> Trajectories:
    """The flight of a fleet that believes to be 3 m higher than it is."""
    return replace(motion, est_position_m=motion.est_position_m + np.array([0.0, 0.0, 3.0]))


def test_a_descent_changes_the_height_of_one_drone_and_keeps_its_error() -> None:
    flown = off_in_height(fly(Fleet(drones=3), 30.0, 0.1, 2))
    down = descending(flown, 1, 40, 4.0)
    height_m = down.position_m[:, 1, 2]
    begin_m = flown.position_m[40, 1, 2]
    wanted = np.maximum(0.0, begin_m - 4.0 * (flown.time_s[40:] - flown.time_s[40]))
    np.testing.assert_allclose(height_m[40:], wanted)
    np.testing.assert_allclose(down.est_position_m[..., 2] - down.position_m[..., 2], 3.0)
    on_ground = wanted <= 0.0
    assert on_ground.any()
    np.testing.assert_array_equal(down.velocity_mps[40:, 1, 2], np.where(on_ground, 0.0, -4.0))
    for name in ("position_m", "velocity_mps", "est_position_m"):
        was, now = getattr(flown, name), getattr(down, name)
        np.testing.assert_array_equal(now[:40], was[:40])
        np.testing.assert_array_equal(now[:, [0, 2]], was[:, [0, 2]])
        np.testing.assert_array_equal(now[..., :2], was[..., :2])


def test_who_comes_back_is_where_it_would_have_been() -> None:
    """Place, belief and speed; the frames of its descent stay."""
    flown = off_in_height(fly(Fleet(drones=2), 20.0, 0.1, 2))
    down = descending(flown, 1, 40, 4.0)
    back = level_again(down, flown, 1, 120)
    for name in ("position_m", "velocity_mps", "est_position_m"):
        np.testing.assert_array_equal(getattr(back, name)[120:], getattr(flown, name)[120:])
        np.testing.assert_array_equal(getattr(back, name)[:120], getattr(down, name)[:120])


def test_a_move_in_a_turn_has_the_velocity_and_acceleration_of_its_place() -> None:
    """Turning frame, moving slot: no term of the two derivatives is missing. A drone that descends goes on descending."""
    fleet = Fleet.model_validate({"route": TURNING, "motion": {**STILL_AIR, "pose_jitter_m": 0.0}})
    base = fly(fleet, 40.0, 0.05, 3)
    down = descending(base, 2, 100, 1.0)
    course = course_of(fleet, np.asarray(base.time_s))
    move = grant(2, (18.0, -20.0), [()] * 5, course, bounds_of(fleet), 200)
    assert isinstance(move, Move)
    moved = displaced(down, base, course, [(), (), (move,), (), ()], 200)
    rest = slice(202, 780)
    for value, rate in ((moved.position_m, moved.velocity_mps), (moved.velocity_mps, moved.acceleration_mps2)):
        numeric = np.gradient(value[:, 2, :2], 0.05, axis=0)
        np.testing.assert_allclose(rate[rest, 2, :2], numeric[rest], atol=0.03)
    assert np.abs(moved.acceleration_mps2[rest, 2, :2]).max() > 0.5
    assert moved.velocity_mps[250, 2, 2] == -1.0
    np.testing.assert_array_equal(moved.position_m[..., 2], down.position_m[..., 2])
    assert ((moved.orientation_xyzw[1:] * moved.orientation_xyzw[:-1]).sum(axis=-1) > 0).all()


def test_a_steered_drone_tilts_as_its_motion_and_its_own_wind_ask() -> None:
    fleet = Fleet.model_validate({"drones": 2, "motion": {"pose_error_m": 2.0, "heading_error_deg": 5.0}})
    base = fly(fleet, 10.0, 0.1, 3)
    way = steer(SteeredWay(3.0, (0.0, 0.0, 60.0), (0.0, 0.0, 0.0)), Velocity(6.0, -3.0, 1.0), 3.0, Steering())
    shift, speed, push = way.at(base.time_s[30:])
    shift = shift - np.array([0.0, 0.0, 60.0])
    moved = steered(base, base, {1: (shift, speed, push)}, 30)
    np.testing.assert_allclose(moved.position_m[30:, 1], base.position_m[30:, 1] + shift)
    np.testing.assert_allclose(
        moved.est_position_m - moved.position_m, base.est_position_m - base.position_m, atol=1e-9
    )
    thrust = moved.acceleration_mps2[30:, 1] + DRAG_PER_S * (moved.velocity_mps[30:, 1] - base.wind_mps[30:, 1])
    thrust[:, 2] += GRAVITY_MPS2
    wanted = Rotation.from_quat(attitude(thrust, np.zeros(len(thrust))))
    apart = (Rotation.from_quat(moved.orientation_xyzw[30:, 1]).inv() * wanted).magnitude()
    assert apart.max() < 1e-9
    turn = [np.mod(m.est_yaw_rad - m.yaw_rad + np.pi, 2 * np.pi) for m in (base, moved)]
    np.testing.assert_allclose(turn[1], turn[0], atol=1e-9)
    assert ((moved.orientation_xyzw[1:] * moved.orientation_xyzw[:-1]).sum(axis=-1) > 0).all()


def test_a_shift_and_its_derivatives_are_of_all_moves_so_far() -> None:
    moves = (Move(1.0, 4.0, (0.0, 0.0), (8.0, 3.0)), Move(6.0, 5.0, (8.0, 3.0), (-2.0, 1.0)))
    time_s = np.arange(0.0, 13.0, 0.01)
    place, rate, change = shifts(moves, time_s)
    np.testing.assert_allclose(np.gradient(place, 0.01, axis=0)[1:-1], rate[1:-1], atol=1e-3)
    np.testing.assert_allclose(np.gradient(rate, 0.01, axis=0)[1:-1], change[1:-1], atol=0.02)
    np.testing.assert_allclose(place[550], (8.0, 3.0))
    np.testing.assert_allclose(place[-1], (-2.0, 1.0))


# --- the safety of moves -------------------------------------------------------------------------------------


def fleet_of(**viewpoints: Any) -> Fleet:
    return Fleet.model_validate(
        {"drones": 3, "formation": {"shape": "line", "spacing_m": 30.0}, "viewpoints": viewpoints}
    )


def test_who_has_left_is_in_nobody_s_way() -> None:
    """Drone 1 is 30 m to the left of drone 0: to its place only once it is gone."""
    fleet = fleet_of()
    course = course_of(fleet, np.arange(0.0, 60.0, 0.1))
    there, gone = (grant(0, (0.0, 30.0), [()] * 3, course, bounds_of(fleet), 0, gone=g) for g in ((), (1,)))
    assert isinstance(there, Move)
    assert isinstance(gone, Move)
    assert there.end_m == pytest.approx((0.0, 15.0))  # half of it: three quarters would come within ten metres
    assert gone.end_m == pytest.approx((0.0, 30.0))


def test_places_keep_room_for_both_drones_jitter() -> None:
    """Each keeps five times its own, and two of them the root of two."""
    bounds = bounds_of(fleet_of(fence_m=(-99.0, -98.0, 97.0, 96.0)))
    assert bounds.separation_m == pytest.approx(10.0 + 5 * 0.4 * np.sqrt(2))
    assert bounds.fence_m == pytest.approx((-97.0, -96.0, 95.0, 94.0))
    course = course_of(fleet_of(), np.arange(0.0, 60.0, 0.1))
    far = grant(0, (300.0, -400.0), [()] * 3, course, bounds, 0)
    assert isinstance(far, Move)
    assert far.end_m == pytest.approx((24.0, -32.0))  # forty metres that way
    assert grant(0, (300.0, -400.0), [(far,), (), ()], course, bounds, 10) is None  # it has to arrive first


# --- steering --------------------------------------------------------------------------------------------------


def reason(
    place: tuple[float, float, float], *to: float, start: tuple[float, float, float] = (0, 0, 60), **limits: Any
) -> str:
    fleet = Fleet.model_validate({"steering": limits, "motion": {"pose_jitter_m": 0.5}})
    way = steer(SteeredWay(0.0, place, (0.0, 0.0, 0.0)), GoTo(*to), 0.0, fleet.steering)
    return refusal(way, 0.0, np.array(start, float), fleet)


def test_who_is_beyond_a_bound_may_come_nearer_and_no_farther() -> None:
    assert reason((0, 0, 60), 190, 0) == ""
    assert reason((0, 0, 60), 210, 0) == "would leave its reach of 200 m"
    assert reason((230, 0, 60), 220, 0) == ""
    assert reason((230, 0, 60), 240, 0) == "would leave its reach of 200 m"
    assert reason((0, 0, 5), 0, 0, 8) == ""
    assert reason((0, 0, 5), 0, 0, 4).startswith("would leave the altitudes")
    assert reason((0, 0, 130), 0, 0, 125) == ""
    assert reason((0, 0, 130), 0, 0, 135).startswith("would leave the altitudes")
    fence = {"fence_m": (-50.0, -50.0, 50.0, 50.0)}
    assert reason((0, 0, 60), 47, 0, **fence) == ""
    assert reason((0, 0, 60), 48, 0, **fence) == "would leave the fence"  # five jitters of half a metre
    assert reason((0, 0, 60), 0, -48, **fence) == "would leave the fence"
    assert reason((60, 0, 60), 55, 0, **fence) == ""
    assert reason((60, 0, 60), 65, 0, **fence) == "would leave the fence"


def test_a_share_of_a_command_is_a_share_of_its_way_or_of_its_velocity() -> None:
    still = SteeredWay(0.0, (0.0, 0.0, 60.0), (0.0, 0.0, 0.0))
    for share in (1.0, 0.5):
        np.testing.assert_allclose(
            steer(still, GoTo(40.0, 0.0), 0.0, Steering(), share).end_m, (40.0 * share, 0, 60), atol=1e-6
        )
        fast = steer(still, Velocity(0.0, 6.0), 0.0, Steering(), share)
        assert fast.at(np.arange(0.0, 20.0, 0.01))[1][:, 1].max() == pytest.approx(6.0 * share)
    slow = Steering(acceleration_mps2=0.5)
    long = steer(still, Velocity(0.0, 6.0), 0.0, slow)  # it takes 27 s to get so fast, and then as long to rest
    velocity = long.at(np.arange(0.0, 80.0, 0.01))[1][:, 1]
    assert velocity.max() == pytest.approx(6.0)
    assert velocity.min() >= -1e-9
    assert steer(long, Hold(), 5.0, slow).until(5.0)[1] == pytest.approx(27.0)


def test_planners_may_fly_where_their_reach_and_the_fence_both_allow() -> None:
    """About where each of them begins: of the formation, of groups, or of both, as they have one."""
    groups = ({"drones": [2], "route": {"waypoints_m": [[500.0, 0.0]]}},)
    of = {"drones": 3, "formation": {"shape": "line", "spacing_m": 30.0}, "groups": groups}
    fleet = Fleet.model_validate({**of, "steering": {"reach_m": 100.0}})
    fenced = Fleet.model_validate({**of, "steering": {"reach_m": 100.0, "fence_m": (-60.0, -500.0, 700.0, 90.0)}})
    assert steered_area_m(fleet, lambda each: True) == pytest.approx((-100.0, -100.0, 600.0, 130.0))
    assert steered_area_m(fleet, lambda each: each is fleet) == pytest.approx((-100.0, -100.0, 100.0, 130.0))
    assert steered_area_m(fleet, lambda each: each is not fleet) == pytest.approx((400.0, -100.0, 600.0, 100.0))
    assert steered_area_m(fenced, lambda each: True) == pytest.approx((-60.0, -100.0, 600.0, 90.0))
    assert steered_area_m(fleet, lambda each: False) is None


@pytest.mark.parametrize("at", [0.1, 0.5, 0.9])
def test_how_near_two_come_is_seen_between_frames(at: float) -> None:
    """One flies past, and is nearest at any part of a frame."""
    ours = np.zeros((3, 3))
    others = np.zeros((3, 1, 3))
    others[:, 0, 0] = np.array([0.0, 10.0, 20.0]) - 10.0 * at
    others[:, 0, 1] = 2.0
    assert nearest_m(ours, others) == pytest.approx([2.0])


# --- traces ----------------------------------------------------------------------------------------------------


def trace(folder: Path, columns: str, *rows: str) -> str:
    (folder / "t.csv").write_text("\n".join([columns, *rows]) + "\n")
    return str(folder / "t.csv")


def test_a_trace_on_the_globe_is_placed_at_its_first_place_and_lowest_altitude(tmp_path: Path) -> None:
    """Of all drones; an origin stands in its place. Heights are those above the origin, however far it flies."""
    name = trace(
        tmp_path,
        "t_s,drone,lat_deg,lon_deg,alt_m",
        "0,0,47,8,450",
        "10,0,47.09,8,450",
        "0,1,47,8.01,420",
        "10,1,47,8.01,500",
    )
    traces = read_traces(name, 2)
    first, second = (traces[i].pose for i in (0, 1))
    assert first is not None
    assert second is not None
    assert first.position_m[0] == pytest.approx((0.0, 0.0, 30.0), abs=1e-6)
    assert first.position_m[1, 2] == pytest.approx(30.0, abs=1e-9)  # ten kilometres off
    assert second.position_m[:, 2] == pytest.approx((0.0, 80.0))
    fleet = Fleet(drones=2, trace=name)
    assert flown_at(fleet) == Origin(latitude_deg=47.0, longitude_deg=8.0, altitude_m=420.0)
    origin = Origin(latitude_deg=47.0, longitude_deg=8.0, altitude_m=400.0)
    own = fleet.model_copy(update={"origin": origin})
    assert flown_at(own) == origin
    assert flown_at(own.model_copy(update={"trace": None})) == origin
    motion, _ = flown_motion(own, 1.0, 0.1, 1)
    assert motion.position_m[0, :, 2] == pytest.approx((50.0, 20.0))


def test_compass_roll_and_pitch_are_those_of_an_aircraft(tmp_path: Path) -> None:
    """Heading east, nose 10° up, right side 20° down; an empty cell is level."""
    name = trace(tmp_path, "t_s,x_m,y_m,z_m,heading_deg,roll_deg,pitch_deg", "0,0,0,50,90,20,10", "1,0,0,50,90,,")
    pose = read_traces(name, 1)[0].pose
    assert pose is not None
    assert pose.orientation_xyzw is not None
    tilted, level = (Rotation.from_quat(q).as_matrix() for q in pose.orientation_xyzw)
    np.testing.assert_allclose(level, np.eye(3), atol=1e-12)
    assert np.degrees(np.arcsin(tilted[2, 0])) == pytest.approx(10.0)  # the nose
    assert tilted[2, 1] == pytest.approx(np.sin(np.radians(20)) * np.cos(np.radians(10)))  # the left side is up


def test_an_attitude_that_is_missing_is_the_nearest_in_time(tmp_path: Path) -> None:
    rows = [f"{t},{t},0,50,{yaw}" for t, yaw in ((0, 10), (1, ""), (2, ""), (3, ""), (4, 50))]
    pose = read_traces(trace(tmp_path, "t_s,x_m,y_m,z_m,yaw_deg", *rows), 1)[0].pose
    assert pose is not None
    assert pose.orientation_xyzw is not None
    yaw = np.degrees(2 * np.arcsin(pose.orientation_xyzw[:, 2]))
    assert yaw[[0, 1, 3, 4]] == pytest.approx([10, 10, 50, 50])


def test_a_traced_drone_believes_with_the_errors_of_its_model(tmp_path: Path) -> None:
    """Of its place and of its heading; the others keep theirs."""
    fleet = Fleet.model_validate({"drones": 2, "motion": {"pose_error_m": 3.0, "heading_error_deg": 10.0}})
    name = trace(tmp_path, "t_s,drone,x_m,y_m,z_m,yaw_deg", "0,1,100,0,40,170", "5,1,100,50,40,-170")
    base = fly(fleet, 5.0, 0.1, 1)
    flown = follow(base, read_traces(name, 2), 0.1)
    np.testing.assert_allclose(
        flown.position_m[:, 1], np.stack([np.full(50, 100.0), base.time_s * 10, np.full(50, 40.0)], -1)
    )
    np.testing.assert_allclose(
        flown.est_position_m - flown.position_m, base.est_position_m - base.position_m, atol=1e-9
    )
    turn = [np.mod(m.est_yaw_rad - m.yaw_rad + np.pi, 2 * np.pi) for m in (base, flown)]
    np.testing.assert_allclose(turn[1], turn[0], atol=1e-9)
    assert np.abs(flown.est_yaw_rad).max() <= np.pi
    assert np.ptp(turn[0]) > 0.1
