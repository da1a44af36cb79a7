"""Drone states as MAVLink 2 messages, and as a telemetry log that ground stations open.

MAVLink is NED, FRD and w-first quaternions in scaled integers; `fleet.frames` does the turning. Positions on the
globe lie on a plane through a stated origin, with the WGS-84 ellipsoid's two radii of curvature there: within 5 km
of the origin the error stays below 2 m · tan(latitude) horizontally, and height is height above the plane.
"""

from __future__ import annotations

import contextlib
import math
import os
import struct
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink2

from fleet.frames import compass_deg, swap_attitude, swap_enu_ned, swap_flu_frd, to_wxyz, yaw_rad

_SENSORS = (
    mavlink2.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink2.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink2.MAV_SYS_STATUS_SENSOR_GPS
    | mavlink2.MAV_SYS_STATUS_SENSOR_BATTERY
)
_UNKNOWN_U16 = 0xFFFF
_MAX_I16 = 0x7FFF
_LOG_STAMP = struct.Struct(">Q")


@dataclass(frozen=True, slots=True)
class Origin:
    """Where ENU (0, 0, 0) lies: WGS-84 degrees, metres above mean sea level."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float = 0.0

    def __post_init__(self) -> None:
        if not (abs(self.latitude_deg) <= 85 and abs(self.longitude_deg) <= 180):
            raise ValueError(
                f"origin is ({self.latitude_deg}, {self.longitude_deg}), must lie within ±85° and ±180°: a local "
                "east and north mean nothing at a pole"
            )


@dataclass(frozen=True, slots=True)
class Telemetry:
    """One drone at one time; ENU, FLU, x y z w."""

    time_s: float
    """Since the sortie's begin."""
    position_m: tuple[float, float, float]
    orientation_xyzw: tuple[float, float, float, float]
    velocity_mps: tuple[float, float, float]
    body_rates_radps: tuple[float, float, float]
    soc: float
    voltage_v: float
    current_a: float
    energy_used_j: float
    cpu_load: float
    """0 … 1."""
    landed: bool


def geodetic(position_m: tuple[float, float, float], origin: Origin) -> tuple[float, float, float]:
    """ENU metres to latitude and longitude in degrees and altitude in metres."""
    a, e2 = 6378137.0, 6.69437999014e-3  # WGS-84
    phi = math.radians(origin.latitude_deg)
    w = math.sqrt(1 - e2 * math.sin(phi) ** 2)
    meridian_m = a * (1 - e2) / w**3 + origin.altitude_m
    normal_m = a / w + origin.altitude_m
    east, north, up = position_m
    latitude = origin.latitude_deg + math.degrees(north / meridian_m)
    longitude = origin.longitude_deg + math.degrees(east / (normal_m * math.cos(phi)))
    return latitude, (longitude + 180) % 360 - 180, origin.altitude_m + up


def messages(state: Telemetry, origin: Origin) -> list[mavlink2.MAVLink_message]:
    """HEARTBEAT, ATTITUDE_QUATERNION, LOCAL_POSITION_NED, GLOBAL_POSITION_INT, SYS_STATUS, BATTERY_STATUS."""
    time_ms = round(state.time_s * 1000)
    q = to_wxyz(swap_attitude(state.orientation_xyzw)).tolist()
    rates = swap_flu_frd(state.body_rates_radps).tolist()
    position, velocity = swap_enu_ned(state.position_m).tolist(), swap_enu_ned(state.velocity_mps).tolist()
    latitude, longitude, altitude = geodetic(state.position_m, origin)
    heading = round(float(compass_deg(yaw_rad(state.orientation_xyzw))) * 100) % 36000
    charge, current_ca = round(state.soc * 100), min(round(state.current_a * 100), _MAX_I16)
    return [
        mavlink2.MAVLink_heartbeat_message(
            mavlink2.MAV_TYPE_QUADROTOR,
            mavlink2.MAV_AUTOPILOT_GENERIC,
            0 if state.landed else mavlink2.MAV_MODE_FLAG_SAFETY_ARMED | mavlink2.MAV_MODE_FLAG_AUTO_ENABLED,
            0,
            mavlink2.MAV_STATE_STANDBY if state.landed else mavlink2.MAV_STATE_ACTIVE,
            3,
        ),
        mavlink2.MAVLink_attitude_quaternion_message(time_ms, *q, *rates),
        mavlink2.MAVLink_local_position_ned_message(time_ms, *position, *velocity),
        mavlink2.MAVLink_global_position_int_message(
            time_ms,
            round(latitude * 1e7),
            round(longitude * 1e7),
            round(altitude * 1000),
            round(state.position_m[2] * 1000),
            *(round(v * 100) for v in velocity),
            heading,
        ),
        mavlink2.MAVLink_sys_status_message(
            _SENSORS,
            _SENSORS,
            _SENSORS,
            round(state.cpu_load * 1000),
            min(round(state.voltage_v * 1000), _UNKNOWN_U16),
            current_ca,
            charge,
            *(0,) * 6,
        ),
        mavlink2.MAVLink_battery_status_message(
            0,
            mavlink2.MAV_BATTERY_FUNCTION_ALL,
            mavlink2.MAV_BATTERY_TYPE_LIPO,
            _MAX_I16,  # temperature unknown
            _pack_voltage_mv(state.voltage_v),
            current_ca,
            -1,  # charge used is not kept; energy is
            round(state.energy_used_j / 100),
            charge,
        ),
    ]


def _pack_voltage_mv(voltage_v: float) -> list[int]:
    """BATTERY_STATUS.voltages: cells are not modelled singly, so the pack's voltage stands in slot 0 and what does
    not fit there in slot 1, as the message's definition asks."""
    total = round(voltage_v * 1000)
    if total < _UNKNOWN_U16:
        return [total] + [_UNKNOWN_U16] * 9
    return [_UNKNOWN_U16 - 1, total - _UNKNOWN_U16 + 1] + [_UNKNOWN_U16] * 8


class Transmitter:
    """One vehicle's MAVLink 2 stream: system id = drone id + 1 (0 means everybody), frames numbered in a row."""

    def __init__(self, drone: int) -> None:
        self._mav = mavlink2.MAVLink(None, srcSystem=drone + 1, srcComponent=mavlink2.MAV_COMP_ID_AUTOPILOT1)

    def pack(self, message: mavlink2.MAVLink_message) -> bytes:
        """The next frame."""
        frame: bytes = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame


def write_tlog(path: Path | str, frames: Iterable[tuple[int, bytes]]) -> None:
    """Write a telemetry log: for every frame its time as big-endian u64 µs since 1970, then the frame.

    Written to a temporary name beside `path` and renamed, so that a log is there whole or not at all.

    Args:
        path: conventionally *.tlog.
        frames: (µs since 1970, MAVLink frame), in order of time.
    """
    path = Path(path)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            for time_us, frame in frames:
                file.write(_LOG_STAMP.pack(time_us) + frame)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(temporary)
        raise
