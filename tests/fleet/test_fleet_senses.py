"""What drones sense of themselves in flight, and what faults of their sensors add to it."""

from __future__ import annotations

import math
from itertools import product
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sortie.fleet.coverage import cameras_of, footprint_radius_m
from sortie.fleet.flight.motion import fly
from sortie.fleet.senses import FlightSenses, believed
from sortie.fleet.sensor_faults import sensor_errors
from sortie.perception.geometry import USUAL
from sortie.perception.scene.scene_model import SceneModel
from sortie.scenarios.reading.load import loads
from sortie.scenarios.schema import (
    Fleet,
    Scene,
)

PLAIN = SceneModel(Scene(building_density=0.0, tree_density=0.0), None, (-100.0, -100.0, 100.0, 100.0)).height_field
FRAMES = (0, 20, 31, 32, 49)
"""Within and beyond the first block of frames that are worked out at once."""


def test_every_drone_senses_with_its_own_cameras() -> None:
    wide = {"name": "wide", "drones": [1], "camera": {"field_of_view_deg": 100}, "altitude_offset_m": 20}
    fleet = Fleet.model_validate({"drones": 3, "makes": [wide]})
    motion, cameras = fly(fleet, 5.0, 0.1, 1), cameras_of(fleet)
    assert cameras[1].field_of_view_deg == 100
    assert cameras[0] == cameras[2] == USUAL
    senses = FlightSenses(motion, 0.1, PLAIN, cameras)
    for frame in FRAMES:
        for drone, sensed in enumerate(senses.at(frame)):
            z_m = motion.est_position_m[frame, drone, 2]
            assert sensed.capture.cameras == cameras[drone]
            assert sensed.footprint_radius_m == pytest.approx(footprint_radius_m(z_m, cameras[drone]))
            assert sensed.capture.position_m == tuple(motion.position_m[frame, drone])
            assert sensed.capture.est_position_m == tuple(motion.est_position_m[frame, drone])
            assert sensed.capture.est_yaw_rad == motion.est_yaw_rad[frame, drone]
            assert sensed.velocity_mps == tuple(motion.velocity_mps[frame, drone])
            assert sensed.capture.t_s == pytest.approx(0.1 * frame)
    usual, wide_m = (senses.at(0)[i].footprint_radius_m for i in (0, 1))
    tan = math.tan(math.radians(50)) / math.tan(math.radians(35))
    assert wide_m == pytest.approx(80 / 60 * tan * usual, rel=0.05)


def test_a_fault_of_a_drone_s_pose_is_in_all_that_it_says_of_itself_and_in_nothing_that_is_true() -> None:
    """East, north, height and heading, each frame's own error; members without cameras have no footprint."""
    fleet = Fleet(drones=3)
    motion, cameras, frame = fly(fleet, 5.0, 0.1, 1), cameras_of(fleet), np.arange(50)
    error = np.stack([np.full(50, 3 * 12.8), np.full(50, -2 * 12.8), frame / 5, 0.5 + frame / 100], axis=-1)
    plain = FlightSenses(motion, 0.1, PLAIN, cameras)
    faulty = FlightSenses(motion, 0.1, PLAIN, cameras, {1: error}, blind=(2,))
    position_m, yaw_rad = believed(motion, {1: error}, slice(0, 50))
    for k in FRAMES:
        own, now, blind = faulty.at(k)
        was = plain.at(k)[1]
        assert own == plain.at(k)[0]
        assert blind.footprint_radius_m == 0.0
        assert now.capture.position_m == was.capture.position_m
        assert now.capture.orientation_xyzw == was.capture.orientation_xyzw
        assert np.subtract(now.capture.est_position_m, was.capture.est_position_m) == pytest.approx(error[k, :3])
        assert now.capture.est_position_m == pytest.approx(position_m[k, 1])
        assert now.capture.est_yaw_rad - was.capture.est_yaw_rad == pytest.approx(error[k, 3])
        assert now.capture.est_yaw_rad == pytest.approx(yaw_rad[k, 1])
        assert now.footprint_radius_m == pytest.approx(footprint_radius_m(now.capture.est_position_m[2], cameras[1]))
        turn = Rotation.from_quat(now.orientation_xyzw) * Rotation.from_quat(was.orientation_xyzw).inv()
        assert turn.as_rotvec() == pytest.approx([0.0, 0.0, error[k, 3]], abs=1e-9)
        assert (now.view.row, now.view.column) == (was.view.row - 2, was.view.column + 3)


# --- faults of sensors ------------------------------------------------------------------------------------


def errors(events: str, frames: int = 40) -> Any:
    scenario = loads(f"name: faults\nduration_s: 4\nfleet: {{drones: 3}}\nevents: [{events}]")
    return sensor_errors(scenario, np.zeros((frames, 3, 3)), 1, 0)


def test_a_fault_begins_in_its_frame_and_is_over_in_the_frame_of_its_end() -> None:
    found = errors("{kind: position_fault, drone: 1, at_s: 0.5, until_s: 1.2, offset_m: [3, 0, -2]}")
    assert list(found) == [1]
    assert np.flatnonzero(found[1].any(axis=1)).tolist() == list(range(5, 12))


def test_faults_of_one_drone_add_up_and_drifts_begin_at_nothing() -> None:
    offset = "{kind: position_fault, drone: 1, at_s: 1, offset_m: [3, 0, 0]}"
    drift = "{kind: position_fault, drone: 1, at_s: 2, drift_mps: [0, 2, 1]}"
    heading = "{kind: heading_fault, drone: 1, at_s: 1, offset_deg: 90}"
    found = errors(f"{offset}, {drift}, {heading}")
    np.testing.assert_allclose(found[1][35], [3.0, 3.0, 1.5, np.pi / 2])
    np.testing.assert_allclose(found[1][20], [3.0, 0.0, 0.0, np.pi / 2])


def test_dead_reckoning_walks_as_far_at_every_frame_rate() -> None:
    """Its variance grows by the square of position_walk_m a second."""
    for rate_hz in (2.0, 10.0):
        scenario = loads(
            f"name: walk\nduration_s: 1800\ncontext: {{rate_hz: {rate_hz}}}\nfleet: {{drones: 20}}\n"
            "events: [{kind: gnss_loss, at_s: 0, position_walk_m: 2}]"
        )
        walks = sensor_errors(scenario, np.zeros((round(400 * rate_hz), 20, 3)), 3, 0)
        steps = np.concatenate([np.diff(walk[:, :2], axis=0).ravel() for walk in walks.values()])
        assert np.std(steps) * np.sqrt(rate_hz) == pytest.approx(2.0, rel=0.05)


def test_dead_reckoning_walks_are_of_each_drone_event_seed_and_replication() -> None:
    """Two losses of GNSS of the whole fleet, one after the other: by step, both axes."""
    losses = [f"{{kind: gnss_loss, at_s: {at}, until_s: {at + 100}, position_walk_m: 3}}" for at in (0, 100)]
    walked = loads(f"name: walks\nduration_s: 200\nfleet: {{drones: 3}}\nevents: [{', '.join(losses)}]")
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
