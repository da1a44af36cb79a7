"""The one frame convention, stated once, and the way out of it and back.

World: ENU, x east, y north, z up, metres, right-handed. Body: FLU, x forward, y left, z up.
Attitude: the rotation that takes body coordinates to world coordinates, as a unit quaternion in the
order x, y, z, w (as in scipy and ROS). Yaw: angle from east to the body's x axis, counter-clockwise
seen from above, radians; 0 is east, π/2 is north.

MAVLink and most autopilots use NED (x north, y east, z down), FRD (x forward, y right, z down) and the
quaternion order w, x, y, z. An attitude needs *both* changes of basis, the world's on the left and the
body's on the right; swapping quaternion components alone gives a wrong attitude that looks right when
the drone is level and flies north-east. Both changes of basis are their own inverses, and so are the
functions below that use them.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]

_NED_FROM_ENU = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
_FLU_FROM_FRD = Rotation.from_matrix([[1, 0, 0], [0, -1, 0], [0, 0, -1]])


def swap_enu_ned(vector: npt.ArrayLike) -> Array:
    """World vectors [..., 3] from ENU to NED, or from NED to ENU."""
    v = np.asarray(vector, dtype=float)
    return np.stack([v[..., 1], v[..., 0], -v[..., 2]], axis=-1)


def swap_flu_frd(vector: npt.ArrayLike) -> Array:
    """Body vectors [..., 3] (rates, accelerations) from FLU to FRD, or from FRD to FLU."""
    v = np.asarray(vector, dtype=float)
    return np.stack([v[..., 0], -v[..., 1], -v[..., 2]], axis=-1)


def swap_attitude(quaternion_xyzw: npt.ArrayLike) -> Array:
    """Attitudes [..., 4] from FLU-in-ENU to FRD-in-NED, or the other way; x, y, z, w with w ≥ 0.

    Raises:
        ValueError: a quaternion of zero norm.
    """
    q = np.asarray(quaternion_xyzw, dtype=float)
    swapped = _NED_FROM_ENU * Rotation.from_quat(q.reshape(-1, 4)) * _FLU_FROM_FRD
    out: Array = swapped.as_quat(canonical=True).reshape(q.shape)
    return out


def to_wxyz(quaternion_xyzw: npt.ArrayLike) -> Array:
    """Quaternions [..., 4] in MAVLink's order."""
    return np.roll(np.asarray(quaternion_xyzw, dtype=float), 1, axis=-1)


def to_xyzw(quaternion_wxyz: npt.ArrayLike) -> Array:
    """Quaternions [..., 4] in this project's order."""
    return np.roll(np.asarray(quaternion_wxyz, dtype=float), -1, axis=-1)


def yaw_rad(quaternion_xyzw: npt.ArrayLike) -> Array:
    """Yaw [...] of FLU-in-ENU attitudes [..., 4]: direction of the body's x axis on the ground, (−π, π]."""
    x, y, z, w = np.moveaxis(np.asarray(quaternion_xyzw, dtype=float), -1, 0)
    yaw: Array = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return yaw


def wrapped(angle_rad: npt.ArrayLike) -> Array:
    """Angles [...] within [−π, π)."""
    within: Array = np.mod(np.asarray(angle_rad, dtype=float) + np.pi, 2 * np.pi) - np.pi
    return within


def up_vector(quaternion_xyzw: npt.ArrayLike) -> Array:
    """The body's z axis in the world, [..., 3], of unit quaternions [..., 4]: third column of the rotation matrix."""
    x, y, z, w = np.moveaxis(np.asarray(quaternion_xyzw, dtype=np.float64), -1, 0)
    return np.stack([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x**2 + y**2)], axis=-1)


def compass_deg(yaw: npt.ArrayLike) -> Array:
    """Compass heading [...] (0 north, 90 east, clockwise, [0, 360)) of ENU yaws in radians."""
    heading = np.mod(90.0 - np.degrees(np.asarray(yaw, dtype=float)), 360.0)
    return np.where(heading >= 360.0, 0.0, heading)  # np.mod may round a tiny negative up to 360


def tangent_plane_m(fixes: npt.ArrayLike, origin: npt.ArrayLike) -> Array:
    """Places on the globe as ENU metres on the plane that touches the WGS-84 ellipsoid at an origin, [K, 3].

    Exact at any distance, by earth-centred coordinates. The plane rises above the ground by d²/12,700 km.

    Args:
        fixes: [K, 3] latitude and longitude in degrees, height in metres.
        origin: the same of one place.

    Example:
        >>> tangent_plane_m([(42.002581974, -81.997751960, 1139.7018)], (42.0, -82.0, 200.0)).round(2).tolist()
        [[186.28, 286.84, 939.69]]
    """
    at, zero = np.asarray(fixes, dtype=float), np.asarray(origin, dtype=float)
    latitude, longitude = np.radians(zero[:2])
    sin, cos, sine, cosine = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    x, y, z = np.moveaxis(_earth_centred_m(at) - _earth_centred_m(zero), -1, 0)
    outward = cosine * x + sine * y
    return np.stack([cosine * y - sine * x, cos * z - sin * outward, sin * z + cos * outward], axis=-1)


def _earth_centred_m(fixes: Array) -> Array:
    """Earth-centred, earth-fixed coordinates [..., 3] of latitudes and longitudes in degrees and heights."""
    a, e2 = 6378137.0, 6.69437999014e-3
    latitude, longitude = np.radians(fixes[..., 0]), np.radians(fixes[..., 1])
    normal_m = a / np.sqrt(1.0 - e2 * np.sin(latitude) ** 2)
    out = (normal_m + fixes[..., 2]) * np.cos(latitude)
    up = (normal_m * (1.0 - e2) + fixes[..., 2]) * np.sin(latitude)
    return np.stack([out * np.cos(longitude), out * np.sin(longitude), up], axis=-1)
