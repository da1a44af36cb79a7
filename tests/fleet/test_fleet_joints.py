"""The fleet's joints: which argument goes where, two options together, drones that are stale or gone, independent draws.

Joints, each with a test below:

1. A drone's own value and the fleet's: an override replaces its make's, a make's replaces the fleet's; none adds to another.
2. Resistance, polarisation, cold, age and lost cells of a pack: each acts on each.
3. A pack that a trace drives, and faults.
4. Payload and airframe of each drone, in level flight and in climb.
5. Where a drone is and where it believes it is: its coverage, its claims and its region of cells go by its belief.
6. A drone's own cameras: footprint, view and capture.
7. Two clocks that are off: ages of descriptors and payloads, whoever is ahead; a clock told anew goes on as it went.
8. An older payload that comes after a newer one; one of a peer with another compute delay.
9. A peer's slot in a list of all but oneself.
10. Staleness and every field of a directive: representation, rate, weight, duty.
11. Two links that differ in one field: each gets its own payload.
12. A drone that leaves between its look and its sending, one that is on the ground, and one that comes back.
13. What a drone believes: doubted peers count for nothing in coverage and views; the fleet's fall leaves out who is judged, and ground stations.

Draws that must be independent: gusts, offsets, errors of position and heading, and clocks, of each drone and of each other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
import pytest
from agent_rig import Rig, capture, descriptor, hear, memory, payload
from fleet_examples import DESCRIPTOR
from scipy.spatial.transform import Rotation

from sortie.fleet.clock import WINDOW, Clock, oscillators
from sortie.fleet.computer import Work, headrooms
from sortie.fleet.coverage import Poses, View, cameras_of, footprint_radius_m, views
from sortie.fleet.energy.battery import RECORDED, FleetBatteries
from sortie.fleet.energy.cell import energy_fraction, open_circuit_cell_v, resistance_factor
from sortie.fleet.energy.recorded import BatteryTrace
from sortie.fleet.flight.displaced import displaced
from sortie.fleet.flight.motion import fly
from sortie.fleet.flight.rotor import climb_power_w, fleet_power_w, momentum_power_w, rotor_power_w
from sortie.fleet.flight.viewpoints import Move, bounds_of, course_of, grant
from sortie.fleet.lies import falsified
from sortie.fleet.memory import Received
from sortie.fleet.messages.wire import decode_descriptor
from sortie.fleet.plane import Equipment, equipment_of
from sortie.fleet.senses import FlightSenses, Sensed
from sortie.fleet.sensor_faults import sensor_errors
from sortie.fleet.trust import Arrival, goodput_doubt, judge
from sortie.perception.geometry import USUAL
from sortie.perception.scene.scene_model import SceneModel
from sortie.policies.contract import Directive, Disc, FleetView, Representation
from sortie.policies.staleness import DEGRADED_RATE_HZ, LinkHealth, cap_by_age
from sortie.scenarios.link_state import heard_share
from sortie.scenarios.reading.load import loads
from sortie.scenarios.schema import (
    Airframe,
    Battery,
    Clocks,
    Computer,
    DroneOverride,
    Fleet,
    Polarisation,
    Scenario,
    Scene,
)

PLAIN = SceneModel(Scene(building_density=0.0, tree_density=0.0), None, (-100.0, -100.0, 100.0, 100.0))


def scenario(text: str) -> Scenario:
    return loads(f"name: joints\nduration_s: 4\n{text}")


# --- one value in place of another -------------------------------------------------------------------


def test_an_override_stands_in_place_of_the_value_of_its_make_and_of_the_fleet() -> None:
    """Of every field; drones that it does not name keep theirs, and so do other fields."""
    fleet = scenario(
        """
fleet:
  airframe: {payload_kg: 0.3}
  battery: {initial_soc: 0.9, capacity_wh: 100, cell_resistance_mohm: 20, cycles: 50}
  makes: [{name: heavy, drones: [1, 2], airframe: {payload_kg: 0.7, mass_kg: 3}, battery: {initial_soc: 0.8, capacity_wh: 200}}]
  overrides:
    - {drone: 0, payload_kg: 0.1, initial_soc: 0.5}
    - {drone: 1, payload_kg: 0.0, capacity_wh: 60, cell_resistance_mohm: 5}
    - {drone: 3, cycles: 100}
"""
    ).fleet
    assert [a.payload_kg for a in fleet.airframes] == [0.1, 0.0, 0.7, 0.3, 0.3]
    assert [a.mass_kg for a in fleet.airframes] == [2.04, 3, 3, 2.04, 2.04]
    packs = FleetBatteries(fleet.batteries, fleet.overrides, 5)
    assert packs.soc == [0.5, 0.8, 0.8, 0.9, 0.9]
    aged = [1 - 0.2 * cycles / 300 for cycles in (50, 0, 0, 100, 50)]
    full_wh = [100 * aged[0], 60, 200, 100 * aged[3], 100 * aged[4]]
    for drone, (wh, soc) in enumerate(zip(full_wh, packs.soc, strict=True)):
        assert packs.energy_left_j[drone] == pytest.approx(wh * 3600 * float(energy_fraction(soc)))


def test_zero_is_a_value_of_a_make_and_not_a_missing_one() -> None:
    made = scenario(
        """
fleet:
  makes: [{name: quick, drones: [1], compute_delay_s: 0, tx_power_dbm: 0, altitude_offset_m: 0, feature_space: "", policy_params: {}}]
perception: {detector: none, compute_delay_s: 0.04}
"""
    )
    assert made.compute_delays_s == (0.04, 0.0, 0.04, 0.04, 0.04)
    assert [e.compute_delay_s for e in equipment_of(made).values()] == [0.04, 0.0, 0.04, 0.04, 0.04]


def test_a_make_may_fly_lower_than_the_fleet() -> None:
    fleet = scenario(
        "fleet: {drones: 3, formation: {altitude_m: 50}, makes: [{name: low, drones: [1], altitude_offset_m: -20}, "
        "{name: high, drones: [2], altitude_offset_m: 15}]}"
    ).fleet
    assert fleet.altitudes_m == (50.0, 30.0, 65.0)
    assert fly(fleet, 1.0, 0.1, 1).position_m[0, :, 2] == pytest.approx([50.0, 30.0, 65.0], abs=2.5)


# --- packs ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("cold", "cycles", "polarised"), list(product([None, -10.0], [0.0, 150.0], [0.0, 4.0])))
def test_cold_and_age_act_on_both_parts_of_the_resistance(cold: float | None, cycles: float, polarised: float) -> None:
    """Voltage of a loaded pack once polarisation has settled: both resistances times the factors of cold and of age."""
    pack = Battery(
        cell_resistance_mohm=6, ambient_c=cold, cycles=cycles, capacity_wh=5000,
        polarisation=Polarisation(resistance_mohm=polarised, time_s=0.05),
    )  # fmt: skip
    packs = FleetBatteries(pack, (), 1)
    for _ in range(12):
        packs.step(0.1, [170.0], [0.0], [0.0])
    worn = 1 + cycles / 300
    factor = resistance_factor(packs.temperature_c[0] if cold is not None else 25.0)
    open_v = 4 * float(open_circuit_cell_v(packs.soc[0]))
    drop_v = packs.current_a[0] * 4 * (6 + polarised) / 1000 * worn * factor
    assert packs.voltage_v[0] == pytest.approx(open_v - drop_v, abs=2e-3)
    assert drop_v > 0.3


def test_a_lost_cell_takes_its_voltage_energy_and_both_resistances() -> None:
    """A pack of four that loses one is a pack of three in the same state."""
    of = Battery(cell_resistance_mohm=15, capacity_wh=120, polarisation=Polarisation(resistance_mohm=5, time_s=1))
    four = FleetBatteries(of, (), 1)
    four.drop_cell(0)
    three = FleetBatteries(of.model_copy(update={"cells": 3, "capacity_wh": 90.0}), (), 1)
    for _ in range(50):
        for packs in (four, three):
            packs.step(0.1, [120.0], [0.5], [0.1])
        assert four.voltage_v[0] == pytest.approx(three.voltage_v[0], rel=1e-9)
        assert four.current_a[0] == pytest.approx(three.current_a[0], rel=1e-9)
        assert four.soc[0] == pytest.approx(three.soc[0], rel=1e-9)
    assert four.energy_left_j[0] == pytest.approx(three.energy_left_j[0])


def test_faults_of_a_traced_pack_stay_and_each_takes_of_what_is_left() -> None:
    """Half is gone at once, later a fifth; from then on the trace's fall is of the two fifths that are left."""
    soc = [0.9, 0.8, 0.7]
    energy = [float(energy_fraction(s)) for s in soc]
    trace = BatteryTrace([0.0, 10.0, 20.0], soc, energy, [], [], [], [])
    packs = FleetBatteries(Battery(capacity_wh=100), (), 1, {0: trace})
    packs.step(5.0, [0.0], [0.0], [0.0])
    half = packs.energy_left_j[0] / 2
    packs.fault(0, 0.5)
    assert packs.energy_left_j[0] == pytest.approx(half)
    packs.step(5.0, [0.0], [0.0], [0.0])
    left = 360_000 * energy[1] / 2
    assert packs.energy_left_j[0] == pytest.approx(left)
    packs.fault(0, 0.2)
    assert packs.energy_left_j[0] == pytest.approx(0.8 * left)
    packs.step(10.0, [0.0], [0.0], [0.0])
    assert packs.energy_left_j[0] == pytest.approx(360_000 * energy[2] * 0.4)
    lost = half + 0.2 * left
    assert packs.energy_j["fault"][0] == pytest.approx(lost)
    assert packs.spent_j[0] == pytest.approx(360_000 * (energy[0] - 0.4 * energy[2]))
    assert packs.energy_j[RECORDED][0] == pytest.approx(packs.spent_j[0] - lost)


def test_who_is_on_the_ground_draws_nothing_and_takes_off_with_what_is_left() -> None:
    packs = FleetBatteries(Battery(), (), 2)
    packs.step(1.0, [170.0] * 2, [1.0] * 2, [1.0] * 2)
    packs.land(0, "told to")
    left, spent = packs.energy_left_j[0], packs.spent_j[0]
    packs.step(1.0, [170.0] * 2, [1.0] * 2, [1.0] * 2)
    assert (packs.energy_left_j[0], packs.spent_j[0], packs.current_a[0]) == (left, spent, 0.0)
    assert packs.voltage_v[0] == pytest.approx(4 * float(open_circuit_cell_v(packs.soc[0])), abs=1e-3)
    packs.take_off(0)
    packs.step(1.0, [170.0] * 2, [1.0] * 2, [1.0] * 2)
    assert packs.energy_left_j[0] < left


def test_a_pack_that_takes_off_again_is_one_of_its_charge_that_never_flew() -> None:
    """What was polarised is gone at rest; voltage, current and what is spent go on from the charge alone."""
    of = Battery(capacity_wh=120, polarisation=Polarisation(resistance_mohm=8, time_s=30))
    flew = FleetBatteries(of, (), 1)
    for _ in range(60):
        flew.step(1.0, [170.0], [1.0], [0.1])
    flew.land(0, "told to")
    flew.take_off(0)
    fresh = FleetBatteries(of.model_copy(update={"initial_soc": flew.soc[0]}), (), 1)
    for _ in range(5):
        for packs in (flew, fresh):
            packs.step(1.0, [170.0], [1.0], [0.1])
        assert flew.voltage_v[0] == pytest.approx(fresh.voltage_v[0], rel=1e-6)
        assert flew.current_a[0] == pytest.approx(fresh.current_a[0], rel=1e-6)


@pytest.mark.parametrize("heavy", [(), (2, 0)])
@pytest.mark.parametrize("model", ["level", "momentum"])
def test_every_drone_pays_for_its_own_load_in_level_flight_and_in_climb(model: Any, heavy: tuple[int, ...]) -> None:
    """Also where drones of two kinds have numbers in turn, and each another load."""
    frame, large = Airframe(power_model=model), Airframe(power_model=model, mass_kg=4.0, disc_area_m2=0.9)
    fleet = Fleet(
        airframe=frame, drones=4, overrides=tuple(DroneOverride(drone=i, payload_kg=0.4 * i) for i in range(4)),
        makes=({"name": "large", "drones": heavy, "airframe": large},) if heavy else (),
    )  # fmt: skip
    motion = fly(fleet, 6.0, 0.1, 1)
    power_w = fleet_power_w(fleet, motion)
    assert (motion.velocity_mps[..., 2] > 0.05).any()
    for drone in range(4):
        own = (large if drone in heavy else frame).model_copy(update={"payload_kg": 0.4 * drone})
        if model == "momentum":
            wanted = momentum_power_w(
                motion.velocity_mps[:, drone] - motion.wind_mps[:, drone], motion.acceleration_mps2[:, drone], own
            )
        else:
            wanted = rotor_power_w(motion.air_speed_mps[:, drone], own)
            wanted = wanted + climb_power_w(motion.velocity_mps[:, drone, 2], own)
        np.testing.assert_allclose(power_w[:, drone], wanted, rtol=1e-9)


@pytest.mark.parametrize("velocity", [(8.0, 0.0, 0.0), (0.0, 0.0, 5.0), (6.0, 2.0, 3.0)])
def test_drag_takes_power_along_the_whole_way_through_the_air(velocity: tuple[float, float, float]) -> None:
    """Half of density, drag area and the cube of the speed: forward, upward and both."""
    still = np.zeros(3)
    with_drag, without = (
        float(momentum_power_w(np.array(velocity), still, Airframe(power_model="momentum", drag_area_m2=area)))
        for area in (0.04, 0.0)
    )
    assert with_drag - without == pytest.approx(0.5 * 1.225 * 0.04 * float(np.linalg.norm(velocity)) ** 3, rel=1e-6)


def test_a_drone_that_moves_within_the_formation_keeps_the_errors_of_its_belief() -> None:
    """And its neighbours' ways stay as they were."""
    fleet = Fleet.model_validate({"motion": {"pose_error_m": 2.0, "heading_error_deg": 5.0}})
    base = fly(fleet, 30.0, 0.1, 3)
    course = course_of(fleet, np.asarray(base.time_s))
    move = grant(2, (5.0, 15.0), [()] * 5, course, bounds_of(fleet), 50)
    assert isinstance(move, Move)
    moved = displaced(base, base, course, [(), (), (move,), (), ()], 50)
    off = [m.est_position_m - m.position_m for m in (base, moved)]
    np.testing.assert_allclose(off[1], off[0], atol=1e-9)
    turn = [np.mod(m.est_yaw_rad - m.yaw_rad + np.pi, 2 * np.pi) for m in (base, moved)]
    np.testing.assert_allclose(turn[1], turn[0], atol=1e-9)
    assert np.abs(moved.position_m[-1, 2] - base.position_m[-1, 2]).max() > 10
    others = [0, 1, 3, 4]
    np.testing.assert_array_equal(moved.position_m[:, others], base.position_m[:, others])
    np.testing.assert_array_equal(moved.position_m[:50], base.position_m[:50])


def test_headrooms_count_looks_maps_decisions_and_bytes() -> None:
    """By hand: each alone, and together."""
    computer = Computer(cpu_cores=4, decision_s=0.01, payload_mbps=100.0, driving_cores=2.0, fusion_s=0.02)
    before = Work(5, 5, 5, 5)
    cases = [
        (Work(15, 5, 5, 5), 1 - 2 * 10 * 0.03 / 8, 1 - 0.3 / 2),  # ten looks of 30 ms in 2 s, four cores
        (Work(5, 15, 5, 5), 1 - 2 * 10 * 0.02 / 8, 1 - 0.2 / 2),  # ten maps
        (Work(5, 5, 15, 5), 1 - 10 * 0.01 / 8, 1.0),
        (Work(5, 5, 5, 5_000_005), 1 - 40.0 / 100.0 / 8, 1.0),  # 40 Mb
        (Work(15, 15, 15, 5_000_005), 1 - (2 * 0.5 + 0.1 + 0.4) / 8, 1 - 0.5 / 2),
    ]
    for after, cpu, gpu in cases:
        assert headrooms(computer, 0.03, before, after, 2.0) == pytest.approx((cpu, gpu))


# --- where a drone believes it is -------------------------------------------------------------------------


def test_coverage_follows_from_where_a_drone_believes_it_is() -> None:
    """On a plain, where it truly is does not matter; where it believes it is moves the cells with it."""
    level = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (1, 1, 4))
    believed, heading = np.array([[[31.0, -17.0, 60.0]]]), np.zeros((1, 1))

    def view(true_m: Sequence[float], est_m: np.ndarray) -> View:
        at = np.array([[[*true_m, 60.0]]])
        ((seen,),) = views(Poses(at, level, heading, est_m, heading), PLAIN.height_field)
        return seen

    here = view((31.0, -17.0), believed)
    assert view((34.0, -14.0), believed) == here
    assert view((25.0, -19.0), believed) == here
    east = view((31.0, -17.0), believed + np.array([12.8, 0.0, 0.0]))
    assert (east.row, east.column, east.grid) == (here.row, here.column + 1, here.grid)
    north = view((31.0, -17.0), believed + np.array([0.0, 2 * 12.8, 0.0]))
    assert (north.row, north.column, north.grid) == (here.row + 2, here.column, here.grid)


def test_a_heading_error_turns_what_a_drone_believes_it_sees() -> None:
    """A drone that truly flies east and believes to fly north claims what one that flies north sees."""
    at, est = np.array([[[3.0, 4.0, 60.0]]]), np.array([[[3.0, 4.0, 60.0]]])

    def view(true_rad: float, est_rad: float) -> View:
        q = Rotation.from_euler("z", true_rad).as_quat()[None, None]
        ((seen,),) = views(
            Poses(at, q, np.array([[true_rad]]), est, np.array([[est_rad]])), PLAIN.height_field
        )  # fmt: skip
        return seen

    assert view(0.0, 1.0) == view(1.0, 1.0) != view(0.0, 0.0)


def test_every_drone_senses_with_its_own_cameras() -> None:
    fleet = scenario(
        "fleet: {drones: 3, makes: [{name: wide, drones: [1], camera: {field_of_view_deg: 100}, altitude_offset_m: 20}]}"
    ).fleet
    motion = fly(fleet, 4.0, 0.1, 1)
    cameras = cameras_of(fleet)
    assert cameras[1].field_of_view_deg == 100
    assert cameras[0] == cameras[2] == USUAL
    senses = FlightSenses(motion, 0.1, PLAIN.height_field, cameras)
    for frame in (0, 5, 35):
        for drone, sensed in enumerate(senses.at(frame)):
            z_m = motion.est_position_m[frame, drone, 2]
            assert sensed.capture.cameras == cameras[drone]
            assert sensed.footprint_radius_m == pytest.approx(footprint_radius_m(z_m, cameras[drone]))
            assert sensed.capture.position_m == tuple(motion.position_m[frame, drone])
            assert sensed.capture.est_position_m == tuple(motion.est_position_m[frame, drone])
            assert sensed.capture.est_yaw_rad == motion.est_yaw_rad[frame, drone]
            assert sensed.velocity_mps == tuple(motion.velocity_mps[frame, drone])
            assert sensed.capture.t_s == pytest.approx(0.1 * frame)
    tan = math.tan(math.radians(50)) / math.tan(math.radians(35))
    assert senses.at(0)[1].footprint_radius_m == pytest.approx(
        80 / 60 * tan * senses.at(0)[0].footprint_radius_m, rel=0.05
    )


def test_a_fault_of_a_drone_s_pose_is_in_all_that_it_says_of_itself_and_in_nothing_that_is_true() -> None:
    """East, north, height and heading: place, footprint, orientation and cells as it believes; its true pose as it flies."""
    fleet = Fleet(drones=2)
    motion, cameras = fly(fleet, 4.0, 0.1, 1), cameras_of(fleet)
    plain = FlightSenses(motion, 0.1, PLAIN.height_field, cameras)
    error = np.tile([3 * 12.8, -2 * 12.8, -20.0, 0.5], (40, 1))
    wrong = FlightSenses(motion, 0.1, PLAIN.height_field, cameras, {1: error})
    for frame in (0, 20, 39):
        assert wrong.at(frame)[0] == plain.at(frame)[0]
        was, now = plain.at(frame)[1], wrong.at(frame)[1]
        assert now.capture.position_m == was.capture.position_m
        assert now.capture.orientation_xyzw == was.capture.orientation_xyzw
        assert np.subtract(now.capture.est_position_m, was.capture.est_position_m) == pytest.approx(error[frame, :3])
        assert now.capture.est_yaw_rad - was.capture.est_yaw_rad == pytest.approx(0.5)
        assert now.footprint_radius_m == pytest.approx(footprint_radius_m(now.capture.est_position_m[2], cameras[1]))
        turn = Rotation.from_quat(now.orientation_xyzw) * Rotation.from_quat(was.orientation_xyzw).inv()
        assert turn.as_rotvec() == pytest.approx([0.0, 0.0, 0.5], abs=1e-9)
        assert (now.view.row, now.view.column) == (was.view.row - 2, was.view.column + 3)


# --- clocks -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rate", "growth"), [(0.0, 0.0), (40.0, 0.0), (-30.0, 900.0)])
def test_a_clock_told_anew_goes_on_as_it_went(rate: float, growth: float) -> None:
    clock = Clock(0.2, 3.0, rate, growth)
    for t_s in (3.0, 50.0, 400.0):
        for later_s in (t_s, t_s + 1.0, t_s + 500.0):
            assert clock.at(t_s).error_s(later_s) == pytest.approx(clock.error_s(later_s), abs=1e-12)
            assert clock.at(t_s).at(t_s + 7).error_s(later_s + 9) == pytest.approx(
                clock.error_s(later_s + 9), abs=1e-12
            )


@pytest.mark.parametrize("mine_s", [0.0, 3.0, -2.0])
@pytest.mark.parametrize("theirs_s", [0.0, 5.0, -4.0])
def test_ages_are_true_whoever_s_clock_is_off(mine_s: float, theirs_s: float) -> None:
    """Once the peer's clock is known: within half a frame, of descriptors and payloads, and never below the time since they came."""
    mine = memory()
    mine.status.clock_skew_s = mine_s
    for k in range(WINDOW + 2):
        t_s = 0.1 * k
        d = descriptor(1, t_s + theirs_s)
        mine.clocks.heard(1, t_s + 0.03 + mine_s - d.stamp_ns * 1e-9)
        mine.hold(d, t_s + 0.03)
    last_s = 0.1 * (WINDOW + 1)
    now_s = last_s + 0.4
    assert mine.ages_s(now_s)[1] == pytest.approx(0.4, abs=0.051)
    assert mine.ages_s(now_s)[1] >= 0.37 - 1e-9
    assert mine.ages_s(last_s + 0.03)[1] >= 0.0
    assert mine.in_own_time(1, last_s + theirs_s) == pytest.approx(last_s, abs=0.051)
    came = Received(capture(1, last_s), payload(), last_s + 0.06, last_s + theirs_s)
    assert mine.payload_age_s(came, now_s) == pytest.approx(0.4, abs=0.051)
    assert mine.payload_age_s(came, now_s) >= 0.34 - 1e-9
    late = Received(capture(1, last_s), payload(), now_s, last_s + 100.0)  # a stamp of the future
    assert mine.payload_age_s(late, now_s + 0.2) == pytest.approx(0.2)


def test_a_stamp_of_the_future_makes_no_descriptor_younger_than_it_is() -> None:
    """Also where offsets of other peers are known."""
    mine = memory()
    for k in range(WINDOW):
        mine.clocks.heard(2, 0.1 * k + 0.5 - 0.1 * k)
    assert 2 in mine.clocks.offset_s
    mine.hold(descriptor(2, 0.0), 0.0)
    mine.hold(descriptor(1, 50.0), 1.0)
    assert mine.ages_s(1.7)[1] == pytest.approx(0.7)


# --- payloads and peers ---------------------------------------------------------------------------------------


def test_the_newest_capture_is_held_whenever_it_came() -> None:
    mine = memory()
    new, old = (Received(capture(1, t), payload(), done, t) for t, done in ((0.5, 0.6), (0.4, 0.7)))
    mine.receive(new)
    mine.receive(old)
    assert mine.held[1] is new
    same = Received(capture(1, 0.5), payload(rung=Representation.DETECTIONS), 0.8, 0.5)
    mine.receive(same)
    assert mine.held[1] is same  # another payload of the same look
    assert mine.status.work.payload_bytes == 60_000
    assert mine.status.work.maps == 2
    mine.status.airborne = False
    mine.receive(Received(capture(1, 0.9), payload(), 1.0, 0.9))
    assert mine.held[1] is same


def test_how_long_a_payload_took_leaves_out_its_sender_s_compute_delay() -> None:
    """Its own, not the receiver's."""
    mine = memory(makes={0: Equipment(0.3), 1: Equipment(0.08), 2: Equipment(0.0)})
    for peer in (1, 2):
        mine.receive(Received(capture(peer, 1.0), payload(), 1.1, 1.0))
    took = {peer: mine._arrivals[peer][0].took_s for peer in (1, 2)}
    assert took == pytest.approx({1: 0.02, 2: 0.1})


@pytest.mark.parametrize("me", [0, 1, 2, 3])
def test_a_slot_is_of_the_peer_that_it_is_of(me: int) -> None:
    """Whoever one is: heard peers are probed, measured ones stay, and the rest is unknown."""
    for heard in set(range(4)) - {me}:
        mine = memory(me)
        for k in range(10):
            hear(mine, heard, 0.1 * k)
        peers = [i for i in range(4) if i != me]
        measured = [0.0, 0.0, 0.0]
        other = next(i for i in peers if i != heard)
        measured[peers.index(other)] = 55.0
        filled = dict(zip(peers, mine.probes.fill(np.array(peers), measured, 0.9), strict=True))
        assert heard_share(filled[heard]) == 1.0
        assert filled[other] == 55.0
        assert [v for i, v in filled.items() if i not in (heard, other)] == [0.0]


@pytest.mark.parametrize("duty", [100, 30, 0])
@pytest.mark.parametrize("link", [LinkHealth.DEGRADED, LinkHealth.DETACHED])
def test_staleness_leaves_duty_weight_deadline_and_region_as_they_were_asked(link: LinkHealth, duty: int) -> None:
    """It reduces what a link carries and how often; a link that carries nothing still says how often its drone is to look."""
    for rung, rate_hz in product(Representation, (0.5, DEGRADED_RATE_HZ, 10.0)):
        asked = Directive(2, 5, rung, 0.4, Disc(1, 2, 3), rate_hz, 0.7, 0.25, duty, "asked")
        capped = cap_by_age(asked, link, 0.6)
        assert (capped.source, capped.destination, capped.duty_percent) == (2, 5, duty)
        if link == LinkHealth.DETACHED:
            assert capped.representation == Representation.NONE
            continue
        assert capped.representation == min(rung, Representation.DETECTIONS)
        assert capped.rate_hz == min(rate_hz, DEGRADED_RATE_HZ)
        assert (capped.roi, capped.deadline_s, capped.fusion_weight) == (asked.roi, 0.7, 0.25)
        assert capped.rho == (0.0 if rung > Representation.DETECTIONS else 0.4)


def test_who_is_judged_is_no_part_of_the_fall_that_it_is_held_against() -> None:
    """Of two drones, one falls and one claims not to: the median of both would be half the fall."""
    standings: dict[int, Any] = {}
    for second in range(40):
        known = {
            i: descriptor(i, second, battery_soc=0.9 - (0.0011 * second if i == 0 else 0.00008 * second), coverage_grid=bytes(64))
            for i in (0, 1)
        }  # fmt: skip
        standings = judge(standings, 0, known, {})
    assert standings[1].trust < 1.0
    assert "battery" in standings[1].reason


def test_a_drone_knows_which_members_of_the_scenario_stand_on_the_ground() -> None:
    """So it does not doubt a station of which the charge stays, and does doubt such a drone."""
    for ground, doubted in (("[]", [2]), ("[{drone: 2}]", [])):
        makes = equipment_of(scenario(f"fleet: {{drones: 3, ground: {ground}}}\nperception: {{detector: none}}"))
        mine = memory(trust=True, makes=makes)
        for second in range(20):
            for i in range(3):
                soc = 0.9 if i == 2 else 0.9 - 0.002 * second
                mine.hold(descriptor(i, second, battery_soc=soc, coverage_grid=bytes(64)), float(second))
            mine.judge(second + 0.05)
        assert [i for i in range(3) if mine.trust_in(i) < 1.0] == doubted


def test_a_drone_that_was_away_itself_doubts_nobody_for_that_time() -> None:
    """Drones 0 and 1 rest; the others lose a percent meanwhile, which is not their fall of the seconds before and after."""
    mine = memory(trust=True)
    for second in (*range(4), *range(100, 110)):
        flown_s = {0: second % 96, 1: second % 96, 2: second, 3: second, 4: second}
        for i, lasted_s in flown_s.items():
            soc = 0.9 - 0.0001234 * lasted_s
            mine.hold(descriptor(i, second, battery_soc=soc, coverage_grid=bytes(64)), float(second))
        mine.judge(second + 0.05)
        assert [mine.trust_in(i) for i in flown_s] == [1.0] * 5, second


def test_doubted_peers_are_left_out_of_what_is_believed_and_read_without_their_claims() -> None:
    mine = memory()
    for i in range(3):
        mine.hold(descriptor(i), 0.0)
    mine._doubted = frozenset({2})
    assert [d.agent_id for d in mine.believed()] == [1]
    view = mine.view(0.0)
    assert view.descriptors[2].battery_soc == 0.0
    assert view.descriptors[1].battery_soc == DESCRIPTOR.battery_soc
    assert mine.peers == [1, 2]


@pytest.mark.parametrize(("before_s", "doubted"), [(0.1, True), (0.49, True), (0.51, False), (0.9, False)])
def test_who_sent_a_look_shortly_before_its_claim_looks(before_s: float, doubted: bool) -> None:
    """Within half of the time for which a look stands; then a claim to see nothing cannot be so."""
    mine = memory()
    mine.hold(descriptor(0, 10.0), 10.0)
    sent_s = 10.0 - before_s
    mine.receive(Received(capture(1, sent_s - 0.04), payload(), sent_s + 0.02, sent_s - 0.04))
    mine.hold(descriptor(1, 10.0, coverage_grid=bytes(64)), 10.0)
    mine.judge(10.05)
    assert (mine._standings[1].strikes > 0) == doubted
    assert mine._standings[1].reason.startswith("coverage" if doubted else "")


@pytest.mark.parametrize("mine_s", [0.0, 2.0])
@pytest.mark.parametrize("theirs_s", [0.0, 6.0, -6.0])
def test_a_claim_is_held_against_what_came_before_it_by_one_clock(mine_s: float, theirs_s: float) -> None:
    """Whoever's clock is off: a false goodput is found out, and a claim answers for nothing that came after it."""
    for claimed_mbps, sent_s, doubted in ((1000.0, 9.9, True), (60.0, 9.9, False), (1000.0, 10.1, False)):
        mine = memory()
        mine.status.clock_skew_s = mine_s
        mine.hold(descriptor(0, 10.0 + mine_s), 10.0)
        for _ in range(WINDOW):
            mine.clocks.heard(1, 0.03 + mine_s - theirs_s)
        stamp_s = sent_s - 0.04 + theirs_s
        mine.receive(Received(capture(1, sent_s - 0.04), payload(), sent_s + 0.002, stamp_s, phy_mbps=100.0))
        poor = b"\x55" * 64  # no doubt in itself
        mine.hold(descriptor(1, 9.95 + theirs_s, peer_goodput_mbps=(claimed_mbps,) * 4, coverage_grid=poor), 10.0)
        mine.judge(10.2)
        assert ("goodput" in mine._standings[1].reason) == doubted, (claimed_mbps, sent_s)


def test_payloads_of_a_peer_that_is_not_heard_are_kept_for_two_seconds() -> None:
    mine = memory()
    mine.hold(descriptor(0, 0.0), 0.0)
    mine.receive(Received(capture(1, 0.9), payload(), 1.0, 0.9))
    for now_s, kept in ((1.5, 1), (2.9, 1), (3.1, 0)):
        mine.judge(now_s)
        assert len(mine._arrivals[1]) == kept


def test_one_payload_that_came_faster_than_the_others_makes_no_claim_a_lie() -> None:
    """What arrived is held against the claim in the median; only the fastest data rate bounds it from above."""
    slow, fast = Arrival(20_000, 0.016, 100.0), Arrival(20_000, 0.0004, 600.0)  # 10 and 400 Mb/s
    assert goodput_doubt(5.0, [slow, slow, fast]) == ""
    assert "arrived" in goodput_doubt(5.0, [slow, fast, fast])
    assert "frames came" in goodput_doubt(1000.0, [slow, fast])
    assert goodput_doubt(800.0, [slow, fast]) == ""


LIES = {
    ("coverage", "much"): {"coverage_grid", "novelty_flags"}, ("coverage", "little"): {"coverage_grid", "novelty_flags"},
    ("goodput", "much"): {"peer_goodput_mbps"}, ("goodput", "little"): {"peer_goodput_mbps"},
    ("battery", "much"): {"battery_soc"}, ("battery", "little"): {"battery_soc"},
}  # fmt: skip


@pytest.mark.parametrize("lie", LIES)
def test_a_lie_changes_what_it_is_about_and_nothing_else(lie: tuple[Any, Any]) -> None:
    """Who claims to see nothing claims nothing new either; other flags stay."""
    truth = DESCRIPTOR._replace(novelty_flags=0b111 if lie[1] == "little" else 0b110)
    told = falsified(truth, *lie)
    assert {f for f in truth._fields if getattr(told, f) != getattr(truth, f)} == LIES[lie]
    if lie[0] == "coverage":
        assert told.novelty_flags == (0b110 if lie[1] == "little" else 0b111)


# --- one agent ------------------------------------------------------------------------------------------------


FULL = Directive(0, 1, Representation.FEATURES, 0.5, None, 10.0)


@pytest.mark.parametrize(
    "changes",
    [
        {"fusion_weight": 0.25},
        {"rho": 0.1},
        {"roi": Disc(0, 0, 20)},
        {"representation": Representation.DETECTIONS},
        {"representation": Representation.RAW},
    ],
)
def test_links_that_differ_in_one_field_get_payloads_of_their_own(changes: dict[str, Any]) -> None:
    asked = [FULL, FULL._replace(destination=2, **changes), FULL._replace(destination=3)]
    rig = Rig(lambda view: [d for d in asked if d.destination in view.peers], dwell_s=0.0)
    rig.hear(1, 2, 3)
    rig.env.run(until=0.09)
    by_peer = {peer: p for _, peer, p, _ in rig.sent}
    assert set(by_peer) == {1, 2, 3}
    for peer, d in zip((1, 2, 3), asked, strict=True):
        p = by_peer[peer]
        assert (p.representation, p.rho, p.roi, p.fusion_weight) == (
            d.representation, pytest.approx(d.rho), d.roi, pytest.approx(d.fusion_weight),
        )  # fmt: skip
    assert by_peer[1] is by_peer[3]
    assert by_peer[1] is not by_peer[2]


@pytest.mark.parametrize("leaves_s", [0.0, 0.045, 0.3, 0.33])
def test_a_drone_that_left_sends_and_publishes_nothing_more(leaves_s: float) -> None:
    """Also what it looked at before and was about to send."""
    rig = Rig(
        lambda view: [FULL._replace(destination=p) for p in view.peers],
        dwell_s=0.0,
        handshake=100,
        compute_delay_s=0.04,
    )
    rig.hear(1, 2)
    rig.env.run(until=leaves_s + 1e-6)
    before = len(rig.sent), len(rig.shaken), len(rig.published)
    rig.memory.status.leave()
    rig.env.run(until=1.0)
    assert (len(rig.sent), len(rig.shaken), len(rig.published)) == before
    rig.memory.status.airborne = True
    rig.hear(1, 2)
    rig.env.run(until=1.2)
    assert len(rig.sent) > before[0]
    assert all(c.t_s >= 1.0 - 1e-9 for t_s, _, _, c in rig.sent if t_s > 1.0)


def test_a_drone_that_lies_decides_by_the_truth_and_publishes_the_lie() -> None:
    rig = Rig(lambda view: seen.append(view) or [], dwell_s=0.0)  # type: ignore[func-returns-value]
    seen: list[FleetView] = []
    rig.memory.status.lies[0] = lambda d: d._replace(battery_soc=0.05)
    rig.env.run(until=0.35)
    assert {round(decode_descriptor(datagram).battery_soc, 6) for _, datagram in rig.published} == {0.05}
    assert {round(view.me.battery_soc, 6) for view in seen if view.me is not None} == {0.9}


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_lies_of_several_events_are_all_told(order: tuple[int, ...]) -> None:
    rig = Rig(lambda view: [], dwell_s=0.0)
    lies = [("coverage", "much"), ("goodput", "little"), ("battery", "little")]
    for index in order:
        about, claim = lies[index]
        rig.memory.status.lies[index] = lambda d, about=about, claim=claim: falsified(d, about, claim)  # type: ignore[misc]
    rig.env.run(until=0.05)
    ((_, datagram),) = rig.published
    told = decode_descriptor(datagram)
    assert told.battery_soc == pytest.approx(0.05)
    assert told.peer_goodput_mbps == pytest.approx((0.1,) * 4)
    assert told.coverage_grid == b"\xff" * 64
    del rig.memory.status.lies[1]
    rig.env.run(until=0.15)
    told = decode_descriptor(rig.published[-1][1])
    assert told.battery_soc == pytest.approx(0.05)
    assert told.peer_goodput_mbps == (50.0,) * 4


def test_a_capture_that_is_ready_after_a_later_one_is_dropped() -> None:
    """The computer takes half a second longer up to a moment: captures of shortly before it are overtaken."""
    rig = Rig(lambda view: [FULL], dwell_s=0.0, compute_delay_s=0.04, degraded_after_periods=20)
    rig.memory.status.slower_s = {3: 0.5}
    rig.hear(1)
    rig.env.run(until=0.35)  # after four looks
    del rig.memory.status.slower_s[3]
    rig.env.run(until=0.8)
    assert [round(c.t_s, 9) for _, _, _, c in rig.sent] == [0.4, 0.5, 0.6, 0.7]
    assert rig.agent.latest == rig.sent[-1][3]


def test_what_slows_perception_adds_up() -> None:
    rig = Rig(lambda view: [FULL._replace(destination=p) for p in view.peers], dwell_s=0.0, compute_delay_s=0.04)
    rig.memory.status.slower_s = {3: 0.01, 7: 0.03}
    rig.hear(1)
    rig.env.run(until=0.18)
    assert [t_s - c.t_s for t_s, _, _, c in rig.sent] == pytest.approx([0.01 + 0.04 + 0.04])  # it acts 10 ms late


@pytest.mark.parametrize("every", [1, 3])
def test_what_was_not_published_stays_new(every: int) -> None:
    """Ground seen first in a frame without a descriptor is still new in the next one that has one, and in that one alone."""

    class Sees(Rig):
        def sense(self, frame: int) -> Sensed:
            return super().sense(frame)._replace(view=View(0, 0, b"\xaa" * 64))

    rig = Sees(lambda view: [], dwell_s=0.0, publish_every=every)
    rig.env.run(until=1.0)
    flags = [decode_descriptor(datagram).novelty_flags for _, datagram in rig.published]
    assert flags == [0, 1] + [0] * (len(flags) - 2)


def test_a_drone_without_a_detector_never_looks() -> None:
    rig = Rig(lambda view: [FULL._replace(destination=p) for p in view.peers], dwell_s=0.0)
    rig.memory.status.looks = False
    rig.hear(1, 2)
    rig.env.run(until=0.5)
    assert (rig.sent, rig.memory.status.work.looks, rig.memory.status.perceiving) == ([], 0, False)
    assert rig.published


def test_a_handshake_goes_to_peers_that_are_attached() -> None:
    rig = Rig(lambda view: [], handshake=64, dwell_s=0.0)
    rig.hear(1, 2)
    for k in range(30):
        rig.env.run(until=0.1 * (k + 1) - 0.001)
        rig.hear(2)
    last_1, last_2 = (max(t for t, peer in rig.shaken if peer == p) for p in (1, 2))
    assert last_1 == pytest.approx(1.0, abs=0.15)  # ten periods
    assert last_2 > 2.8


# --- draws that must be independent -----------------------------------------------------------------------------


def test_drones_and_purposes_share_no_draws() -> None:
    """Gusts, offsets, errors of position and heading of every drone and axis, and those of another seed and replication."""
    fleet = Fleet.model_validate(
        {
            "drones": 3,
            "motion": {
                "gust_time_s": 0.02, "pose_jitter_time_s": 2.0, "gust_sigma_mps": 1.0, "pose_error_m": 1.0,
                "heading_error_deg": 1.0,
            },
        }
    )  # fmt: skip
    each: dict[str, np.ndarray] = {}
    for seed, replication in ((1, 0), (2, 0), (1, 1)):
        m = fly(fleet, 400.0, 0.1, seed, replication)
        for drone in range(3):
            key = f"{drone} {seed} {replication}"
            for axis in range(3):
                each[f"gust {axis} {key}"] = m.wind_mps[:, drone, axis]
            for axis in range(2):
                error = m.est_position_m[:, drone, axis] - m.position_m[:, drone, axis]
                each[f"error {axis} {key}"] = np.diff(error)  # nearly white
            heading = np.unwrap(m.est_yaw_rad[:, drone]) - np.unwrap(m.yaw_rad[:, drone])
            each[f"heading {key}"] = np.diff(heading)
    names = list(each)
    values = np.array([v[: len(m.time_s) - 1] for v in each.values()])
    correlation = np.corrcoef(values)
    np.fill_diagonal(correlation, 0.0)
    worst = np.unravel_index(np.abs(correlation).argmax(), correlation.shape)
    assert np.abs(correlation).max() < 0.09, [names[k] for k in worst]


def test_offsets_from_slots_are_of_each_drone_and_axis() -> None:
    fleet = Fleet.model_validate({"drones": 4, "motion": {"pose_jitter_time_s": 1.5, "gust_sigma_mps": 0}})
    m = fly(fleet, 3000.0, 0.5, 1)
    off = (m.position_m - m.position_m.mean(axis=0)).reshape(len(m.time_s), -1)
    correlation = np.corrcoef(off.T)
    np.fill_diagonal(correlation, 0.0)
    assert np.abs(correlation).max() < 0.1


def test_clocks_draw_offset_rate_and_growth_each_for_every_drone() -> None:
    config = Clocks(offset_s=1.0, drift_ppm=1.0, drift_growth_ppm_per_min=1.0)
    drawn = np.array([oscillators(config, 400, seed, 0) for seed in (1, 2)])
    assert len(np.unique(drawn)) == drawn.size
    correlation = np.corrcoef(drawn.transpose(0, 2, 1).reshape(6, -1))
    np.fill_diagonal(correlation, 0.0)
    assert np.abs(correlation).max() < 0.2
    assert len(np.unique([oscillators(config, 3, 1, r) for r in range(3)])) == 27


def test_dead_reckoning_walks_are_of_each_drone_event_seed_and_replication() -> None:
    """Two losses of GNSS of the whole fleet, one after the other: by step, both axes."""
    losses = [f"{{kind: gnss_loss, at_s: {at}, until_s: {at + 100}, position_walk_m: 3}}" for at in (0, 100)]
    walked = loads(f"name: joints\nduration_s: 200\nfleet: {{drones: 3}}\nevents: [{', '.join(losses)}]")
    each: dict[str, np.ndarray] = {}
    for seed, replication in ((1, 0), (2, 0), (1, 1)):
        errors = sensor_errors(walked, np.zeros((2000, 3, 3)), seed, replication)
        for drone, (half, axis) in product(range(3), product(range(2), range(2))):
            steps = np.diff(errors[drone][1000 * half : 1000 * (half + 1), axis])
            each[f"{drone} event {half} axis {axis} {seed} {replication}"] = steps
    correlation = np.corrcoef(np.array(list(each.values())))
    np.fill_diagonal(correlation, 0.0)
    worst = np.unravel_index(np.abs(correlation).argmax(), correlation.shape)
    assert np.abs(correlation).max() < 0.16, [list(each)[k] for k in worst]
