"""What goes from one part of a flight log into another: which device, which clock, which stretch, which place.

1. The first estimator, the receiver's own unknowns, and what of a message is valid.
2. Clocks: leap seconds, the begin of each vehicle and of each file, and fixes by the same clock as the rest.
3. Places of vehicles side by side: one offset, the median's, from the times at which both are known.
4. Which rows a stretch, a hover and an error take.
5. Vehicles as they are heard: whose message, which height, and what no message says.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import log_examples as examples
import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink2

from sortie.fleet.logs.dataflash import RawLog
from sortie.fleet.logs.fields import from_dataflash, from_tlog, from_ulog, utc_at_zero_s
from sortie.fleet.logs.flightlog import FlightLog, Series, _assemble
from sortie.fleet.logs.ground_station import answers
from sortie.fleet.logs.logtrace import _resampled, beside, context_trace, on_one_clock
from sortie.fleet.logs.mavlink import Transmitter, messages
from sortie.fleet.logs.vehicle import VehicleState, after

KINDS = {"ULog": ("timestamp", from_ulog), "DataFlash": ("TimeUS", from_dataflash), "MAVLink": ("timestamp", from_tlog)}


def assembled(kind: str, begin_us: int = 0, **tables: dict[str, list[Any]]) -> FlightLog:
    """A log of some tables, a row every tenth of a second from a time on."""
    stamp, translate = KINDS[kind]
    columns = {name: {k: np.array(v) for k, v in table.items()} for name, table in tables.items()}
    for table in columns.values():
        table.setdefault(stamp, begin_us + np.arange(len(next(iter(table.values())))) * 100_000)
    return _assemble(Path("a.log"), kind, RawLog(columns, (), 1_000.0), translate)


def series(time_s: Any, *columns: Any) -> Series:
    return Series(np.asarray(time_s, float), np.stack([np.asarray(c, float) for c in columns], axis=-1))


def flight(name: str = "a.log", system: int | None = None, begin_s: float = 0.0, **changes: Any) -> FlightLog:
    """A flight of ten seconds of which nothing is known but what is given."""
    nothing: dict[str, Any] = dict.fromkeys(("position", "velocity", "attitude", "battery", "charge", "rssi", "fix"))
    return FlightLog(
        **{"path": Path(name), "system": system, "kind": "ULog", "begin_s": begin_s, "duration_s": 10.0,
           "rssi_unit": "dBm", "parameters": {}, "problems": (), **nothing} | changes
    )  # fmt: skip


# --- what the fields mean ------------------------------------------------------------------------------


def test_the_first_estimator_is_taken() -> None:
    """Two that believe to be 50 m apart, in turn."""
    of = {"PN": [0.0, 50.0] * 4, "PE": [1.0 * (k // 2) for k in range(8)], "PD": [-10.0] * 8}
    speed = {"VN": [0.0, 9.0] * 4, "VE": [5.0, 0.0] * 4, "VD": [0.0] * 8}
    log = assembled("DataFlash", XKF1={"C": [0, 1] * 4, **of, **speed})
    assert log.position is not None
    assert log.velocity is not None
    assert log.position.values.tolist() == [[float(k), 0.0, 0.0] for k in range(4)]
    assert log.velocity.values.tolist() == [[5.0, 0.0, 0.0]] * 4


def test_a_place_on_the_equator_or_the_zero_meridian_is_a_place() -> None:
    """Both zero is what a vehicle says that knows no place."""
    fixes = {
        "lat": [0, 0, 1000],
        "lon": [0, 2000, 0],
        "alt": [5000] * 3,
        "vx": [100] * 3,
        "vy": [200] * 3,
        "vz": [-50] * 3,
    }
    log = assembled("MAVLink", GLOBAL_POSITION_INT=fixes)
    assert log.fix is not None
    assert log.velocity is not None
    np.testing.assert_allclose(log.fix.values, [[0.0, 2e-4, 5.0], [1e-4, 0.0, 5.0]])
    assert log.velocity.values.tolist() == [[2.0, 1.0, 0.5]] * 2


def test_a_vehicle_that_does_not_measure_its_current_has_none() -> None:
    status = {
        "voltage_battery": [16_000, 65_535, 15_000],
        "current_battery": [-1, 100, 1500],
        "battery_remaining": [-1, 50, 40],
    }
    log = assembled("MAVLink", SYS_STATUS=status)
    assert log.battery is not None
    assert log.charge is not None
    np.testing.assert_allclose(log.battery.values, [[16.0, np.nan], [15.0, 15.0]])
    np.testing.assert_allclose(log.charge.values[:, 0], [0.5, 0.4])


def test_a_signal_that_is_not_known_is_none() -> None:
    log = assembled(
        "ULog",
        input_rc={"rssi": [-1, 80, 90]},
        battery_status={"voltage_v": [16.0], "current_a": [1.0], "remaining": [0.5]},
    )
    assert log.rssi is not None
    assert log.rssi.values[:, 0].tolist() == [80.0, 90.0]


def test_a_place_and_a_velocity_are_valid_in_both_parts() -> None:
    """The level part and the height, each of its own: a row counts where both hold."""
    rows = {c: [1.0, 2.0, 3.0] for c in ("x", "y", "z", "vx", "vy", "vz")}
    valid = {"xy_valid": [1, 1, 0], "z_valid": [1, 0, 1], "v_xy_valid": [0, 1, 1], "v_z_valid": [1, 0, 1]}
    log = assembled("ULog", vehicle_local_position={**rows, **valid})
    assert log.position is not None
    assert log.velocity is not None
    assert log.position.time_s.tolist() == [0.0]
    assert log.velocity.values.tolist() == [[3.0, 3.0, -3.0]]


# --- clocks --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("week", "seconds", "utc_s"),
    [
        (1930, 18.0, 1_483_228_800.0),  # 2017-01-01 00:00:00, with the leap second before it
        (1929, 604_799.0, 1_483_228_800.0 - 18.0),
        (1695, 16.0, 1_341_100_800.0),  # 2012-07-01
        (2086, 259_218.0, 1_577_836_800.0),  # 2020-01-01, a Wednesday
    ],
)
def test_utc_is_gps_time_less_its_leap_seconds(week: int, seconds: float, utc_s: float) -> None:
    gps = {"Status": [3], "GWk": [week], "GMS": [round(seconds * 1000)], "TimeUS": [2_000_000]}
    tables = {"GPS": {k: np.array(v) for k, v in gps.items()}}
    assert utc_at_zero_s(RawLog(tables, ())) == pytest.approx(utc_s - 2.0)


def test_a_log_begins_at_its_first_value_by_every_clock() -> None:
    """Its own, the world's, and that of each of its series: of the fixes too, which may come later."""
    log = assembled(
        "ULog",
        5_000_000,
        battery_status={"voltage_v": [16.0] * 30, "current_a": [1.0] * 30, "remaining": [0.5] * 30},
        vehicle_gps_position={
            "fix_type": [0] * 10 + [3] * 10, "latitude_deg": [47.0] * 20, "longitude_deg": [8.0] * 20,
            "altitude_msl_m": [400.0] * 20, "vel_n_m_s": [0.0] * 20, "vel_e_m_s": [0.0] * 20, "vel_d_m_s": [0.0] * 20,
        },
    )  # fmt: skip
    assert (log.begin_s, log.utc_s) == (5.0, 1_005.0)
    assert log.duration_s == pytest.approx(2.9)
    assert log.fix is not None
    assert log.position is not None
    assert log.fix.time_s[0] == pytest.approx(1.0)
    np.testing.assert_array_equal(log.fix.time_s, log.position.time_s)


def test_files_are_put_on_one_clock_by_the_first_moment_of_each() -> None:
    """Vehicles of one file keep their own begins, whichever is named first."""
    late, early = (flight("a.log", 1, 7.0, utc_s=107.0), flight("a.log", 2, 4.0, utc_s=104.0))
    other = flight("b.log", None, 50.0, utc_s=109.0)
    placed = on_one_clock([late, early, other])
    assert [log.begin_s for log in placed] == [107.0, 104.0, 109.0]
    placed = on_one_clock([other, flight("c.log", None, 3.0)])  # it does not say: with the first of the others
    assert [log.begin_s for log in placed] == [109.0, 109.0]
    together = on_one_clock([late, early, other], together=True)
    assert [log.begin_s for log in together] == [3.0, 0.0, 0.0]


def test_flights_side_by_side_last_from_the_first_begin_to_the_last_end() -> None:
    first, second = beside([flight("a.log", 1, 7.0), flight("a.log", 2, 4.0, duration_s=5.0)])
    assert (first.begin_s, first.duration_s, second.duration_s) == (4.0, 13.0, 13.0)


# --- places --------------------------------------------------------------------------------------------


def test_places_side_by_side_are_moved_by_the_median_of_their_fixes() -> None:
    """One fix that is off moves nothing, nor do fixes from before the estimator ran, which was elsewhere then."""
    fixes = np.tile([47.0, 8.0, 400.0], (9, 1))
    fixes[4:, 0] += 0.0009  # it was carried 100 m north before its estimator began, at 4 s
    fixes[4, 0] += 0.01
    time_s = np.arange(9.0)
    anchor = flight(
        "a.log", 1, fix=Series(time_s, np.tile([47.0, 8.0, 400.0], (9, 1))), position=series(time_s, *[[0.0] * 9] * 3)
    )
    other = flight("a.log", 2, fix=Series(time_s, fixes), position=series(time_s[4:], *[[0.0] * 5] * 3))
    _, placed = beside([anchor, other])
    assert placed.position is not None
    np.testing.assert_allclose(placed.position.values, [[0.0, 0.0009 * 111_180, 0.0]] * 5, atol=0.5)


def test_a_vehicle_whose_fixes_all_lie_outside_its_places_is_placed_by_the_nearest() -> None:
    time_s = np.arange(5.0)
    anchor = flight(
        "a.log", 1, fix=Series(time_s, np.tile([47.0, 8.0, 400.0], (5, 1))), position=series(time_s, *[[0.0] * 5] * 3)
    )
    other = flight(
        "a.log",
        2,
        fix=Series(time_s, np.tile([47.0, 8.0, 410.0], (5, 1))),
        position=series([7.0, 8.0], *[[0.0] * 2] * 3),
    )
    _, placed = beside([anchor, other])
    assert placed.position is not None
    np.testing.assert_allclose(placed.position.values, [[0.0, 0.0, 10.0]] * 2, atol=1e-6)


# --- stretches -----------------------------------------------------------------------------------------


def test_a_trace_holds_the_stretch_that_is_asked_for() -> None:
    log = flight(charge=series(np.arange(11.0), 0.9 - 0.01 * np.arange(11.0)))
    columns = context_trace(log, 1.0, 2.0, 6.0)
    np.testing.assert_allclose(columns["t_s"], np.arange(5.0))
    np.testing.assert_allclose(columns["soc"], 0.88 - 0.01 * np.arange(5.0))


def test_a_pause_is_one_by_the_usual_interval_of_its_series() -> None:
    """Of a charge that comes every two seconds, three intervals without one are a pause, and two are none."""
    time_s = np.array([0.0, 2.0, 4.0, 8.0, 10.0, 12.0, 20.0, 22.0])
    log = flight(charge=series(time_s, np.linspace(0.9, 0.8, 8)), duration_s=22.0)
    known = ~np.isnan(context_trace(log, 1.0)["soc"])
    assert known.tolist() == [not 12 < t < 20 for t in range(23)]


# --- vehicles ------------------------------------------------------------------------------------------


def test_a_height_is_that_above_the_origin_and_not_above_home() -> None:
    """GLOBAL_POSITION_INT has both; a vehicle that took off from a hill is still where it is."""
    heartbeat = mavlink2.MAVLink_heartbeat_message(2, 12, 0, 0, 0, 3)
    place = mavlink2.MAVLink_global_position_int_message(0, 470_000_000, 80_000_000, 430_000, 5_000, 100, 200, -50, 0)
    for message in (heartbeat, place):
        message._header.srcSystem = 1
    state = after(after(VehicleState(), heartbeat, 1.0, examples.ORIGIN), place, 2.0, examples.ORIGIN)
    assert state.position_m == pytest.approx((0.0, 0.0, 30.0))
    assert state.velocity_mps == pytest.approx((2.0, 1.0, 0.5))
    assert (state.heartbeat_s, state.position_s, state.attitude_s) == (1.0, 2.0, -math.inf)
    assert state.pose_s == -math.inf


def test_a_vehicle_without_a_fix_has_no_place_yet() -> None:
    """Autopilots say 0° and 0° until they know."""
    heartbeat = mavlink2.MAVLink_heartbeat_message(2, 12, 0, 0, 0, 3)
    nowhere = mavlink2.MAVLink_global_position_int_message(0, 0, 0, 17_000, 0, 0, 0, 0, 0)
    known = after(VehicleState(), heartbeat, 0.0, examples.ORIGIN)
    assert after(known, nowhere, 1.0, examples.ORIGIN) == known


def test_a_local_place_counts_only_where_no_origin_is_given() -> None:
    heartbeat = mavlink2.MAVLink_heartbeat_message(2, 12, 0, 0, 0, 3)
    local = mavlink2.MAVLink_local_position_ned_message(0, 1.0, 2.0, -3.0, 4.0, 5.0, -6.0)
    known = after(VehicleState(), heartbeat, 0.0, None)
    assert after(known, local, 1.0, None).position_m == (2.0, 1.0, 3.0)
    assert after(known, local, 1.0, examples.ORIGIN) == known


def test_a_charge_that_is_not_known_keeps_the_one_before() -> None:
    status = mavlink2.MAVLink_sys_status_message(0, 0, 0, 0, 16_000, 100, 50, 0, 0, 0, 0, 0, 0)
    state = after(VehicleState(), mavlink2.MAVLink_heartbeat_message(2, 12, 0, 0, 0, 3), 0.0, None)
    state = after(state, status, 1.0, None)
    assert state.soc == 0.5
    status.battery_remaining = -1
    assert after(state, status, 2.0, None).soc == 0.5


@pytest.mark.parametrize(("number", "soc"), [(0, 0.4), (1, 0.5)])
def test_the_charge_is_that_of_the_first_battery(number: int, soc: float) -> None:
    status = mavlink2.MAVLink_battery_status_message(number, 0, 1, 0, [16_000] * 10, 100, 0, 0, 40)
    known = VehicleState(system=0, soc=0.5)
    assert after(known, status, 1.0, None).soc == soc


def test_a_drone_answers_messages_to_itself_and_to_all() -> None:
    """Drone 2 is system 3; its neighbours' messages are none of its business."""
    for system, answered in ((0, True), (1, False), (2, False), (3, True), (4, False)):
        request = mavlink2.MAVLink_param_request_read_message(system, 1, b"", 0)
        said = answers(request, 2, {"FIRST": 1.0, "SECOND": 2.0}, {})
        assert [m.param_id for m in said] == (["FIRST"] if answered else [])


def test_a_parameter_is_asked_for_by_its_place_or_by_its_name() -> None:
    for index, name, wanted in (
        (0, b"SECOND", "FIRST"),
        (1, b"", "SECOND"),
        (-1, b"SECOND", "SECOND"),
        (2, b"FIRST", None),
    ):
        said = answers(
            mavlink2.MAVLink_param_request_read_message(3, 1, name, index), 2, {"FIRST": 1.0, "SECOND": 2.0}, {}
        )
        assert [str(m.param_id).rstrip("\0") for m in said] == ([] if wanted is None else [wanted])


def test_a_station_of_the_fleet_is_never_armed_and_courses_are_from_north() -> None:
    landed = replace(examples.state(3), landed=False, ground_station=True)
    parser = mavlink2.MAVLink(None)
    said = [
        m for each in messages(landed, examples.ORIGIN) for m in parser.parse_buffer(Transmitter(0).pack(each)) or []
    ]
    assert said[0].base_mode == 0
    by_name = {m.get_type(): m for m in messages(examples.state(3), examples.ORIGIN)}
    assert by_name["GPS_RAW_INT"].cog == round(math.degrees(math.atan2(3, 4)) * 100)  # 3 m/s east, 4 m/s north
    lost = {m.get_type(): m for m in messages(replace(examples.state(3), fixed=False), examples.ORIGIN)}
    gnss = mavlink2.MAV_SYS_STATUS_SENSOR_GPS
    assert by_name["SYS_STATUS"].onboard_control_sensors_health & gnss
    assert not lost["SYS_STATUS"].onboard_control_sensors_health & gnss


def test_a_value_that_is_unknown_for_a_while_is_a_gap_of_its_own_column() -> None:
    """The other column of the same series goes on; a short pause is bridged, and nothing is known after a column's end."""
    time_s = np.arange(11.0) / 2
    holed, ends, whole = (np.arange(11.0) for _ in range(3))
    holed[3:8] = np.nan  # 1.5 to 3.5 s, from 1.0 s to 4.0 s without a sample
    ends[9:] = np.nan
    found = _resampled(series(time_s, holed, ends, whole), np.array([0.75, 2.5, 4.25, 4.75]))
    np.testing.assert_array_equal(found, [(1.5, 1.5, 1.5), (np.nan, 5.0, 5.0), (8.5, np.nan, 8.5), (9.5, np.nan, 9.5)])
