"""Sensor faults change what a drone believes of its pose, and when and whether it looks; what is true stays as it is.

Flights of their own, of 2 s and two drones, with and without a fault.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from recorded import recorded
from scipy.spatial.transform import Rotation
from sim_examples import example

from sortie.fleet.messages.wire import decode_descriptor
from sortie.fleet.sensor_faults import sensor_errors, turned
from sortie.perception.types import Capture
from sortie.scenarios.errors import SortieError
from sortie.sim.engine import sortie
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome

WHOLE = ("duration_s=2", "fleet.drones=2", "mission.phases=[{at_s: 0, phase: search}]")
POSITION = "{kind: position_fault, at_s: 0.5, until_s: 1.5, drone: 1, offset_m: [10, -4, 2], drift_mps: [1, 0, 0]}"
HEADING = "{kind: heading_fault, at_s: 0.5, until_s: 1.5, drone: 1, offset_deg: 170, drift_degps: 20}"
OWN = f"fleet.sensor={Path(__file__).parent / 'own_models.py'}:drifts"


@functools.cache
def flown(*events: str, more: tuple[str, ...] = ()) -> sortie.Parts:
    scenario = example(*WHOLE, f"events=[{', '.join(events)}]", *more)
    parts = sortie.build(scenario, plan_for(scenario), 1)
    sortie.fly(parts)
    return parts


def captures(parts: sortie.Parts, drone: int) -> list[Capture]:
    return [parts.world.sensed(drone, frame).capture for frame in range(20)]


def believed(parts: sortie.Parts, drone: int) -> np.ndarray:
    """[20, 4]: what the drone believes less what it believes without a fault."""
    ours, theirs = (captures(p, drone) for p in (parts, flown()))
    assert [c.true_pose for c in ours] == [c.true_pose for c in theirs], "the drone flies where it flew"
    place = np.array([a.est_position_m for a in ours]) - np.array([b.est_position_m for b in theirs])
    yaw = np.array([a.est_yaw_rad - b.est_yaw_rad for a, b in zip(ours, theirs, strict=True)])
    return np.column_stack([place, np.mod(yaw + np.pi, 2 * np.pi) - np.pi])


def test_faults_jump_drift_add_up_and_end_and_a_heading_wraps_around() -> None:
    found = believed(flown(POSITION), 1)
    expected = np.zeros((20, 4))
    expected[5:15, :3] = [10, -4, 2]
    expected[5:15, 0] += 0.1 * np.arange(10)
    assert_allclose(found, expected, atol=1e-9)
    both = believed(flown(POSITION, POSITION.replace("until_s: 1.5", "until_s: 2")), 1)
    assert_allclose(both[5, :3], [20, -8, 4], atol=1e-9)
    assert_allclose(both[18, :3], [10 + 1.3, -4, 2], atol=1e-9)
    heading = believed(flown(HEADING), 1)
    deg = 170 + 2.0 * np.arange(10)
    assert_allclose(np.rad2deg(heading[5:15, 3]), np.where(deg >= 180, deg - 360, deg), atol=1e-6)
    assert_allclose(np.delete(heading, np.s_[5:15], axis=0), 0.0, atol=1e-9)
    assert_allclose(believed(flown(POSITION, HEADING), 0), 0.0), "other drones believe what they believed"


def test_descriptors_carry_what_the_drone_believes() -> None:
    parts = flown(POSITION.replace("until_s: 1.5", "until_s: 3"), HEADING.replace("until_s: 1.5", "until_s: 3"))
    last = decode_descriptor(parts.transport.last_datagram[1][:-28])
    here = captures(parts, 1)[19]
    assert_allclose(last.position_m, here.est_position_m, atol=1e-4)
    error_deg = 170 + 20 * 1.4
    expected = Rotation.from_euler("z", error_deg, degrees=True) * Rotation.from_quat(here.orientation_xyzw)
    assert (Rotation.from_quat(last.orientation_xyzw) * expected.inv()).magnitude() == pytest.approx(0.0, abs=1e-5)


def test_turning_is_that_of_scipy() -> None:
    for yaw_rad in (-3.0, 0.2, 1.7):
        start = Rotation.from_euler("zyx", [0.3, -0.2, 0.1])
        ours = Rotation.from_quat(turned(tuple(start.as_quat()), yaw_rad))
        assert (ours * (Rotation.from_euler("z", yaw_rad) * start).inv()).magnitude() == pytest.approx(0.0, abs=1e-12)


def test_dead_reckoning_walks_away_and_comes_back_with_gnss() -> None:
    """Without a walk the loss of GNSS touches clocks alone."""
    lost = "{kind: gnss_loss, at_s: 0.5, until_s: 1.5, drone: 1, position_walk_m: 3}"
    found = believed(flown(lost), 1)
    assert_allclose(np.delete(found, np.s_[5:15], axis=0), 0.0, atol=1e-9)
    assert (np.abs(found[5:15, :2]) > 1e-3).all()
    assert_allclose(found[:, 2:], 0.0, atol=1e-9)
    assert_allclose(believed(flown(lost.replace(", position_walk_m: 3", "")), 1), 0.0)


def test_dead_reckoning_grows_with_the_root_of_time() -> None:
    scenario = example("duration_s=60", "fleet.drones=60", "events=[{kind: gnss_loss, at_s: 0, position_walk_m: 3}]")
    errors = sensor_errors(scenario, np.zeros((600, 60, 3)), 1, 0)
    walked = np.stack([errors[drone][:, :2] for drone in range(60)])
    for frame in (100, 400):
        variance = np.mean(walked[:, frame - 1] ** 2)
        assert variance == pytest.approx(9.0 * frame / 10, rel=0.5)  # 120 draws: six standard errors are 0.77


def test_a_ground_station_knows_its_place_unless_an_event_names_it() -> None:
    lost = "{kind: gnss_loss, at_s: 0, position_walk_m: 3}"
    named = "{kind: gnss_loss, at_s: 0, drone: 1, position_walk_m: 3}"
    station = "fleet.ground=[{drone: 1, position_m: [0, 0, 3]}]"

    def errors(events: str, *settings: str) -> Mapping[int, np.ndarray]:
        return sensor_errors(example(f"events=[{events}]", OWN, *settings), np.zeros((60, 5, 3)), 1, 0)

    all_fly, one_stands = errors(lost), errors(lost, station)
    assert sorted(one_stands) == [0, 2, 3, 4]
    for drone, error in one_stands.items():
        assert_allclose(error, all_fly[drone], atol=0.0)
    assert np.abs(errors(named, station)[1][:, :2]).max() > 0.1


def test_a_blocked_camera_takes_no_looks_and_a_blind_drone_counts_in_accuracy() -> None:
    """Drone 0 is blocked from 4 s to 5 s of the recorded flight. Alone and blind a drone detects nothing."""
    states = recorded("faults").tables["states"].to_pandas()
    looks = [np.diff(states[states.drone == drone].looks.to_numpy()) for drone in (0, 2)]
    assert looks[0][41:49].sum() == 0
    assert looks[0][51:59].sum() > 0
    assert looks[1][41:49].sum() > 0
    blind = (*WHOLE, "events=[{kind: camera_blocked, at_s: 0, drone: 0}]", "perception.detector=surrogate")
    alone = outcome(run_sortie(example(*blind, "fleet.drones=1")))["ap50"]
    assert (alone["full_scene"], alone["scored_fusions"]) == (0.0, 4)
    scored = run_sortie(example(*blind)).tables["fusions"]["drone"].to_pylist()
    assert {drone: scored.count(drone) for drone in set(scored)} == {0: 4, 1: 4}, "with peers as often as they are"


def test_slow_perception_delays_what_is_sent_by_so_much() -> None:
    slow = "events=[{kind: slow_perception, at_s: 0.5, until_s: 1.5, drone: 1, extra_s: 0.05}]"
    record = run_sortie(example(*WHOLE, slow, "policy={name: all-4}"))
    rows = record.tables["transmissions"].to_pandas().query("drone == 1")
    late_s = (rows.t_sent_s - rows.captured_s).round(6)
    within = (rows.captured_s > 0.49) & (rows.captured_s < 1.49)
    (usual_s,) = late_s[~within].unique()
    assert (late_s[within] - usual_s).round(6).unique().tolist() == [0.05]


def test_a_wrong_pose_costs_accuracy() -> None:
    fuses = ("duration_s=4", "perception.detector=surrogate", "policy={name: all-4}", "fleet.drones=3")
    off = "events=[{kind: position_fault, at_s: 0, drone: 1, offset_m: [6, 6, 0]}]"
    plain, wrong = (outcome(run_sortie(example(*fuses, *more)))["ap50"]["full_scene"] for more in ((), (off,)))
    assert wrong < plain - 0.02


def test_a_sensor_of_one_s_own_adds_its_error_to_every_drone(tmp_path: Path) -> None:
    own = tmp_path / "own.py"
    own.write_text(
        "import numpy as np\n\n"
        "def drifts(times_s, positions_m, rng, *, mps=0.5):\n"
        "    error = np.zeros((len(times_s), 4))\n"
        "    error[:, 0] = mps * times_s\n"
        "    error[:, 3] = rng.normal(scale=0.01, size=len(times_s))\n"
        "    return error\n\n"
        "def short(times_s, positions_m, rng):\n    return np.zeros((3, 4))\n\n"
        "def endless(times_s, positions_m, rng):\n    return np.full((len(times_s), 4), np.nan)\n"
    )
    named = (f"fleet.sensor={own}:drifts", "fleet.sensor_params={mps: 2}")
    zero, one = (believed(flown(more=named), drone) for drone in (0, 1))
    assert_allclose(zero[:, 0], 0.2 * np.arange(20), atol=1e-9)
    assert_allclose(one[:, :3], zero[:, :3], atol=1e-9)
    assert np.corrcoef(zero[:, 3], one[:, 3])[0, 1] < 0.6  # each drone has draws of its own
    for function, words in (("short", r"shape \(3, 4\), must be \(20, 4\)$"), ("endless", "nan, must be finite$")):
        with pytest.raises(SortieError, match=rf"^sensor {function}: returns {words}"):
            flown(more=(f"fleet.sensor={own}:{function}",))


def test_what_drones_believe_is_kept_if_wanted() -> None:
    settings = (*WHOLE, f"events=[{POSITION}, {HEADING}]")
    record, plain = run_sortie(example(*settings, "record.beliefs=true")), run_sortie(example(*settings))
    assert "beliefs" not in plain.tables
    assert plain.fingerprint == record.fingerprint
    kept, states = (record.tables[name].to_pandas() for name in ("beliefs", "states"))
    assert_allclose(kept[["t_s", "drone"]], states[["t_s", "drone"]])
    its, own = captures(flown(POSITION, HEADING), 1), kept[kept["drone"] == 1]
    assert_allclose(own[["x_m", "y_m", "z_m"]], [c.est_position_m for c in its])
    assert_allclose(own["yaw_rad"], [c.est_yaw_rad for c in its])
    wrong_m = np.hypot(*(kept[["x_m", "y_m"]].to_numpy() - states[["x_m", "y_m"]].to_numpy()).T).reshape(20, -1)
    assert wrong_m[5:15, 1].min() > 9 > 2 > np.delete(wrong_m, np.s_[5:15], axis=0).max()
