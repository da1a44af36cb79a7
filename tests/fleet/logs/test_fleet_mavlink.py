"""MAVLink messages on values that can be checked by hand, and a log that pymavlink's own reader opens."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from pathlib import Path

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink2
from scipy.spatial.transform import Rotation

from sortie.fleet.logs.geodesy import Origin, geodetic
from sortie.fleet.logs.mavlink import Transmitter, messages, write_tlog
from sortie.fleet.logs.telemetry import Telemetry

ZURICH = Origin(47.0, 8.5, 400.0)
STATE = Telemetry(
    time_s=12.3456,
    position_m=(30.0, 40.0, 60.0),
    orientation_xyzw=tuple(Rotation.from_euler("ZYX", [135, -10, 0], degrees=True).as_quat().tolist()),
    velocity_mps=(-3.0, 4.0, 1.0),
    body_rates_radps=(0.01, 0.02, 0.2),
    soc=0.874,
    voltage_v=15.236,
    current_a=16.107,
    energy_used_j=51_700.0,
    cpu_load=0.55,
    landed=False,
)
"""Flies north-west at 5 m/s, nose 10° up, yaws left at 0.2 rad/s, climbs at 1 m/s."""


def sent(state: Telemetry = STATE) -> dict[str, mavlink2.MAVLink_message]:
    """Through the wire and pymavlink's parser."""
    transmitter, parser = Transmitter(2), mavlink2.MAVLink(None)
    return {m.get_type(): m for each in messages(state, ZURICH) for m in parser.parse_buffer(transmitter.pack(each))}


def test_mavlink_2_from_system_drone_plus_one_and_numbered_in_a_row() -> None:
    transmitter = Transmitter(2)
    frames = [transmitter.pack(m) for m in messages(STATE, ZURICH)]
    assert [frame[0] for frame in frames] == [0xFD] * 11
    assert [frame[4] for frame in frames] == list(range(11))
    assert {frame[5] for frame in frames} == {3}
    for _ in range(300):
        last = transmitter.pack(messages(STATE, ZURICH)[0])
    assert last[4] == (10 + 300) % 256


def test_position_and_velocity_are_ned() -> None:
    m = sent()["LOCAL_POSITION_NED"]
    assert (m.x, m.y, m.z) == (40, 30, -60)
    assert (m.vx, m.vy, m.vz) == (4, -3, -1)
    assert m.time_boot_ms == 12346


def test_attitude_is_frd_in_ned_w_first_and_in_angles() -> None:
    """North-west and nose up, yawing left, which is negative in NED; and north with the right wing down."""
    m = sent()["ATTITUDE_QUATERNION"]
    angles = Rotation.from_quat([m.q2, m.q3, m.q4, m.q1]).as_euler("ZYX", degrees=True)
    assert angles == pytest.approx((-45, 10, 0), abs=1e-4)
    assert (m.rollspeed, m.pitchspeed, m.yawspeed) == pytest.approx((0.01, -0.02, -0.2))
    rolled = tuple(Rotation.from_euler("ZYX", [90, 0, 20], degrees=True).as_quat().tolist())
    for state, wanted in ((STATE, (-45, 10, 0)), (replace(STATE, orientation_xyzw=rolled), (0, 0, 20))):
        m = sent(state)["ATTITUDE"]
        assert [math.degrees(a) for a in (m.yaw, m.pitch, m.roll)] == pytest.approx(wanted, abs=1e-4)


def test_global_position() -> None:
    """A degree of latitude at 47° is 111,170 m and one of longitude 76,055 m on WGS-84 (400 m up: 6 and 5 m more)."""
    m = sent()["GLOBAL_POSITION_INT"]
    assert m.lat / 1e7 == pytest.approx(47 + 40 / 111_177, abs=2e-7)
    assert m.lon / 1e7 == pytest.approx(8.5 + 30 / 76_060, abs=2e-7)
    assert (m.alt, m.relative_alt) == (460_000, 60_000)
    assert (m.vx, m.vy, m.vz) == (400, -300, -100)
    assert m.hdg == 31500


def test_battery_and_health() -> None:
    status, battery, heartbeat = (sent()[name] for name in ("SYS_STATUS", "BATTERY_STATUS", "HEARTBEAT"))
    assert (status.voltage_battery, status.current_battery, status.battery_remaining) == (15236, 1611, 87)
    assert status.load == 550
    assert battery.voltages == [15236] + [65535] * 9
    assert (battery.current_battery, battery.battery_remaining, battery.energy_consumed) == (1611, 87, 517)
    assert battery.type == mavlink2.MAV_BATTERY_TYPE_LIPO
    assert heartbeat.type == mavlink2.MAV_TYPE_QUADROTOR
    assert heartbeat.system_status == mavlink2.MAV_STATE_ACTIVE
    assert heartbeat.base_mode & mavlink2.MAV_MODE_FLAG_SAFETY_ARMED


def test_landed_is_disarmed_and_so_is_a_ground_station_of_the_fleet() -> None:
    landed, station = (sent(replace(STATE, **{what: True})) for what in ("landed", "ground_station"))
    assert landed["HEARTBEAT"].base_mode == station["HEARTBEAT"].base_mode == 0
    assert landed["EXTENDED_SYS_STATE"].landed_state == mavlink2.MAV_LANDED_STATE_ON_GROUND
    assert sent()["EXTENDED_SYS_STATE"].landed_state == mavlink2.MAV_LANDED_STATE_IN_AIR
    assert landed["HEARTBEAT"].system_status == mavlink2.MAV_STATE_STANDBY
    assert not {"VFR_HUD", "GPS_RAW_INT", "HOME_POSITION"} & station.keys()
    assert station["HEARTBEAT"].type == mavlink2.MAV_TYPE_GCS


def test_what_a_trace_may_tell_fits_the_wire() -> None:
    """Voltages to 200 V, which overflow into further slots, currents of either sign, a jump of 20 km within a row."""
    large = sent(replace(STATE, voltage_v=100.0, current_a=500.0))
    assert large["BATTERY_STATUS"].voltages == [65534, 34466] + [65535] * 8
    assert large["SYS_STATUS"].voltage_battery == 65535
    assert large["SYS_STATUS"].current_battery == 32767
    far = sent(replace(STATE, voltage_v=200.0, current_a=-500.0, velocity_mps=(2e5, -2e5, 0.0)))
    assert far["BATTERY_STATUS"].voltages == [65534, 65534, 65534, 3398] + [65535] * 6
    assert far["SYS_STATUS"].current_battery == far["BATTERY_STATUS"].current_battery == -32767
    assert (far["GLOBAL_POSITION_INT"].vx, far["GLOBAL_POSITION_INT"].vy) == (-32767, 32767)


def test_what_a_ground_station_s_instruments_show() -> None:
    """Course 323.13° of 5 m/s over ground, climbing at 1 m/s; home is the ground below the start."""
    seen = sent(replace(STATE, home_m=(10.0, -20.0, 0.0)))
    hud, fix, home, globe = (seen[k] for k in ("VFR_HUD", "GPS_RAW_INT", "HOME_POSITION", "GLOBAL_POSITION_INT"))
    assert (hud.groundspeed, hud.climb, hud.heading, hud.alt) == (5.0, 1.0, 315, 460.0)
    assert math.isnan(hud.airspeed)
    assert (fix.fix_type, fix.vel, fix.cog, fix.time_usec) == (3, 500, 32313, 12_345_600)
    assert (fix.lat, fix.lon, fix.alt) == (globe.lat, globe.lon, globe.alt)
    assert (home.x, home.y, home.z, home.altitude) == (-20.0, 10.0, 0.0, 400_000)
    assert home.latitude / 1e7 == pytest.approx(47 - 20 / 111_177, abs=2e-7)
    hovering = sent(replace(STATE, velocity_mps=(0.0, 0.01, 0.0)))["GPS_RAW_INT"]
    assert hovering.cog == 65535


def test_health_says_what_fails_and_nothing_else() -> None:
    """A zero bit of health is announced by ground stations, even of a fence that is absent."""
    fence, gnss = mavlink2.MAV_SYS_STATUS_GEOFENCE, mavlink2.MAV_SYS_STATUS_SENSOR_GPS
    well, lost = (sent(replace(STATE, fixed=fixed)) for fixed in (True, False))
    assert not well["SYS_STATUS"].onboard_control_sensors_present & fence
    assert well["SYS_STATUS"].onboard_control_sensors_health & fence
    assert well["SYS_STATUS"].onboard_control_sensors_health & gnss
    assert lost["SYS_STATUS"].onboard_control_sensors_health == 0xFFFFFFFF & ~gnss
    assert (lost["GPS_RAW_INT"].fix_type, lost["GPS_RAW_INT"].satellites_visible) == (1, 0)


def test_geodetic_against_the_ellipsoid() -> None:
    """Earth-centred coordinates of both ends are as far apart as the drone is from the origin."""

    def ecef(latitude: float, longitude: float, altitude: float) -> tuple[float, float, float]:
        a, e2 = 6378137.0, 6.69437999014e-3
        phi, lam = math.radians(latitude), math.radians(longitude)
        n = a / math.sqrt(1 - e2 * math.sin(phi) ** 2)
        return (
            (n + altitude) * math.cos(phi) * math.cos(lam),
            (n + altitude) * math.cos(phi) * math.sin(lam),
            (n * (1 - e2) + altitude) * math.sin(phi),
        )

    here = ecef(ZURICH.latitude_deg, ZURICH.longitude_deg, ZURICH.altitude_m)
    for east, north, up in ((500.0, 0.0, 0.0), (0.0, 500.0, 0.0), (300.0, -400.0, 120.0)):
        there = ecef(*geodetic((east, north, up), ZURICH))
        assert math.dist(here, there) == pytest.approx(math.hypot(east, north, up), abs=0.03)


def test_date_line_and_poles() -> None:
    _, longitude, _ = geodetic((1000.0, 0.0, 0.0), Origin(0.0, 179.999))
    assert -180 <= longitude < -179.9
    with pytest.raises(ValueError, match="must lie within ±85°"):
        Origin(89.0, 0.0)


def test_pymavlink_opens_the_log(tmp_path: Path) -> None:
    path, begin_us = tmp_path / "drone.tlog", 1_700_000_000_000_000
    transmitter = Transmitter(0)
    write_tlog(path, ((begin_us + k * 100_000, transmitter.pack(m)) for k in range(3) for m in messages(STATE, ZURICH)))
    assert struct.unpack(">Q", path.read_bytes()[:8]) == (begin_us,)
    log = mavutil.mavlink_connection(str(path))
    read = []
    while (m := log.recv_match()) is not None:
        read.append((m.get_type(), m._timestamp))
    log.close()
    assert len(read) == 33
    assert "BAD_DATA" not in {name for name, _ in read}
    assert read[-1] == ("HOME_POSITION", pytest.approx(1_700_000_000.2))


def test_a_log_is_there_whole_or_not_at_all(tmp_path: Path) -> None:
    def breaks() -> object:
        yield 1, b"frame"
        raise RuntimeError("lost")

    with pytest.raises(RuntimeError, match="lost"):
        write_tlog(tmp_path / "drone.tlog", breaks())
    assert list(tmp_path.iterdir()) == []
