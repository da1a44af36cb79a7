"""Conversions between ENU/FLU and NED/FRD on values that can be checked by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sortie.fleet.flight.frames import (
    compass_deg,
    swap_attitude,
    swap_enu_ned,
    swap_flu_frd,
    to_wxyz,
    to_xyzw,
    up_vector,
    yaw_rad,
)

HALF = np.sqrt(0.5)
quaternions = (
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1).map(lambda q: q / np.linalg.norm(q))
)
vectors = st.tuples(*[st.floats(-100, 100)] * 3).map(np.asarray)


def test_east_north_up_become_the_second_first_and_minus_third_of_ned() -> None:
    assert swap_enu_ned([1, 2, 3]).tolist() == [2, 1, -3]
    assert swap_flu_frd([1, 2, 3]).tolist() == [1, -2, -3]


def test_level_flight() -> None:
    """East, north, west and south, with the quaternions of both frames by hand; q and −q are one attitude."""
    for enu_xyzw, ned_wxyz in (
        ((0, 0, 0, 1), (HALF, 0, 0, HALF)),
        ((0, 0, HALF, HALF), (1, 0, 0, 0)),
        ((0, 0, 1, 0), (HALF, 0, 0, -HALF)),
        ((0, 0, -HALF, HALF), (0, 0, 0, 1)),
    ):
        assert abs(to_wxyz(swap_attitude(enu_xyzw)) @ np.asarray(ned_wxyz)) == pytest.approx(1), enu_xyzw


@given(*[st.floats(-80, 80)] * 3)
def test_tilts_seen_from_ned(yaw: float, pitch: float, roll: float) -> None:
    """An autopilot's yaw, pitch, roll in NED/FRD; in ENU/FLU yaw is 90° − yaw, pitch changes sign, roll does not."""
    enu = Rotation.from_euler("ZYX", [90 - yaw, -pitch, roll], degrees=True).as_quat()
    ned = Rotation.from_quat(swap_attitude(enu)).as_euler("ZYX", degrees=True)
    np.testing.assert_allclose(ned, [yaw, pitch, roll], atol=1e-9)


@given(quaternions, vectors)
def test_a_body_vector_lands_at_the_same_place_in_the_world(q: np.ndarray, v: np.ndarray) -> None:
    through_enu = swap_enu_ned(Rotation.from_quat(q).apply(v))
    through_frd = Rotation.from_quat(swap_attitude(q)).apply(swap_flu_frd(v))
    np.testing.assert_allclose(through_frd, through_enu, atol=1e-9)


@given(quaternions)
def test_up_is_where_the_bodys_z_axis_points(q: np.ndarray) -> None:
    np.testing.assert_allclose(up_vector(q), Rotation.from_quat(q).apply([0, 0, 1]), atol=1e-9)


@given(quaternions)
def test_swapping_twice_gives_the_attitude_back(q: np.ndarray) -> None:
    assert abs(swap_attitude(swap_attitude(q)) @ q) == pytest.approx(1)
    assert to_xyzw(to_wxyz(q)).tolist() == q.tolist()


def test_yaw_is_the_direction_of_the_nose() -> None:
    q = Rotation.from_euler("ZYX", [[100, 20, 30], [-170, -40, 5]], degrees=True).as_quat()
    nose = Rotation.from_quat(q).apply([1, 0, 0])
    np.testing.assert_allclose(yaw_rad(q), np.arctan2(nose[:, 1], nose[:, 0]))
    np.testing.assert_allclose(np.degrees(yaw_rad(q)), [100, -170])


def test_compass() -> None:
    np.testing.assert_allclose(compass_deg(np.radians([0, 90, 180, -90, 91])), [90, 0, 270, 180, 359], atol=1e-9)
    assert compass_deg(np.pi / 2 + 1e-18) < 360
    assert compass_deg(np.radians(90.0 + 1e-14)) < 360
