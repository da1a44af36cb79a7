"""The flown formation: arrays that belong to each other, statistics as asked, and no draw of anyone else's."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sortie.fleet.flight.motion import DRAG_PER_S, GRAVITY_MPS2, MotionError, Trajectories, attitude, fly, frame_floats
from sortie.scenarios.formation import slots
from sortie.scenarios.schema import Fleet, Formation, Route
from sortie.scenarios.schema import Motion as MotionConfig

CALM = MotionConfig(wind_mps=(0, 0), gust_sigma_mps=0, pose_jitter_m=0, pose_error_m=0, heading_error_deg=0)
TOUR = Route(waypoints_m=((0, 0), (150, 0), (150, 100), (0, 100)))


def tour(**changes: object) -> Trajectories:
    return fly(Fleet(route=TOUR).model_copy(update=changes), 60.0, 0.1, seed=3)


def test_shapes_and_end_exclusive() -> None:
    m = fly(Fleet(drones=3), 12.0, 0.1, seed=1)
    assert m.time_s.shape == (120,)
    assert m.time_s[-1] < 12.0
    for name in ("position_m", "velocity_mps", "acceleration_mps2", "body_rates_radps", "wind_mps", "est_position_m"):
        assert getattr(m, name).shape == (120, 3, 3), name
    assert m.orientation_xyzw.shape == (120, 3, 4)
    assert m.est_yaw_rad.shape == m.yaw_rad.shape == (120, 3)
    assert sum(getattr(m, field.name)[0].size for field in fields(m)) == frame_floats(3)
    assert fly(Fleet(drones=1), 0.01, 0.1, seed=1).body_rates_radps.tolist() == [[[0, 0, 0]]]


def test_nobody_can_change_a_flown_motion() -> None:
    m = fly(Fleet(), 1.0, 0.1, seed=1)
    for field in fields(m):
        with pytest.raises(ValueError, match="read-only"):
            getattr(m, field.name)[...] = 0


def test_calm_hover_is_level_and_still() -> None:
    fleet = Fleet(motion=CALM, formation=Formation(spacing_m=20, altitude_m=60))
    m = fly(fleet, 5.0, 0.1, seed=1)
    expected = np.column_stack([slots("cross", 5, 20.0), np.full(5, 60.0)])
    np.testing.assert_allclose(m.position_m, np.tile(expected, (50, 1, 1)))
    np.testing.assert_allclose(m.orientation_xyzw, np.tile([0.0, 0.0, 0.0, 1.0], (50, 5, 1)))
    for still in (m.velocity_mps, m.acceleration_mps2, m.body_rates_radps, m.wind_mps, m.yaw_rad):
        assert not still.any()
    np.testing.assert_array_equal(m.est_position_m, m.position_m)
    np.testing.assert_array_equal(m.est_yaw_rad, m.yaw_rad)


def test_attitude_follows_from_the_acceleration() -> None:
    """Thrust axis along a + g·e3 + drag; heading exact: y_B stands upright on (cos ψ, sin ψ, 0), x_B looks along it."""
    m = tour()
    thrust = m.acceleration_mps2 + [0, 0, GRAVITY_MPS2] + DRAG_PER_S * (m.velocity_mps - m.wind_mps)
    thrust /= np.linalg.norm(thrust, axis=-1, keepdims=True)
    matrix = Rotation.from_quat(m.orientation_xyzw.reshape(-1, 4)).as_matrix().reshape(*m.yaw_rad.shape, 3, 3)
    np.testing.assert_allclose(matrix[..., 2], thrust, atol=1e-9)
    heading = np.stack([np.cos(m.frame_yaw_rad), np.sin(m.frame_yaw_rad), 0 * m.frame_yaw_rad], axis=-1)[:, None]
    np.testing.assert_allclose(np.sum(matrix[..., 1] * heading, axis=-1), 0, atol=1e-9)
    assert (np.sum(matrix[..., 0] * heading, axis=-1) > 0.5).all()
    assert np.degrees(np.abs(np.unwrap(m.yaw_rad, axis=0) - m.frame_yaw_rad[:, None])).max() < 10


def test_quaternions_are_unit_and_never_jump() -> None:
    m = tour()
    np.testing.assert_allclose(np.linalg.norm(m.orientation_xyzw, axis=-1), 1, atol=1e-12)
    assert (np.sum(m.orientation_xyzw[1:] * m.orientation_xyzw[:-1], axis=-1) > 0.9).all()


def test_body_rates_carry_one_attitude_into_the_next() -> None:
    m = tour()
    now = Rotation.from_quat(m.orientation_xyzw[:-1].reshape(-1, 4))
    turned = now * Rotation.from_rotvec(m.body_rates_radps[:-1].reshape(-1, 3) * 0.1)
    np.testing.assert_allclose(
        (turned.inv() * Rotation.from_quat(m.orientation_xyzw[1:].reshape(-1, 4))).magnitude(), 0, atol=1e-7
    )


def test_position_velocity_and_acceleration_belong_together() -> None:
    """Without noise, to second order in the step."""
    m = fly(Fleet(route=TOUR, motion=CALM), 80.0, 0.01, seed=1)
    velocity = (m.position_m[2:] - m.position_m[:-2]) / 0.02
    acceleration = (m.velocity_mps[2:] - m.velocity_mps[:-2]) / 0.02
    np.testing.assert_allclose(velocity, m.velocity_mps[1:-1], atol=1e-3)
    np.testing.assert_allclose(acceleration, m.acceleration_mps2[1:-1], atol=1e-2)
    assert np.abs(m.acceleration_mps2).max() > 1  # the outer drones do swing round


def test_jittered_position_integrates_its_velocity() -> None:
    m = fly(Fleet(route=TOUR), 30.0, 0.01, seed=1)
    step = m.position_m[:-1] + 0.01 * m.velocity_mps[:-1] + 0.5 * 0.01**2 * m.acceleration_mps2[:-1]
    np.testing.assert_allclose(step, m.position_m[1:], atol=1e-5)
    np.testing.assert_allclose((m.velocity_mps[1:] - m.velocity_mps[:-1]) / 0.01, m.acceleration_mps2[:-1], atol=0.05)


def test_the_formation_turns_with_the_route_and_keeps_its_shape() -> None:
    m = fly(Fleet(route=TOUR, motion=CALM), 90.0, 0.1, seed=1)
    arm = m.position_m - m.frame_position_m[:, None]
    np.testing.assert_allclose(np.linalg.norm(arm, axis=-1), np.tile([0.0, 20, 20, 20, 20], (900, 1)), atol=1e-9)
    np.testing.assert_allclose(m.position_m[0, 1], [20, 0, 60])  # front drone, flying east
    np.testing.assert_allclose(m.position_m[-1, 1], [-20, 100, 60], atol=1e-9)  # and west in the end
    np.testing.assert_allclose(m.yaw_rad[-1], np.pi, atol=1e-9)


def test_statistics_are_as_asked() -> None:
    """100 drones × 120 s. Bounds are 5 standard errors; a correlation time of τ leaves about T/(2τ) free samples."""
    config = MotionConfig(pose_jitter_m=0.4, pose_error_m=0.2, heading_error_deg=0.5, gust_sigma_mps=0.8)
    fleet = Fleet(drones=100, formation=Formation(shape="line"), motion=config)
    m = fly(fleet, 120.0, 0.1, seed=5)
    slot = np.column_stack([slots("line", 100, 20.0), np.full(100, 60.0)])

    def check(samples: np.ndarray, sigma: float, time_s: float) -> None:
        independent = samples.size / 1200 * 120 / (2 * time_s)
        assert np.sqrt(np.mean(samples**2)) == pytest.approx(sigma, rel=5 / np.sqrt(2 * independent))

    check(m.position_m - slot, 0.4, 2.5)
    check(m.velocity_mps, 0.4 * 16 / (5 * 2.5) / np.sqrt(5), 2.5)
    check(m.wind_mps - [2.0, 1.0, 0.0], 0.8, 3.0)
    check((m.est_position_m - m.position_m)[..., :2], 0.2, 10.0)
    check(m.est_yaw_rad - m.yaw_rad, np.radians(0.5), 10.0)
    assert np.array_equal(m.est_position_m[..., 2], m.position_m[..., 2])


def test_a_sixth_drone_changes_nothing_for_the_first_five() -> None:
    for shape in ("cross", "line", "wedge", "grid"):
        of = (Fleet(drones=n, formation=Formation(shape=shape), route=TOUR) for n in (5, 6))
        five, six = (fly(fleet, 40.0, 0.1, seed=3) for fleet in of)
        for field in fields(five):
            a, b = getattr(five, field.name), getattr(six, field.name)
            assert np.array_equal(a, b if a.shape == b.shape else b[:, :5]), (shape, field.name)


def test_a_longer_sortie_begins_like_a_shorter_one() -> None:
    long, short = (fly(Fleet(route=TOUR), t, 0.1, seed=3) for t in (40.0, 20.0))
    for field in fields(long):
        if field.name != "body_rates_radps":  # whose last frame repeats
            assert np.array_equal(getattr(long, field.name)[:200], getattr(short, field.name)), field.name


def largest_correlation(series: dict[str, np.ndarray]) -> tuple[float, str]:
    """Of all pairs of series, and between which."""
    correlation = np.abs(np.corrcoef(list(series.values())))
    np.fill_diagonal(correlation, 0.0)
    pair = np.unravel_index(correlation.argmax(), correlation.shape)
    return float(correlation.max()), " and ".join(list(series)[k] for k in pair)


def test_drones_and_purposes_share_no_draws() -> None:
    """Gusts, errors of position and heading of every drone and axis, and those of another seed and replication."""
    errors = {"pose_error_m": 1.0, "heading_error_deg": 1.0, "pose_jitter_time_s": 2.0}
    motion = {"gust_time_s": 0.02, "gust_sigma_mps": 1.0, **errors}
    fleet = Fleet.model_validate({"drones": 3, "motion": motion})
    each: dict[str, np.ndarray] = {}
    for seed, replication in ((1, 0), (2, 0), (1, 1)):
        m = fly(fleet, 400.0, 0.1, seed, replication)
        for drone in range(3):
            key = f"{drone} {seed} {replication}"
            for axis in range(3):
                each[f"gust {axis} {key}"] = m.wind_mps[1:, drone, axis]
            for axis in range(2):
                error = m.est_position_m[:, drone, axis] - m.position_m[:, drone, axis]
                each[f"error {axis} {key}"] = np.diff(error)  # nearly white
            heading = np.unwrap(m.est_yaw_rad[:, drone]) - np.unwrap(m.yaw_rad[:, drone])
            each[f"heading {key}"] = np.diff(heading)
    most, where = largest_correlation(each)
    assert most < 0.09, where


def test_offsets_from_slots_are_of_each_drone_and_axis() -> None:
    fleet = Fleet.model_validate({"drones": 4, "motion": {"pose_jitter_time_s": 1.5, "gust_sigma_mps": 0}})
    offset_m = fly(fleet, 3000.0, 0.5, 1).position_m.reshape(6000, -1)
    most, where = largest_correlation({str(k): column for k, column in enumerate(offset_m.T)})
    assert most < 0.1, where


def test_what_cannot_be_flown_is_refused() -> None:
    with pytest.raises(MotionError, match="free fall"):
        attitude(np.zeros((2, 3)), np.zeros(2))
    with pytest.raises(MotionError, match="along the heading"):
        attitude(np.array([[0.0, 9.81, 0.0]]), np.array([np.pi / 2]))
    wild = Fleet(motion=MotionConfig(pose_jitter_m=20, pose_jitter_time_s=0.5))
    with pytest.raises(
        MotionError, match=r"^drone \d at \d+\.\d s would have to thrust downwards: .*pose_jitter_m 20 "
    ):
        fly(wild, 10.0, 0.1, seed=1)
