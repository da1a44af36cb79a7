"""Manoeuvres: each changes its drone alone from its frame on, and the flight does not depend on how it is read."""

from __future__ import annotations

import random
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sortie.fleet.flight.manoeuvres import Appearance, Descent, Manoeuvre, Motion, Shifted, Steered
from sortie.fleet.flight.motion import OF_A_DRONE, Trajectories, attitude, fly, thrust_mps2
from sortie.fleet.flight.rotor import RotorPower, fleet_power_w
from sortie.fleet.flight.steering import GoTo, SteeredWay, Velocity, steer
from sortie.fleet.flight.viewpoints import Plan, ViewpointWish, bounds_of, course_of
from sortie.fleet.flight.ways import starts_m
from sortie.scenarios.schema import Airframe, Fleet

STILL = {"pose_jitter_m": 0.0, "gust_sigma_mps": 0.0, "wind_mps": (0.0, 0.0)}
ERRORS = {"pose_error_m": 2.0, "heading_error_deg": 5.0}
ROUND = {"waypoints_m": [(0.0, 0.0), (60.0, 0.0), (60.0, 200.0)], "speed_mps": 5.0}
HOVERS = {"waypoints_m": [(0.0, 0.0)]}


def fleet_of(route: object = ROUND, **motion: object) -> Fleet:
    """Four drones."""
    return Fleet.model_validate({"drones": 4, "route": route, "motion": {**ERRORS, **motion}})


class Pilots:
    """Makes manoeuvres of a fleet's drones, one after another."""

    def __init__(self, fleet: Fleet, motion: Motion) -> None:
        self.fleet, self.motion = fleet, motion
        self.course, self.bounds = course_of(fleet, np.asarray(motion.nominal.time_s)), bounds_of(fleet)
        self.plans: list[Plan] = [()] * fleet.drones
        self.starts_m = starts_m(fleet)

    def shifted(self, drone: int, frame: int, wanted_m: tuple[float, float]) -> Shifted:
        wish = ViewpointWish(drone, wanted_m, self.plans, self.course, self.bounds, frame)
        move = wish.attempt(1.0)
        self.plans[drone] = (*self.plans[drone], *([] if move is None else [move]))
        return Shifted(drone, frame, self.plans[drone], self.course)

    def steered(self, drone: int, frame: int, command: GoTo | Velocity) -> Steered:
        x, y, z = self.starts_m[drone].tolist()
        here, now_s = (x, y, z), float(self.motion.nominal.time_s[frame])
        way = steer(SteeredWay(now_s, here, (0.0, 0.0, 0.0)), command, now_s, self.fleet.steering)
        return Steered(drone, frame, way, here)

    def descent(self, drone: int, frame: int, descent_mps: float) -> Descent:
        return Descent(drone, frame, float(self.motion[frame : frame + 1].position_m[0, drone, 2]), descent_mps)


def differing(one: Trajectories, other: Trajectories) -> list[str]:
    """What differs by a bit or more."""
    names = [each.name for each in fields(one)]
    return [name for name in names if getattr(one, name).tobytes() != getattr(other, name).tobytes()]


def without(flown: Trajectories, drone: int) -> Trajectories:
    names = (*OF_A_DRONE, "wind_mps")
    return replace(flown, **{name: np.delete(getattr(flown, name), drone, 1) for name in names})


@pytest.mark.parametrize("kind", ["shifted", "steered", "descent"])
def test_a_manoeuvre_changes_its_drone_alone_from_its_frame_on_and_keeps_the_errors_of_its_belief(kind: str) -> None:
    fleet = fleet_of(HOVERS if kind == "steered" else ROUND)
    nominal = fly(fleet, 30.0, 0.1, seed=3)
    motion = Motion(nominal)
    pilots = Pilots(fleet, motion)
    made = {
        "shifted": lambda: pilots.shifted(2, 50, (5.0, 30.0)),
        "steered": lambda: pilots.steered(2, 50, GoTo(40.0, -10.0, 50.0)),
        "descent": lambda: pilots.descent(2, 50, 2.0),
    }
    motion.change([made[kind]()])
    flown = motion[:]
    assert differing(motion[:50], nominal[:50]) == []
    assert not flown.position_m.flags.writeable
    assert differing(without(flown, 2), without(nominal, 2)) == []
    assert np.abs(flown.position_m[-1, 2] - nominal.position_m[-1, 2]).max() > 10
    off = [m.est_position_m - m.position_m for m in (nominal, flown)]
    np.testing.assert_allclose(off[1], off[0], atol=1e-9)
    turn = [np.mod(m.est_yaw_rad - m.yaw_rad + np.pi, 2 * np.pi) for m in (nominal, flown)]
    np.testing.assert_allclose(turn[1], turn[0], atol=1e-9)
    np.testing.assert_array_equal(motion.rest_m(120), flown.position_m[120:])
    if kind != "descent":  # it tilts as its motion and its own wind need, and looks ahead of the formation, or east
        thrust = thrust_mps2(flown.velocity_mps, flown.acceleration_mps2, flown.wind_mps)[50:, 2]
        heading = flown.frame_yaw_rad[50:] if kind == "shifted" else np.zeros(len(thrust))
        apart = Rotation.from_quat(flown.orientation_xyzw[50:, 2]).inv() * Rotation.from_quat(attitude(thrust, heading))
        assert apart.magnitude().max() < 1e-9
        assert ((flown.orientation_xyzw[1:] * flown.orientation_xyzw[:-1]).sum(axis=-1) > 0).all()
    for frame in (0, 49, 50, 299):
        here_m, up = motion.poses(slice(frame, frame + 1))
        np.testing.assert_array_equal(here_m[0], flown.position_m[frame])
        tilted = Rotation.from_quat(flown.orientation_xyzw[frame]).apply((0.0, 0.0, 1.0))
        np.testing.assert_allclose(up[0], tilted, atol=1e-12)


def test_a_move_in_a_turn_has_the_velocity_and_acceleration_of_its_place() -> None:
    """Turning frame, moving slot: no term of the derivatives is missing. A drone that descends goes on descending."""
    fleet = fleet_of(**STILL)
    motion = Motion(fly(fleet, 40.0, 0.05, 3))
    pilots = Pilots(fleet, motion)
    motion.change([pilots.descent(2, 100, 1.0)])
    down = motion[:].position_m[..., 2].copy()
    motion.change([pilots.shifted(2, 200, (18.0, -20.0))])
    flown, rest = motion[:], slice(202, 780)
    for value, rate in ((flown.position_m, flown.velocity_mps), (flown.velocity_mps, flown.acceleration_mps2)):
        numeric = np.gradient(value[:, 2, :2], 0.05, axis=0)
        np.testing.assert_allclose(rate[rest, 2, :2], numeric[rest], atol=0.03)
    assert np.abs(flown.acceleration_mps2[rest, 2, :2]).max() > 0.5
    assert flown.velocity_mps[250, 2, 2] == -1.0
    np.testing.assert_array_equal(flown.position_m[..., 2], down)


def test_whatever_follows_whatever_a_velocity_is_the_slope_of_its_place() -> None:
    """A drone goes home, moves within the formation and comes back, in any order: each keeps what it leaves alone."""
    fleet = fleet_of(HOVERS, **STILL)
    nominal = fly(fleet, 30.0, 0.1, 3)
    for order in (("descends", "moves"), ("moves", "descends"), ("descends", "moves", "appears")):
        motion = Motion(nominal)
        pilots = Pilots(fleet, motion)
        for frame, what in zip((50, 100, 200), order, strict=False):
            made: dict[str, Manoeuvre] = {"appears": Appearance(2, frame), "descends": pilots.descent(2, frame, 1.5)}
            motion.change([pilots.shifted(2, frame, (5.0, 15.0)) if what == "moves" else made[what]])
        flown = motion[:]
        slope = (flown.position_m[2:, 2] - flown.position_m[:-2, 2]) / 0.2
        off = np.abs(slope - flown.velocity_mps[1:-1, 2])
        jumps = np.zeros(len(off), bool)  # a descent begins at once, and who joins appears in its slot
        for frame in (50, 100, 200):
            jumps[frame - 2 : frame + 1] = True
        assert off[~jumps].max() < 0.02, order
        assert np.abs(flown.velocity_mps[60:, 2, 2]).max() == pytest.approx(1.5)


def test_a_descent_keeps_the_error_of_the_height_and_who_appears_is_at_the_height_of_its_way() -> None:
    """Of a fleet that believes to be 3 m higher than it is."""
    true = fly(Fleet(drones=3), 30.0, 0.1, 2)
    nominal = replace(true, est_position_m=true.est_position_m + np.array([0.0, 0.0, 3.0]))
    motion = Motion(nominal)
    motion.change([Descent(1, 40, float(nominal.position_m[40, 1, 2]), 4.0)])
    down = motion[:]
    wanted = np.maximum(0.0, nominal.position_m[40, 1, 2] - 4.0 * (nominal.time_s[40:] - nominal.time_s[40]))
    assert (wanted <= 0.0).any()
    np.testing.assert_allclose(down.position_m[40:, 1, 2], wanted)
    np.testing.assert_allclose(down.est_position_m[..., 2] - down.position_m[..., 2], 3.0)
    np.testing.assert_array_equal(down.velocity_mps[40:, 1, 2], np.where(wanted <= 0.0, 0.0, -4.0))
    was = {name: getattr(down, name).copy() for name in ("position_m", "velocity_mps", "est_position_m")}
    motion.change([Appearance(1, 120)])
    for name, before in was.items():
        then, planned = getattr(motion[:], name), getattr(nominal, name)
        np.testing.assert_array_equal(then[120:], planned[120:])
        np.testing.assert_array_equal(then[:120], before[:120])
        np.testing.assert_array_equal(before[..., :2], planned[..., :2])


@pytest.mark.parametrize("frames", [1, 2, 33, 64, 129])
def test_a_flight_is_the_same_bit_for_bit_however_it_is_read(frames: int) -> None:
    """One is read here and there between manoeuvres, the other at the end alone; frames that were flown stay."""
    for seed in range(6):
        draw, fleet = random.Random(seed), fleet_of()
        nominal = fly(fleet, 0.1 * frames, 0.1, seed)
        often, once = Motion(nominal), Motion(nominal)
        pilots, down = Pilots(fleet, often), set[int]()
        frame, settled = 0, []
        while frame < frames:
            drone = draw.randrange(4)
            if drone in down:
                down.remove(drone)
                manoeuvre: Manoeuvre = Appearance(drone, frame)
            elif draw.random() < 0.3:
                down.add(drone)
                manoeuvre = pilots.descent(drone, frame, 3.0)
            else:
                manoeuvre = pilots.shifted(drone, frame, (draw.uniform(-40, 40), draw.uniform(-40, 40)))
            for motion in (often, once):
                motion.change([manoeuvre])
            begin = frame
            frame += draw.choice([0, 1, 2, 31, 40])
            for _ in range(draw.choice([0, 1, 3])):
                read = draw.randrange(frames)
                often[read : read + draw.choice([1, 2, 32])]
            now = slice(begin, min(frame, frames))
            settled.append((now, {each.name: getattr(often[now], each.name).tobytes() for each in fields(nominal)}))
        assert differing(often[:], once[:]) == [], seed
        for when, states in settled:
            kept = {name for name, data in states.items() if getattr(often[when], name).tobytes() == data}
            assert kept == states.keys(), seed


def test_what_rotors_draw_follows_the_manoeuvres_and_a_custom_model_sees_the_whole_flight(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[int] = []

    def heavy(air: np.ndarray, push: np.ndarray, climb: np.ndarray, mass_kg: np.ndarray) -> np.ndarray:
        asked.append(len(climb))
        return np.asarray(50.0 + 99.0 * np.abs(climb) * mass_kg)

    monkeypatch.setattr("sortie.fleet.flight.rotor.resolve", lambda *_: heavy)
    for model in ("level", "own.py:heavy"):
        fleet = fleet_of(HOVERS).model_copy(update={"airframe": Airframe(power_model=model)})
        motion = Motion(fly(fleet, 20.0, 0.1, 3))
        rotors, before = RotorPower(fleet, motion), fleet_power_w(fleet, motion[:])
        motion.change([Pilots(fleet, motion).steered(1, 70, Velocity(0.0, 0.0, 3.0))])
        rotors.forget()
        after = fleet_power_w(fleet, motion[:])
        for frame in (0, 69, 70, 90, 199):
            np.testing.assert_array_equal(rotors.at(frame), after[frame])
        np.testing.assert_array_equal(before[:70], after[:70])
        assert (np.abs(after - before).max(axis=0) > 1.0).tolist() == [False, True, False, False], model
    assert asked == [200] * 4  # at first, after the change, and twice by this test
