"""Drone states as MAVLink 2 messages, and as a telemetry log that ground stations open.

MAVLink is NED, FRD and w-first quaternions in scaled integers; `sortie.fleet.flight.frames` does the turning.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import math
import struct
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink2

from sortie.fleet.flight.frames import compass_deg, swap_attitude, swap_enu_ned, swap_flu_frd, to_wxyz, yaw_rad
from sortie.fleet.logs.geodesy import Origin, geodetic
from sortie.fleet.logs.telemetry import KEY_BYTES, Telemetry
from sortie.scenarios.replacing import replacing

_GNSS = mavlink2.MAV_SYS_STATUS_SENSOR_GPS
_SENSORS = (
    mavlink2.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | mavlink2.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | mavlink2.MAV_SYS_STATUS_SENSOR_BATTERY
    | mavlink2.MAV_SYS_STATUS_PREARM_CHECK
    | _GNSS
)
_ALL_WELL = 0xFFFFFFFF
"""Ground stations announce a failure for every zero bit of health, such as a fence breach, even of what is absent."""
_UNKNOWN_U8 = 0xFF
_UNKNOWN_U16 = 0xFFFF
_MAX_I16 = 0x7FFF
_STILL_MPS = 0.1
"""Below this a course over ground means nothing."""
LOG_STAMP = struct.Struct(">Q")
"""Before each frame of a telemetry log: µs since 1970."""
SIGNING_EPOCH_US = 1_420_070_400_000_000
"""2015-01-01, from which the clocks of signed frames count."""
_BAD_SIGNATURE = "Invalid signature"
"""pymavlink's reason."""


def messages(state: Telemetry, origin: Origin) -> list[mavlink2.MAVLink_message]:
    """HEARTBEAT, ATTITUDE_QUATERNION and ATTITUDE, LOCAL_POSITION_NED, GLOBAL_POSITION_INT, SYS_STATUS,
    EXTENDED_SYS_STATE, BATTERY_STATUS; of a vehicle also VFR_HUD, GPS_RAW_INT and HOME_POSITION."""
    time_ms = round(state.time_s * 1000)
    q = to_wxyz(swap_attitude(state.orientation_xyzw)).tolist()
    rates = swap_flu_frd(state.body_rates_radps).tolist()
    position, velocity = swap_enu_ned(state.position_m).tolist(), swap_enu_ned(state.velocity_mps).tolist()
    latitude, longitude, altitude = geodetic(state.position_m, origin)
    heading = round(float(compass_deg(yaw_rad(state.orientation_xyzw))) * 100) % 36000
    charge, current_ca = round(state.soc * 100), _fitting(state.current_a * 100)
    station = state.ground_station
    return [
        mavlink2.MAVLink_heartbeat_message(
            mavlink2.MAV_TYPE_GCS if station else mavlink2.MAV_TYPE_QUADROTOR,
            mavlink2.MAV_AUTOPILOT_INVALID if station else mavlink2.MAV_AUTOPILOT_GENERIC,
            0 if state.landed or station else mavlink2.MAV_MODE_FLAG_SAFETY_ARMED | mavlink2.MAV_MODE_FLAG_AUTO_ENABLED,
            0,
            mavlink2.MAV_STATE_STANDBY if state.landed else mavlink2.MAV_STATE_ACTIVE,
            3,
        ),
        mavlink2.MAVLink_attitude_quaternion_message(time_ms, *q, *rates),
        mavlink2.MAVLink_attitude_message(time_ms, *_roll_pitch_yaw(*q), *rates),
        mavlink2.MAVLink_local_position_ned_message(time_ms, *position, *velocity),
        mavlink2.MAVLink_global_position_int_message(
            time_ms,
            round(latitude * 1e7),
            round(longitude * 1e7),
            round(altitude * 1000),
            round(state.position_m[2] * 1000),
            *(_fitting(v * 100) for v in velocity),
            heading,
        ),
        mavlink2.MAVLink_sys_status_message(
            _SENSORS,
            _SENSORS,
            _ALL_WELL if state.fixed else _ALL_WELL & ~_GNSS,
            round(state.cpu_load * 1000),
            min(round(state.voltage_v * 1000), _UNKNOWN_U16),
            current_ca,
            charge,
            *(0,) * 6,
        ),
        mavlink2.MAVLink_extended_sys_state_message(
            mavlink2.MAV_VTOL_STATE_UNDEFINED,
            mavlink2.MAV_LANDED_STATE_ON_GROUND if state.landed or station else mavlink2.MAV_LANDED_STATE_IN_AIR,
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
        *([] if station else _of_a_vehicle(state, origin, heading)),
    ]


def _of_a_vehicle(state: Telemetry, origin: Origin, heading_cdeg: int) -> list[mavlink2.MAVLink_message]:
    """What ground stations read of a vehicle alone. The place in GPS_RAW_INT is the true one: errors are not recorded."""
    latitude, longitude, altitude = geodetic(state.position_m, origin)
    home = geodetic(state.home_m, origin)
    east, north, up = state.velocity_mps
    ground_mps = math.hypot(east, north)
    course_cdeg = round(math.degrees(math.atan2(east, north)) * 100) % 36000
    fix = mavlink2.GPS_FIX_TYPE_3D_FIX if state.fixed else mavlink2.GPS_FIX_TYPE_NO_FIX
    return [
        mavlink2.MAVLink_vfr_hud_message(
            math.nan,  # there is no airspeed sensor
            ground_mps,
            heading_cdeg // 100,
            0,  # throttle is not modelled
            altitude,
            up,
        ),
        mavlink2.MAVLink_gps_raw_int_message(
            round(state.time_s * 1e6),
            fix,
            round(latitude * 1e7),
            round(longitude * 1e7),
            round(altitude * 1000),
            _UNKNOWN_U16,
            _UNKNOWN_U16,
            min(round(ground_mps * 100), _UNKNOWN_U16 - 1),
            course_cdeg if ground_mps > _STILL_MPS else _UNKNOWN_U16,
            _UNKNOWN_U8 if state.fixed else 0,
        ),
        mavlink2.MAVLink_home_position_message(
            round(home[0] * 1e7),
            round(home[1] * 1e7),
            round(home[2] * 1000),
            *swap_enu_ned(state.home_m).tolist(),
            [math.nan] * 4,  # neither a heading there nor a way to it
            *(math.nan,) * 3,
        ),
    ]


def _roll_pitch_yaw(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """The aircraft's angles of an attitude FRD in NED, rad."""
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _fitting(value: float) -> int:
    """A number in 16 bits; what traces tell may lie beyond them."""
    return max(-_MAX_I16, min(round(value), _MAX_I16))


def _pack_voltage_mv(voltage_v: float) -> list[int]:
    """BATTERY_STATUS.voltages: cells are not modelled singly, so the pack's voltage stands in slot 0 and what does
    not fit there in the slots after it, as the message's definition asks."""
    full, rest = divmod(round(voltage_v * 1000), _UNKNOWN_U16 - 1)
    slots = [_UNKNOWN_U16 - 1] * full + [rest] * (rest > 0 or not full)
    return slots + [_UNKNOWN_U16] * (10 - len(slots))


STATUS = frozenset({"HEARTBEAT", "SYS_STATUS", "EXTENDED_SYS_STATE", "BATTERY_STATUS", "GPS_RAW_INT", "HOME_POSITION"})
"""Messages of `messages` that an autopilot sends once a second; the others go at the telemetry's own rate."""


def _sign(mav: mavlink2.MAVLink, key: bytes, now_us: int) -> None:
    """Sign what goes out, and ask for valid signatures of what comes in; `now_us` is in µs since 1970."""
    if len(key) != KEY_BYTES:
        raise ValueError(f"the signing key has {len(key)} B, must have {KEY_BYTES}")
    signing = mav.signing
    signing.secret_key, signing.link_id, signing.sign_outgoing = key, 0, True
    signing.timestamp = max(signing.timestamp, (now_us - SIGNING_EPOCH_US) // 10)


class Transmitter:
    """One vehicle's MAVLink 2 stream: system id = drone id + 1 (0 means everybody), frames numbered in a row.

    With a key of 32 B every frame is signed (13 B more); `signed_at_us`, in µs since 1970, is where its clock begins.
    """

    def __init__(self, drone: int, key: bytes | None = None, signed_at_us: int = SIGNING_EPOCH_US) -> None:
        self._mav = mavlink2.MAVLink(None, srcSystem=drone + 1, srcComponent=mavlink2.MAV_COMP_ID_AUTOPILOT1)
        if key is not None:
            _sign(self._mav, key, signed_at_us)

    def pack(self, message: mavlink2.MAVLink_message) -> bytes:
        """The next frame."""
        frame: bytes = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame


class Companion:
    """A drone's companion computer on the telemetry link: what it sends to its vehicle, signed where it has a key."""

    def __init__(self, key: bytes | None = None) -> None:
        self._mav = mavlink2.MAVLink(None, srcComponent=mavlink2.MAV_COMP_ID_ONBOARD_COMPUTER)
        self._key = key

    def ask(self, vehicle: int, rates_hz: Mapping[int, float]) -> bytes:
        """A heartbeat, and a request for messages at their rates, by message id; MAV_CMD_SET_MESSAGE_INTERVAL."""
        if self._key is not None:
            _sign(self._mav, self._key, time.time_ns() // 1000)  # a vehicle that restarted wants the present time
        self._mav.srcSystem = vehicle
        said: list[mavlink2.MAVLink_message] = [
            mavlink2.MAVLink_heartbeat_message(
                mavlink2.MAV_TYPE_ONBOARD_CONTROLLER, mavlink2.MAV_AUTOPILOT_INVALID, 0, 0, mavlink2.MAV_STATE_ACTIVE, 3
            )
        ]
        command = mavlink2.MAV_CMD_SET_MESSAGE_INTERVAL
        said += [
            mavlink2.MAVLink_command_long_message(
                vehicle, mavlink2.MAV_COMP_ID_AUTOPILOT1, command, 0, number, 1e6 / rate_hz, 0, 0, 0, 0, 0
            )
            for number, rate_hz in rates_hz.items()
        ]
        frames = b""
        for message in said:
            frames += bytes(message.pack(self._mav))
            self._mav.seq = (self._mav.seq + 1) % 256
        return frames


class _Verifier(mavlink2.MAVLink):  # type: ignore[misc]
    """A parser that judges a signature before its time.

    pymavlink keeps the time of a frame before it looks at the signature. A stranger's frame from the future would
    therefore refuse all later frames of the vehicle.
    """

    def check_signature(self, msgbuf: bytearray, srcSystem: int, srcComponent: int) -> bool:  # noqa: N803 - pymavlink's
        made = hashlib.sha256((self.signing.secret_key or b"") + bytes(msgbuf[:-6])).digest()[:6]
        fits = hmac.compare_digest(made, bytes(msgbuf[-6:]))
        return fits and bool(super().check_signature(msgbuf, srcSystem, srcComponent))


class Listener:
    """Takes what vehicles and ground stations say; bytes that are no frame are passed over.

    With a key of 32 B, frames are taken only with a valid signature that was not used.
    """

    def __init__(self, key: bytes | None = None) -> None:
        self._mav = _Verifier(None)
        self._mav.robust_parsing = True
        self.refused = 0
        """Frames without a valid signature."""
        if key is not None:
            _sign(self._mav, key, time.time_ns() // 1000)

    def heard(self, data: bytes) -> list[mavlink2.MAVLink_message]:
        """The messages that these bytes complete."""
        with contextlib.suppress(mavlink2.MAVError):
            known = self._mav.parse_buffer(data) or []
            self.refused += sum(m.get_type() == "BAD_DATA" and m.reason == _BAD_SIGNATURE for m in known)
            return [m for m in known if m.get_type() != "BAD_DATA" and not m.get_type().startswith("UNKNOWN")]
        return []


def write_tlog(path: Path | str, frames: Iterable[tuple[int, bytes]]) -> None:
    """Write a telemetry log: for every frame its time as big-endian u64 µs since 1970, then the frame.

    The log is there whole or not at all (`sortie.scenarios.replacing`).

    Args:
        path: conventionally *.tlog.
        frames: (µs since 1970, MAVLink frame), in order of time.

    Raises:
        OSError: the disk refuses, or `path` is a folder.
    """
    with replacing(Path(path)) as partial, partial.open("wb") as file:
        for time_us, frame in frames:
            file.write(LOG_STAMP.pack(time_us) + frame)
