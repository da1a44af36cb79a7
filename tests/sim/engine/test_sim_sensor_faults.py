"""Sensor faults change what a drone believes of its pose, and when and whether it looks; what is true stays as it is."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from sim_examples import example

from sortie.fleet.messages.wire import decode_descriptor
from sortie.fleet.sensor_faults import sensor_errors, turned
from sortie.perception.types import Capture
from sortie.scenarios.errors import SortieError
from sortie.sim.engine import sortie
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results import run_folder
from sortie.sim.results.outcome import outcome

WHOLE = "duration_s=3"
POSITION = "{kind: position_fault, at_s: 1, until_s: 2, drone: 1, offset_m: [10, -4, 2], drift_mps: [1, 0, 0]}"
HEADING = "{kind: heading_fault, at_s: 1, until_s: 2, drone: 1, offset_deg: 170, drift_degps: 20}"


def flown(*events: str, more: tuple[str, ...] = ()) -> sortie.Parts:
    scenario = example(WHOLE, f"events=[{', '.join(events)}]", *more)
    parts = sortie.build(scenario, plan_for(scenario), 1)
    sortie.fly(parts)
    return parts


def captures(parts: sortie.Parts, drone: int) -> list[Capture]:
    return [parts.world.sensed(drone, frame).capture for frame in range(30)]


def believed(parts: sortie.Parts, drone: int) -> np.ndarray:
    """[30, 4]: what the drone believes less what it believes without a fault."""
    plain = flown()
    ours, theirs = (captures(p, drone) for p in (parts, plain))
    assert [c.true_pose for c in ours] == [c.true_pose for c in theirs], "the drone flies where it flew"
    place = np.array([a.est_position_m for a in ours]) - np.array([b.est_position_m for b in theirs])
    yaw = np.array([a.est_yaw_rad - b.est_yaw_rad for a, b in zip(ours, theirs, strict=True)])
    return np.column_stack([place, np.mod(yaw + np.pi, 2 * np.pi) - np.pi])


def test_a_position_fault_jumps_drifts_and_ends() -> None:
    found = believed(flown(POSITION), 1)
    expected = np.zeros((30, 4))
    expected[10:20, :3] = [10, -4, 2]
    expected[10:20, 0] += 0.1 * np.arange(10)
    assert_allclose(found, expected, atol=1e-9)


def test_a_heading_fault_wraps_around() -> None:
    found = believed(flown(HEADING), 1)
    turned_deg = 170 + 2.0 * np.arange(10)
    assert_allclose(np.rad2deg(found[10:20, 3]), np.where(turned_deg >= 180, turned_deg - 360, turned_deg), atol=1e-6)
    assert_allclose(np.delete(found, np.s_[10:20], axis=0), 0.0, atol=1e-9)


def test_other_drones_believe_what_they_believed() -> None:
    assert_allclose(believed(flown(POSITION, HEADING), 0), 0.0)


def test_faults_of_one_drone_add_up() -> None:
    both = believed(flown(POSITION, POSITION.replace("until_s: 2", "until_s: 3")), 1)
    assert_allclose(both[10, :3], [20, -8, 4], atol=1e-9)
    assert_allclose(both[25, :3], [10 + 1.5, -4, 2], atol=1e-9)


def test_descriptors_carry_what_the_drone_believes() -> None:
    parts = flown(POSITION.replace("until_s: 2", "until_s: 3"), HEADING.replace("until_s: 2", "until_s: 3"))
    last = decode_descriptor(parts.transport.last_datagram[1][:180])
    here = captures(parts, 1)[29]
    assert_allclose(last.position_m, here.est_position_m, atol=1e-4)
    error_deg = 170 + 20 * 1.9
    expected = Rotation.from_euler("z", error_deg, degrees=True) * Rotation.from_quat(here.orientation_xyzw)
    assert (Rotation.from_quat(last.orientation_xyzw) * expected.inv()).magnitude() == pytest.approx(0.0, abs=1e-5)


def test_turning_is_that_of_scipy() -> None:
    for yaw_rad in (-3.0, 0.2, 1.7):
        start = Rotation.from_euler("zyx", [0.3, -0.2, 0.1])
        ours = Rotation.from_quat(turned(tuple(start.as_quat()), yaw_rad))
        assert (ours * (Rotation.from_euler("z", yaw_rad) * start).inv()).magnitude() == pytest.approx(0.0, abs=1e-12)


def test_dead_reckoning_walks_away_and_comes_back_with_gnss() -> None:
    lost = "{kind: gnss_loss, at_s: 1, until_s: 2.5, drone: 1, position_walk_m: 3}"
    found = believed(flown(lost), 1)
    assert_allclose(found[:10], 0.0, atol=1e-9)
    assert_allclose(found[25:], 0.0, atol=1e-9)
    assert (np.abs(found[10:25, :2]) > 1e-3).all()
    assert_allclose(found[:, 2:], 0.0, atol=1e-9)


def test_dead_reckoning_grows_with_the_root_of_time() -> None:
    scenario = example("duration_s=60", "fleet.drones=60", "events=[{kind: gnss_loss, at_s: 0, position_walk_m: 3}]")
    errors = sensor_errors(scenario, np.zeros((600, 60, 3)), 1, 0)
    walked = np.stack([errors[drone][:, :2] for drone in range(60)])
    for frame in (100, 400):
        variance = np.mean(walked[:, frame - 1] ** 2)
        assert variance == pytest.approx(9.0 * frame / 10, rel=0.5)  # 120 draws: six standard errors are 0.77


def test_a_ground_station_knows_its_place_unless_an_event_names_it() -> None:
    own = f"fleet.sensor={Path(__file__).parent / 'own_models.py'}:drifts"
    lost = "{kind: gnss_loss, at_s: 0, position_walk_m: 3}"
    named = "{kind: gnss_loss, at_s: 0, drone: 1, position_walk_m: 3}"
    station = "fleet.ground=[{drone: 1, position_m: [0, 0, 3]}]"

    def errors(events: str, *settings: str) -> Mapping[int, np.ndarray]:
        return sensor_errors(example(f"events=[{events}]", own, *settings), np.zeros((60, 5, 3)), 1, 0)

    all_fly, one_stands = errors(lost), errors(lost, station)
    assert sorted(one_stands) == [0, 2, 3, 4]
    for drone, error in one_stands.items():
        assert_allclose(error, all_fly[drone], atol=0.0)
    assert np.abs(errors(named, station)[1][:, :2]).max() > 0.1


def test_without_a_walk_the_loss_of_gnss_touches_clocks_alone() -> None:
    assert_allclose(believed(flown("{kind: gnss_loss, at_s: 1, drone: 1}"), 1), 0.0)


def test_a_blocked_camera_takes_no_looks() -> None:
    plain, blocked = (
        run_sortie(example(WHOLE, f"events=[{event}]")).tables["states"].to_pandas()
        for event in ("", "{kind: camera_blocked, at_s: 1, until_s: 2, drone: 1}")
    )
    looks = [table[table.drone == 1].looks.to_numpy() for table in (plain, blocked)]
    assert np.diff(looks[0])[10:19].sum() > 0
    assert np.diff(looks[1])[10:19].sum() == 0
    assert np.diff(looks[1])[20:].sum() > 0
    assert (plain[plain.drone == 0].looks.to_numpy() == blocked[blocked.drone == 0].looks.to_numpy()).all()


def test_a_drone_that_is_blind_from_take_off_counts_in_accuracy() -> None:
    """Alone it detects nothing, and with peers it is scored as often as they are."""
    blind = "events=[{kind: camera_blocked, at_s: 0, drone: 0}]"
    alone = outcome(run_sortie(example("duration_s=2", blind, "fleet.drones=1", "perception.detector=surrogate")))[
        "ap50"
    ]
    assert (alone["full_scene"], alone["scored_fusions"]) == (0.0, 4)
    fleet = run_sortie(example("duration_s=2", blind, "perception.detector=surrogate"))
    scored = fleet.tables["fusions"]["drone"].to_pylist()
    assert {drone: scored.count(drone) for drone in set(scored)} == dict.fromkeys(range(fleet.scenario.fleet.drones), 4)


def test_slow_perception_delays_what_is_sent_by_so_much() -> None:
    busy = (WHOLE, "policy.name=all-4", "policy.params={}")
    rows = (
        run_sortie(example(*busy, "events=[{kind: slow_perception, at_s: 1, until_s: 2, drone: 1, extra_s: 0.05}]"))
        .tables["transmissions"]
        .to_pandas()
    )
    rows = rows[rows.drone == 1]
    late_s = (rows.t_sent_s - rows.captured_s).round(6)
    within = (rows.captured_s > 0.99) & (rows.captured_s < 1.99)
    (usual_s,) = late_s[~within].unique()
    assert (late_s[within] - usual_s).round(6).unique().tolist() == [0.05]


def test_a_wrong_pose_costs_accuracy() -> None:
    fuses = ("duration_s=4", "perception.detector=surrogate", "policy.name=all-4", "policy.params={}")
    off = "events=[{kind: position_fault, at_s: 0, drone: 1, offset_m: [6, 6, 0]}]"
    plain, wrong = (outcome(run_sortie(example(*fuses, *more)))["ap50"]["full_scene"] for more in ((), (off,)))
    assert wrong < plain - 0.02


def test_events_say_what_is_wrong() -> None:
    found = outcome(run_sortie(example(WHOLE, f"events=[{POSITION}, {HEADING}]")))["events"]
    assert [(event["kind"], event["text"]) for event in found] == [
        ("position_fault", "believes to be 11 m away, drifting at 1 m/s"),
        ("heading_fault", "believes its heading 170° off, drifting by 20° a second"),
        ("position_fault", "its believed pose is still wrong: another fault lasts"),
        ("heading_fault_over", "its believed pose has its usual errors again"),
    ]


SENSOR = """
import numpy as np
def drifts(times_s, positions_m, rng, *, mps=0.5):
    error = np.zeros((len(times_s), 4))
    error[:, 0] = mps * times_s
    error[:, 3] = rng.normal(scale=0.01, size=len(times_s))
    return error
def short(times_s, positions_m, rng):
    return np.zeros((3, 4))
def endless(times_s, positions_m, rng):
    return np.full((len(times_s), 4), np.nan)
"""


@pytest.fixture
def sensors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(SENSOR)
    return "own.py"


def test_a_sensor_of_ones_own_adds_its_error_to_every_drone(sensors: str) -> None:
    named = (f"fleet.sensor={sensors}:drifts", "fleet.sensor_params={mps: 2}")
    zero, one = (believed(flown(more=named), drone) for drone in (0, 1))
    assert_allclose(zero[:, 0], 0.2 * np.arange(30), atol=1e-9)
    assert_allclose(one[:, :3], zero[:, :3], atol=1e-9)
    assert np.corrcoef(zero[:, 3], one[:, 3])[0, 1] < 0.6  # each drone has draws of its own


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("short", r"^sensor short: returns shape \(3, 4\), must be \(30, 4\)$"),
        ("endless", r"^sensor endless: returns nan, must be finite$"),
    ],
)
def test_a_sensor_that_returns_something_else_is_refused(function: str, message: str, sensors: str) -> None:
    with pytest.raises(SortieError, match=message):
        flown(more=(f"fleet.sensor={sensors}:{function}",))


def test_what_drones_believe_is_kept_if_wanted(tmp_path: Path) -> None:
    settings = (WHOLE, f"events=[{POSITION}, {HEADING}]")
    record, plain = run_sortie(example(*settings, "record.beliefs=true")), run_sortie(example(*settings))
    assert "beliefs" not in plain.tables
    assert plain.fingerprint == record.fingerprint
    run_folder.save(record, tmp_path / "run")
    kept, states = (run_folder.load(tmp_path / "run").tables[name].to_pandas() for name in ("beliefs", "states"))
    assert_allclose(kept[["t_s", "drone"]], states[["t_s", "drone"]])
    its = captures(flown(POSITION, HEADING), 1)
    own = kept[kept["drone"] == 1]
    assert_allclose(own[["x_m", "y_m", "z_m"]], [c.est_position_m for c in its])
    assert_allclose(own["yaw_rad"], [c.est_yaw_rad for c in its])
    wrong_m = np.hypot(*(kept[["x_m", "y_m"]].to_numpy() - states[["x_m", "y_m"]].to_numpy()).T).reshape(30, -1)
    assert wrong_m[10:20, 1].min() > 9 > 2 > np.delete(wrong_m, np.s_[10:20], axis=0).max()
