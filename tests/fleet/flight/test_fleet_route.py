"""The reference point's flight: exact on straight legs, smooth round corners, at rest in the end."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from sortie.fleet.flight.route import MAX_RING_SPEED_MPS, frame_path, spread

L_TURN = ((0.0, 0.0), (100.0, 0.0), (100.0, 100.0))


def test_straight_legs_are_flown_at_constant_speed() -> None:
    path = frame_path(L_TURN, 5.0, 4.0, 20.0, np.array([0.0, 10.0, 18.0, 22.0, 30.0]))
    np.testing.assert_allclose(path.position_m, [(0, 0), (50, 0), (90, 0), (100, 10), (100, 50)], atol=1e-9)
    np.testing.assert_allclose(path.velocity_mps, [(5, 0), (5, 0), (5, 0), (0, 5), (0, 5)], atol=1e-9)


def test_it_comes_to_rest_at_the_last_waypoint() -> None:
    # 200 m at 5 m/s take 40 s, and the stop spreads over 4 s about that
    path = frame_path(L_TURN, 5.0, 4.0, 20.0, np.array([42.0, 1000.0]))
    np.testing.assert_allclose(path.position_m, [(100, 100)] * 2, atol=1e-9)
    assert not path.velocity_mps.round(9).any()
    assert not path.acceleration_mps2.round(9).any()
    np.testing.assert_allclose(path.yaw_rad, np.pi / 2)


def test_position_is_the_polyline_smoothed_by_a_quadratic_b_spline() -> None:
    """The same curve by brute force: sample the polyline in time and convolve."""
    at_s, width_s = 20.7, 4.0
    kernel = BSpline.basis_element(np.linspace(-width_s / 2, width_s / 2, 4))
    shift = np.linspace(-width_s / 2, width_s / 2, 40001)
    weight = kernel(shift) / kernel(shift).sum()
    track = np.clip((at_s - shift) * 5.0, 0, 200)  # arc length flown
    polyline = np.stack([np.minimum(track, 100), np.maximum(track - 100, 0)], axis=-1)
    path = frame_path(L_TURN, 5.0, width_s, 20.0, np.array([at_s]))
    np.testing.assert_allclose(path.position_m[0], weight @ polyline, atol=1e-6)


waypoints = st.lists(st.tuples(st.floats(-500, 500), st.floats(-500, 500)), min_size=1, max_size=6)


@given(waypoints, st.floats(0.5, 30), st.floats(0.2, 20))
def test_derivatives_belong_to_each_other_and_speed_keeps_its_bound(
    route: list[tuple[float, float]], speed_mps: float, turn_time_s: float
) -> None:
    step_s = 1e-3
    path = frame_path(route, speed_mps, turn_time_s, 20.0, np.arange(0, 4, step_s))
    for value, rate in (
        (path.position_m, path.velocity_mps),
        (path.velocity_mps, path.acceleration_mps2),
        (path.yaw_rad, path.yaw_rate_radps),
        (path.yaw_rate_radps, path.yaw_acceleration_radps2),
    ):
        numeric = (value[2:] - value[:-2]) / (2 * step_s)
        np.testing.assert_allclose(numeric, rate[1:-1], atol=0.02 * max(1.0, np.abs(rate).max()))
    assert np.hypot(*path.velocity_mps.T).max() <= speed_mps * (1 + 1e-9)


def test_a_reversal_turns_left_and_never_jumps() -> None:
    path = frame_path(((0, 0), (100, 0), (0, 0)), 5.0, 4.0, 20.0, np.arange(0, 40, 0.1))
    assert path.yaw_rad[-1] == pytest.approx(np.pi)
    assert np.abs(np.diff(path.yaw_rad)).max() <= 0.25 * 0.1 + 1e-9
    assert path.yaw_rate_radps.max() == pytest.approx(MAX_RING_SPEED_MPS / 20.0, rel=1e-3)


def test_small_turns_take_the_turn_time() -> None:
    route = ((0.0, 0.0), (100.0, 0.0), (200.0, 10.0))
    path = frame_path(route, 5.0, 4.0, 20.0, np.array([18.0, 20.0, 22.0]))
    angle = np.arctan2(10, 100)
    np.testing.assert_allclose(path.yaw_rad, [0, angle / 2, angle], atol=1e-12)


def test_hover_and_equal_neighbours() -> None:
    time_s = np.arange(5.0)
    still = frame_path(((7.0, 8.0), (7.0, 8.0)), 5.0, 4.0, 20.0, time_s)
    np.testing.assert_array_equal(still.position_m, [(7.0, 8.0)] * 5)
    assert not still.yaw_rad.any()
    doubled = (L_TURN[0], L_TURN[0], L_TURN[1], L_TURN[1], L_TURN[2])
    np.testing.assert_array_equal(
        frame_path(doubled, 5.0, 4.0, 20.0, time_s).position_m, frame_path(L_TURN, 5.0, 4.0, 20.0, time_s).position_m
    )


def test_spread_is_a_step_of_unit_height() -> None:
    ramp, step, slope = spread(np.array([-2.0, 0.0, 2.0, 5.0]), 4.0)
    np.testing.assert_allclose(step, [0, 0.5, 1, 1], atol=1e-12)
    np.testing.assert_allclose(ramp[[0, 2, 3]], [0, 2, 5], atol=1e-12)
    np.testing.assert_allclose(slope, [0, 2.25 / 4, 0, 0], atol=1e-12)
