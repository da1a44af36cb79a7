"""Wrong rows of flight logs: what is left out, with the line that says so, and what the fields of each format mean."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from itertools import product
from pathlib import Path
from typing import Any

import log_examples as examples
import numpy as np
import pytest
from log_tables import CHARGE, EAST_M, ROWS, T_S, assembled, at_rows, known, ulog

from sortie.fleet.logs.dataflash import RawLog
from sortie.fleet.logs.fields import from_dataflash, from_tlog, from_ulog, utc_at_zero_s
from sortie.fleet.logs.flightlog import FlightLog, _assemble, read_log

# --- samples and times that cannot be ---------------------------------------------------------------------

CHARGE_OFF = "rows of charge do not fit the others and are left out"
NO_TIME = "rows have an impossible time and are left out"
AWAY = "rows of position jump away from the others and are left out"
BATTERY, ATTITUDE, PLACE = "battery_status", "vehicle_attitude", "vehicle_local_position"
IMPOSSIBLE: list[tuple[str, str, Iterable[int], float, str, str]] = [
    (BATTERY, "remaining", [50], 0.02, "charge", f"1 {CHARGE_OFF}"),
    (BATTERY, "remaining", [50], 1.0, "charge", f"1 {CHARGE_OFF}"),
    (BATTERY, "remaining", [ROWS - 1], 0.02, "charge", f"1 {CHARGE_OFF}"),
    (BATTERY, "remaining", range(20), 0.0, "charge", f"20 {CHARGE_OFF}"),
    (BATTERY, "remaining", range(60), 0.0, "charge", f"60 {CHARGE_OFF}"),
    (BATTERY, "remaining", range(0, ROWS, 2), 0.0, "charge", f"50 {CHARGE_OFF}"),
    (BATTERY, "remaining", [3, 4], -1.0, "charge", "2 rows of charge are unknown and are left out"),
    (BATTERY, "remaining", [3], np.nan, "charge", "1 rows of charge are not finite and are left out"),
    (BATTERY, "remaining", [3], 2.55, "charge", "1 rows of charge are below 0 % or above 100 % and are left out"),
    (BATTERY, "voltage_v", [3], 0.0, "battery", "1 rows of battery are unknown and are left out"),
    (BATTERY, "voltage_v", [3], 0.4, "battery", "1 rows of battery have a voltage that no pack has and are left out"),
    (BATTERY, "voltage_v", [3], 65.535, "battery", "1 rows of battery do not fit the others and are left out"),
    (BATTERY, "timestamp", [50], 1e18, "battery and charge", f"1 {NO_TIME}: battery_status 1"),
    (BATTERY, "timestamp", [50], 0, "battery and charge", f"1 {NO_TIME}: battery_status 1"),
    (ATTITUDE, "timestamp", [0], 0, "attitude", f"1 {NO_TIME}: vehicle_attitude 1"),
    (ATTITUDE, "timestamp", [ROWS - 1], 1e15, "attitude", f"1 {NO_TIME}: vehicle_attitude 1"),
    (PLACE, "y", [50], 4000.0, "position", f"1 {AWAY}"),
    (PLACE, "y", range(3), -4000.0, "position", f"3 {AWAY}"),
    (PLACE, "y", [0], -2e6, "position", "1 positions lie over 20 km off and are left out"),
    (PLACE, "xy_valid", [7], 0, "position", "1 rows of position are not valid and are left out"),
]
"""Topic, column, rows, their wrong value, which series lose these rows, and what the log says of it."""


def test_a_row_that_cannot_be_is_left_out_and_counted() -> None:
    for topic, column, wrong, value, gone, said in IMPOSSIBLE:
        tables, rows = ulog(), list(wrong)
        tables[topic][column] = tables[topic][column].copy()
        tables[topic][column][rows] = value
        log = assembled(tables)
        assert said in log.problems, (topic, column, rows, value)
        left = sorted(set(range(ROWS)) - set(rows))
        for what in ("position", "attitude", "battery", "charge"):
            kept = at_rows(getattr(log, what), log.begin_s - 5).tolist()
            assert kept == (left if what in gone else list(range(ROWS))), (what, said)
        charge, place = known(log.charge), known(log.position)
        np.testing.assert_allclose(charge.values[:, 0], CHARGE[at_rows(charge)], atol=1e-9, err_msg=said)
        np.testing.assert_allclose(np.diff(place.values[:, 0]) / np.diff(place.time_s), 5.0, err_msg=said)
        assert set(known(log.battery).values[:, 0]) == {12.3}


def test_of_two_packs_the_longer_one_is_taken() -> None:
    """A charge never rises."""
    tables = ulog()
    tables[BATTERY]["remaining"] = np.r_[np.full(60, 0.4), CHARGE[60:]]
    log = assembled(tables)
    assert f"40 {CHARGE_OFF}" in log.problems
    np.testing.assert_allclose(known(log.charge).values, 0.4)


def test_a_step_with_a_damaged_time_is_left_out_of_a_file(tmp_path: Path) -> None:
    """All rows of one step, as a logger wrote them one after another: no duration of 35,000 years."""
    for (kind, count), (step, seconds) in product((("bin", 6), ("ulg", 4)), ((0, 9.8), (50, 9.9), (99, 9.8))):
        stamp = struct.pack("<Q", 5_000_000 + 100_000 * step)
        parts = examples.KINDS[kind]().split(stamp)
        parts = [stamp.join(parts[:-count]), *parts[-count:]]  # the log's begin and a parameter have step 0's time
        (tmp_path / f"a.{kind}").write_bytes(struct.pack("<Q", 2**60).join(parts))
        log = read_log(tmp_path / f"a.{kind}")
        assert len(log.problems) == 1
        assert log.problems[0].startswith(f"{count} rows have an impossible time and are left out: ")
        assert log.duration_s == pytest.approx(seconds), (kind, step)


def test_a_few_rows_that_are_further_away_than_all_others_last_are_damaged() -> None:
    tables = ulog()
    for table in tables.values():
        table["timestamp"] = np.r_[np.zeros(3), table["timestamp"][3:] + 1e10]
    log = assembled(tables)
    assert log.problems[0].startswith("9 rows have an impossible time and are left out: ")
    assert log.duration_s == pytest.approx(9.6)


def test_what_lasts_is_believed() -> None:
    """An estimator that starts anew 800 m off, and a gauge that corrects itself downwards, are no damage."""
    tables = ulog()
    tables["vehicle_local_position"]["y"] = EAST_M + 800.0 * (T_S >= 5)
    tables["battery_status"]["remaining"] = CHARGE - 0.2 * (T_S >= 5)
    log = assembled(tables)
    assert log.problems == ()
    assert known(log.position).values[-1, 0] == pytest.approx(800 + EAST_M[-1])


def test_rows_out_of_order_are_put_in_order() -> None:
    tables = ulog()
    swapped = np.arange(ROWS)
    swapped[[40, 41, 60, 67]] = [41, 40, 67, 60]
    for table in tables.values():
        table.update({name: column[swapped] for name, column in table.items()})
    log = assembled(tables)
    for what in ("position", "battery"):
        assert at_rows(getattr(log, what)).tolist() == list(range(ROWS))
        assert f"3 rows of {what} came out of order and are put in order" in log.problems
    np.testing.assert_allclose(known(log.position).values[:, 0], EAST_M)


def test_of_two_boots_the_longer_one_is_taken_whole() -> None:
    """For all values alike: a pack of one and a place of the other never were side by side."""
    tables = ulog()
    rebooted = {name: np.r_[table["timestamp"][-40:] - 6e6, table["timestamp"] - 5e6] for name, table in tables.items()}
    for name, table in tables.items():
        table.update({c: np.concatenate([column[:40], column]) for c, column in table.items()})
        table["timestamp"] = rebooted[name]
    tables["battery_status"]["remaining"][:40] = 0.2
    log = assembled(tables)
    assert log.problems == ("the clock restarts 1 times; the longest stretch is taken, rows 121 to 420 of 420",)
    assert at_rows(log.charge).tolist() == at_rows(log.position).tolist() == list(range(ROWS))


# --- what the fields mean ---------------------------------------------------------------------------------


def of_fields(kind: str, begin_us: int = 0, **tables: dict[str, list[Any]]) -> FlightLog:
    """A log of some tables, a row every tenth of a second from a time on; the clock began at 1,000 s of UTC."""
    stamp, translate = {
        "ULog": ("timestamp", from_ulog),
        "DataFlash": ("TimeUS", from_dataflash),
        "MAVLink": ("timestamp", from_tlog),
    }[kind]
    columns = {name: {k: np.array(v) for k, v in table.items()} for name, table in tables.items()}
    for name, table in columns.items():
        if name != "PARM":
            table[stamp] = begin_us + np.arange(len(next(iter(table.values())))) * 100_000
    return _assemble(Path("a.log"), kind, RawLog(columns, (), 1_000.0), translate)


def test_a_signal_strength_that_the_radio_does_not_know_is_left_out_and_told() -> None:
    """MAVLink's 255 was read as +7.2 dBm; ULog's −1 is unknown too."""
    for kind, name, field in (
        ("DataFlash", "RAD", "RSSI"),
        ("ULog", "radio_status", "rssi"),
        ("MAVLink", "RADIO_STATUS", "rssi"),
        ("MAVLink", "RADIO", "rssi"),
    ):
        log = of_fields(kind, **{name: {field: [190, 255, 190]}})
        np.testing.assert_allclose(known(log.rssi).values, [[-27.0], [-27.0]])  # 190/1.9 − 127
        assert log.rssi_unit == "dBm"
        assert log.problems == ("1 rows of rssi are not finite and are left out",)
        assert of_fields(kind, **{name: {field: [255, 255]}}).rssi is None
    remote = of_fields("ULog", input_rc={"rssi": [-1, 80, 90]})
    assert (remote.rssi_unit, known(remote.rssi).values[:, 0].tolist()) == ("percent", [80.0, 90.0])


def test_what_an_autopilot_does_not_know_is_no_value() -> None:
    """0 V before it measures, −1 A and −1 of the charge; ArduPilot counts nothing where it has no sensor."""
    unknown = {"voltage_v": [0, 16, 16], "current_a": [-1, -1, 5], "remaining": [-1] * 3}
    log = of_fields("ULog", battery_status=unknown)
    assert log.charge is None
    np.testing.assert_array_equal(known(log.battery).values, [[16, np.nan], [16, 5]])
    capacity = {"Name": [b"BATT_CAPACITY"], "Value": [5000.0]}
    unmeasured = {"Volt": [0.0, 16.0, 16.0], "Curr": [0.0] * 3, "CurrTot": [0.0] * 3}
    log = of_fields("DataFlash", BAT=unmeasured, PARM=capacity)
    assert known(log.battery).values.tolist() == [[16.0, 0.0]] * 2
    assert log.charge is None
    volts, amperes, left = [16_000, 65_535, 15_000], [-1, 100, 1500], [-1, 50, 40]
    status = {"voltage_battery": volts, "current_battery": amperes, "battery_remaining": left}
    log = of_fields("MAVLink", SYS_STATUS=status)
    np.testing.assert_allclose(known(log.battery).values, [[16.0, np.nan], [15.0, 15.0]])
    np.testing.assert_allclose(known(log.charge).values[:, 0], [0.5, 0.4])


def test_a_place_on_the_equator_or_the_zero_meridian_is_a_place() -> None:
    """Both zero is what a vehicle says that knows no place."""
    place = {"lat": [0, 0, 1000], "lon": [0, 2000, 0], "alt": [5000] * 3}
    log = of_fields("MAVLink", GLOBAL_POSITION_INT={**place, "vx": [100] * 3, "vy": [200] * 3, "vz": [-50] * 3})
    np.testing.assert_allclose(known(log.fix).values, [[0.0, 2e-4, 5.0], [1e-4, 0.0, 5.0]])
    assert known(log.velocity).values.tolist() == [[2.0, 1.0, 0.5]] * 2


def test_a_place_and_a_velocity_are_valid_in_both_parts() -> None:
    """The level part and the height, each of its own: a row counts where both hold."""
    rows = {c: [1.0, 2.0, 3.0] for c in ("x", "y", "z", "vx", "vy", "vz")}
    valid = {"xy_valid": [1, 1, 0], "z_valid": [1, 0, 1], "v_xy_valid": [0, 1, 1], "v_z_valid": [1, 0, 1]}
    log = of_fields("ULog", vehicle_local_position={**rows, **valid})
    assert known(log.position).time_s.tolist() == [0.0]
    assert known(log.velocity).values.tolist() == [[3.0, 3.0, -3.0]]


def test_a_fix_that_is_too_far_is_left_out_wherever_it_stands() -> None:
    """A degree off, the first one too: it is no origin, from which all others would lie too far."""
    for wrong in (0, 4, 9):
        lat = [47.0 + 1e-5 * k for k in range(10)]
        lat[wrong] -= 1.0
        log = of_fields("DataFlash", GPS={"Status": [3] * 10, "Lat": lat, "Lng": [8.0] * 10, "Alt": [400.0] * 10})
        assert "1 positions lie over 20 km off and are left out" in log.problems
        first = int(wrong == 0)
        assert log.origin_deg == pytest.approx((47.0 + 1e-5 * first, 8.0))
        north_m = [1.1117 * (k - first) for k in range(10) if k != wrong]
        np.testing.assert_allclose(known(log.position).values[:, 1], north_m, atol=1e-3)


def test_a_charge_that_rises_slowly_is_held() -> None:
    """A gauge by the voltage recovers after a load."""
    left = np.concatenate([np.linspace(0.9, 0.8, 50), np.linspace(0.8, 0.85, 50)]).tolist()
    rows = {"voltage_v": [16.0] * 100, "current_a": [1.0] * 100, "remaining": left}
    log = of_fields("ULog", battery_status=rows)
    assert known(log.charge).values[-1, 0] == pytest.approx(0.8)
    assert log.problems == ("the charge rises by up to 5.0%; it is held",)


def test_a_log_begins_at_its_first_value_by_every_clock() -> None:
    """Its own, the world's, and that of each of its series: of the fixes too, which may come later."""
    place = {"latitude_deg": [47.0] * 20, "longitude_deg": [8.0] * 20, "altitude_msl_m": [400.0] * 20}
    still = {name: [0.0] * 20 for name in ("vel_n_m_s", "vel_e_m_s", "vel_d_m_s")}
    receiver = {"fix_type": [0] * 10 + [3] * 10, **place, **still}
    pack = {"voltage_v": [16.0] * 30, "current_a": [1.0] * 30, "remaining": [0.5] * 30}
    log = of_fields("ULog", 5_000_000, battery_status=pack, vehicle_gps_position=receiver)
    assert (log.begin_s, log.utc_s) == (5.0, 1_005.0)
    assert log.duration_s == pytest.approx(2.9)
    assert known(log.fix).time_s[0] == pytest.approx(1.0)
    np.testing.assert_array_equal(known(log.fix).time_s, known(log.position).time_s)


def test_utc_is_gps_time_less_its_leap_seconds() -> None:
    new_year_2017_s = 1_483_228_800.0
    for week, seconds, utc_s in (
        (1930, 18.0, new_year_2017_s),  # with the leap second before it
        (1929, 604_799.0, new_year_2017_s - 18.0),
        (1695, 16.0, 1_341_100_800.0),  # 2012-07-01
        (2086, 259_218.0, 1_577_836_800.0),  # 2020-01-01, a Wednesday
    ):
        gps = {"Status": [3], "GWk": [week], "GMS": [round(seconds * 1000)], "TimeUS": [2_000_000]}
        tables = {"GPS": {k: np.array(v) for k, v in gps.items()}}
        assert utc_at_zero_s(RawLog(tables, ())) == pytest.approx(utc_s - 2.0), week
