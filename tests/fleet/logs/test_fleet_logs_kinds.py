"""Wrong rows of flight logs by kind: what is left out, which device and which clock is taken, and the line that says so.

All flights are straight: 5 m/s east for 10 s, at 10 rows a second, with a charge that falls from 90 % by 0.1 % a row.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import log_examples as examples
import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sortie.fleet.logs.dataflash import RawLog, parameter_table
from sortie.fleet.logs.fields import from_dataflash, from_ulog
from sortie.fleet.logs.flightlog import FlightLog, Series, _assemble, read_log, read_logs
from sortie.fleet.logs.vehicle import VehicleState, after
from sortie.sim.cli.import_log import flown_log

CASES = Path(os.environ.get("SORTIE_LOG_CASES", Path(__file__).resolve().parents[4] / "shared/cases"))
ROWS = 100
T_S = np.arange(ROWS) / 10
EAST_M = 5.0 * T_S
CHARGE = 0.9 - 0.001 * np.arange(ROWS)
DEGREE_M = 111_319.49
"""Of longitude on the equator at sea level."""

Tables = dict[str, dict[str, Any]]


def ulog() -> Tables:
    """As PX4 logs it; 5 s after boot."""
    at = {"timestamp": np.round((5 + T_S) * 1e6)}
    zero, one = np.zeros(ROWS), np.ones(ROWS)
    flown = {"x": zero, "y": EAST_M, "z": -20 * one, "vx": zero, "vy": 5 * one, "vz": zero}
    valid = dict.fromkeys(("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"), one)
    return {
        "vehicle_local_position": at | flown | valid,
        "vehicle_attitude": at | {"q": np.tile([1.0, 0, 0, 0], (ROWS, 1))},
        "battery_status": at | {"voltage_v": 12.3 * one, "current_a": 10 * one, "remaining": CHARGE},
    }


def gnss(status: float = 3, lon_deg: np.ndarray | float = 8 + EAST_M / DEGREE_M) -> dict[str, Any]:
    """A receiver's rows in PX4's fields."""
    of = {"latitude_deg": 0.0, "longitude_deg": lon_deg, "altitude_msl_m": 0.0, "fix_type": status}
    of |= {"vel_n_m_s": 0.0, "vel_e_m_s": 5.0, "vel_d_m_s": 0.0}
    return {name: np.full(ROWS, value, float) for name, value in of.items()} | {"timestamp": np.round((5 + T_S) * 1e6)}


def assembled(tables: Tables, translate: Callable[..., Any] = from_ulog, **parameters: float) -> FlightLog:
    columns = {name: {c: np.asarray(v) for c, v in table.items()} for name, table in tables.items()}
    orders = {name: np.arange(len(next(iter(t.values())))) for name, t in columns.items()}  # written side by side
    orders = {name: order * (ROWS / len(order)) for name, order in orders.items()}
    raw = RawLog({**columns, "PARM": parameter_table(parameters)}, (), orders=orders)
    return _assemble(Path("a.log"), "ULog", raw, translate)


def at_rows(series: Series | None, begin_s: float = 0.0) -> np.ndarray:
    """Which of the flight's rows a series has."""
    assert series is not None
    rows = np.round((series.time_s + begin_s) * 10).astype(int)
    np.testing.assert_allclose(series.time_s + begin_s, rows / 10, atol=1e-6)
    return rows


# --- samples and times that cannot be ----------------------------------------------------------------

CHARGE_OFF = "rows of charge do not fit the others and are left out"
NO_TIME = "rows have an impossible time and are left out"
AWAY = "rows of position jump away from the others and are left out"


@pytest.mark.parametrize(
    ("topic", "column", "rows", "value", "gone", "said"),
    [
        ("battery_status", "remaining", [50], 0.02, "charge", f"1 {CHARGE_OFF}"),
        ("battery_status", "remaining", [50], 1.0, "charge", f"1 {CHARGE_OFF}"),
        ("battery_status", "remaining", [ROWS - 1], 0.02, "charge", f"1 {CHARGE_OFF}"),
        ("battery_status", "remaining", range(20), 0.0, "charge", f"20 {CHARGE_OFF}"),
        ("battery_status", "remaining", range(60), 0.0, "charge", f"60 {CHARGE_OFF}"),
        ("battery_status", "remaining", range(0, ROWS, 2), 0.0, "charge", f"50 {CHARGE_OFF}"),
        ("battery_status", "remaining", range(60), 0.4, "battery or charge", f"40 {CHARGE_OFF}"),
        ("battery_status", "remaining", [3, 4], -1.0, "charge", "2 rows of charge are unknown and are left out"),
        ("battery_status", "remaining", [3], np.nan, "charge", "1 rows of charge are not finite and are left out"),
        ("battery_status", "remaining", [3], 2.55, "charge", "1 rows of charge are below 0 % or above 100 % and are left out"),
        ("battery_status", "voltage_v", [3], 0.0, "battery", "1 rows of battery are unknown and are left out"),
        ("battery_status", "voltage_v", [3], 0.4, "battery", "1 rows of battery have a voltage that no pack has and are left out"),
        ("battery_status", "voltage_v", [3], 65.535, "battery", "1 rows of battery do not fit the others and are left out"),
        ("battery_status", "timestamp", [50], 1e18, "battery and charge", f"1 {NO_TIME}: battery_status 1"),
        ("battery_status", "timestamp", [50], 0, "battery and charge", f"1 {NO_TIME}: battery_status 1"),
        ("vehicle_attitude", "timestamp", [0], 0, "attitude", f"1 {NO_TIME}: vehicle_attitude 1"),
        ("vehicle_attitude", "timestamp", [ROWS - 1], 1e15, "attitude", f"1 {NO_TIME}: vehicle_attitude 1"),
        ("vehicle_local_position", "y", [50], 4000.0, "position", f"1 {AWAY}"),
        ("vehicle_local_position", "y", range(3), -4000.0, "position", f"3 {AWAY}"),
        ("vehicle_local_position", "y", [0], -2e6, "position", "1 positions lie over 20 km off and are left out"),
        ("vehicle_local_position", "xy_valid", [7], 0, "position", "1 rows of position are not valid and are left out"),
    ],
)  # fmt: skip
def test_a_row_that_cannot_be_is_left_out_and_counted(
    topic: str, column: str, rows: Iterable[int], value: float, gone: str, said: str
) -> None:
    tables, rows = ulog(), list(rows)
    tables[topic][column] = tables[topic][column].copy()
    tables[topic][column][rows] = value
    log = assembled(tables)
    assert said in log.problems
    if gone == "battery or charge":  # the longer of two packs: a charge never rises
        assert log.charge is not None
        np.testing.assert_allclose(log.charge.values, 0.4)
        return
    left = sorted(set(range(ROWS)) - set(rows))
    for what in ("position", "attitude", "battery", "charge"):
        series = getattr(log, what)
        assert at_rows(series, log.begin_s - 5).tolist() == (left if what in gone else list(range(ROWS))), what
    assert log.charge is not None
    np.testing.assert_allclose(log.charge.values[:, 0], CHARGE[at_rows(log.charge)], atol=1e-9)
    assert log.position is not None
    assert log.battery is not None
    np.testing.assert_allclose(np.diff(log.position.values[:, 0]) / np.diff(log.position.time_s), 5.0)
    assert set(log.battery.values[:, 0]) == {12.3}


@pytest.mark.parametrize(("kind", "count"), [("bin", 6), ("ulg", 4)])
@pytest.mark.parametrize(("step", "seconds"), [(0, 9.8), (50, 9.9), (99, 9.8)])
def test_a_step_with_a_damaged_time_is_left_out_of_a_file(
    kind: str, count: int, step: int, seconds: float, tmp_path: Path
) -> None:
    """All rows of one step, as a logger wrote them one after another: no duration of 35,000 years."""
    stamp = struct.pack("<Q", 5_000_000 + 100_000 * step)
    parts = examples.KINDS[kind]().split(stamp)
    parts = [stamp.join(parts[:-count]), *parts[-count:]]  # the log's begin and a parameter have the time of step 0
    (tmp_path / f"a.{kind}").write_bytes(struct.pack("<Q", 2**60).join(parts))
    log = read_log(tmp_path / f"a.{kind}")
    assert len(log.problems) == 1
    assert log.problems[0].startswith(f"{count} rows have an impossible time and are left out: ")
    assert log.duration_s == pytest.approx(seconds)


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
    assert log.position is not None
    assert log.position.values[-1, 0] == pytest.approx(800 + EAST_M[-1])


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
    assert log.position is not None
    np.testing.assert_allclose(log.position.values[:, 0], EAST_M)


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


# --- which device ------------------------------------------------------------------------------------


def test_the_first_battery_that_is_connected_is_taken() -> None:
    noise = ulog()["battery_status"] | {"voltage_v": np.full(ROWS, 0.3), "remaining": np.zeros(ROWS)}
    real = ulog()["battery_status"]
    cell_count = {"cell_count": np.full(ROWS, 3), "capacity": np.full(ROWS, 4500.0)}
    for first, said in (
        (None, None),
        (noise | {"connected": np.zeros(ROWS)}, "battery is read from battery_status.1: 0 of 100 rows of battery_status count"),
        (noise, "battery is read from battery_status.1: 0 of 100 rows of battery_status count"),
        (real | {"voltage_v": np.r_[np.full(10, 24.0), np.zeros(90)]}, "2 batteries, battery_status.1 is taken"),
    ):  # fmt: skip
        tables = ulog() | {"battery_status.1": real | cell_count}
        tables.pop("battery_status")
        log = assembled(tables if first is None else tables | {"battery_status": first})
        assert said is None or said in log.problems
        assert (log.cells, log.capacity_ah) == (3, 4.5)
        assert set(log.battery.values[:, 0]) == {12.3} if log.battery else False
        assert at_rows(log.charge).tolist() == list(range(ROWS))


@pytest.mark.parametrize("topic", ["vehicle_gps_position", "sensor_gps"])
def test_the_first_receiver_with_a_fix_is_taken(topic: str) -> None:
    tables = {"battery_status": ulog()["battery_status"], f"{topic}.1": gnss()}
    assert assembled(tables).origin_deg == (0.0, 8.0)
    log = assembled(tables | {topic: gnss(status=1, lon_deg=9.0)})
    assert log.position is not None
    np.testing.assert_allclose(log.position.values[:, 0], EAST_M, atol=1e-3)
    assert f"position is read from {topic}.1: 0 of 100 rows of {topic} count" in log.problems


def test_the_estimator_that_flies_is_taken() -> None:
    """PX4 runs several, and switches from 0 to 1 after 4 s, where 0 begins to drift."""
    drift = np.where(T_S >= 4, 50.0, 0.0)
    local = ulog()["vehicle_local_position"]
    tables = {f"estimator_local_position.{k}": local | {"y": EAST_M + drift * (k == 0)} for k in (1, 2)}
    tables["estimator_local_position"] = local | {"y": EAST_M + drift}
    selected = {"timestamp": np.array([5e6, 9e6]), "primary_instance": np.array([0, 1])}
    log = assembled(tables | {"estimator_selector_status": selected})
    assert log.position is not None
    np.testing.assert_allclose(log.position.values[:, 0], EAST_M)
    only = assembled({"vehicle_local_position.1": local}).position
    assert only is not None
    np.testing.assert_allclose(only.values[:, 0], EAST_M)


def dataflash(rows: int = ROWS) -> Tables:
    at = {"TimeUS": np.round((5 + T_S) * 1e6)}
    zero, one = np.zeros(ROWS), np.ones(ROWS)
    return {
        "GPS": at | {"I": zero, "Status": 3 * one, "Lat": zero, "Lng": EAST_M / DEGREE_M + 1e-9, "Alt": zero},
        "XKF1": at | {"C": zero, "PN": zero, "PE": EAST_M, "PD": -20 * one, "VN": zero, "VE": 5 * one, "VD": zero},
        "BAT": at | {"Inst": zero, "Volt": 12.3 * one, "Curr": 10 * one, "CurrTot": (1 - CHARGE) * 5000},
    }


def beside(table: dict[str, Any], column: str, **changes: Any) -> dict[str, Any]:
    """A device's rows and those of a second one, in turn."""
    second = table | {column: np.ones(ROWS), **{name: np.full(ROWS, value, float) for name, value in changes.items()}}
    return {name: np.stack([table[name], second[name]], axis=1).ravel() for name in table}


@pytest.mark.parametrize(
    ("change", "capacity_ah"),
    [
        (lambda t: t["BAT"].update(Inst=np.ones(ROWS)), 5.0),
        (lambda t: t.update(BAT=beside(t["BAT"] | {"Volt": np.full(ROWS, 0.3)}, "Inst", Volt=12.3)), 5.0),
        (lambda t: t.update(BAT2=t.pop("BAT")) or t["BAT2"].pop("Inst"), 5.0),
        (lambda t: t.update(CURR2=t.pop("BAT")) or t["CURR2"].pop("Inst"), 5.0),
        (lambda t: t["GPS"].update(I=np.ones(ROWS)) or t.pop("XKF1"), 9.0),
        (lambda t: t.update(GPS=beside(t["GPS"] | {"Status": np.ones(ROWS)}, "I", Status=3)) or t.pop("XKF1"), 9.0),
        (lambda t: t.update(GPS2=t.pop("GPS")) or t["GPS2"].pop("I") is t.pop("XKF1"), 9.0),
        (lambda t: t["XKF1"].update(C=np.ones(ROWS)), 9.0),
        (lambda t: t.update(XKF1=beside(t["XKF1"] | {"PE": EAST_M * 2}, "C")) or lead(t, EAST_M), 9.0),
        (lambda t: (t.pop("XKF1") and t.update(POS={c: t["GPS"][c] for c in ("TimeUS", "Lat", "Lng", "Alt")})) or t.pop("GPS"), 9.0),
    ],
    ids=["battery 1", "noise", "BAT2", "CURR2", "GPS 1", "no fix", "GPS2", "core 1", "lane switch", "POS"],
)  # fmt: skip
def test_whichever_of_ardupilot_s_devices_is_there_is_taken(
    change: Callable[[Tables], object], capacity_ah: float
) -> None:
    """The second battery has a capacity of its own."""
    tables = dataflash()
    change(tables)
    log = assembled(tables, from_dataflash, BATT_CAPACITY=9000.0, BATT2_CAPACITY=5000.0)
    assert log.position is not None
    np.testing.assert_allclose(log.position.values[:, 0], EAST_M, atol=1e-3)
    assert log.battery is not None
    assert set(log.battery.values[:, 0]) == {12.3}
    assert log.capacity_ah == capacity_ah
    assert log.charge is not None
    np.testing.assert_allclose(1 - log.charge.values[:, 0], (1 - CHARGE) * 5 / capacity_ah, atol=1e-9)


def lead(tables: Tables, east_m: np.ndarray) -> None:
    """Core 1 is right, and ArduPilot flies by it."""
    tables["XKF1"]["PE"][1::2] = east_m
    tables["XKF4"] = {"TimeUS": tables["BAT"]["TimeUS"], "PI": np.ones(ROWS)}


@pytest.mark.parametrize(
    ("cells", "volts", "parameters", "wanted"),
    [
        (None, 12.3, {}, (3, None)),
        (None, 13.05, {"BAT1_N_CELLS": 3.0, "BAT1_CAPACITY": 4500.0}, (3, 4.5)),
        (6, 21.0, {"BAT1_CAPACITY": -1.0}, (6, None)),
        (0, 21.0, {"BAT_N_CELLS": 6.0, "BAT_CAPACITY": 4500.0}, (6, 4.5)),
        (3, 24.9, {}, (6, None)),
        (None, np.r_[np.full(50, 12.5), 12.9, np.full(49, 12.5)], {}, (3, None)),
    ],
)
def test_cells_and_capacity_are_the_log_s_own(
    cells: int | None, volts: Any, parameters: dict[str, float], wanted: tuple[int, float | None]
) -> None:
    """Where the log does not say, or says what no cell has, the voltage decides; a single sample does not."""
    tables = ulog()
    tables["battery_status"]["voltage_v"] = np.zeros(ROWS) + volts
    if cells is not None:
        tables["battery_status"]["cell_count"] = np.full(ROWS, cells)
    log = assembled(tables, **parameters)
    assert (log.cells, log.capacity_ah) == wanted
    assert ("3 cells would have 8.3 V each; 6 are taken" in log.problems) == (cells == 3)


# --- telemetry ---------------------------------------------------------------------------------------


class Telemetry:
    """A vehicle's messages as a ground computer writes them down."""

    def __init__(self) -> None:
        self.data = b""

    def add(self, stamp_s: float, name: str, *values: Any, sender: tuple[int, int] = (1, 1)) -> None:
        """A message with its fields in the order of its definition."""
        parser = dialect.MAVLink(None, *sender)
        message = getattr(dialect, f"MAVLink_{name}_message")(*values)
        self.data += struct.pack(">Q", round(stamp_s * 1e6)) + message.pack(parser)

    def flight(
        self, messages: str = "HGLAS", stamp_s: Callable[[float], float] = lambda t: 1.7e9 + t, boot_s: float = 5.0,
        rows: Iterable[int] = range(ROWS), charge: Callable[[int], int] = lambda k: round(100 * CHARGE[k]),
        east_m: float = 0.0, damaged: Callable[[int, int], int] = lambda k, ms: ms,
    ) -> Telemetry:  # fmt: skip
        """Rows of the flight: heartbeat, GLOBAL_, LOCAL_POSITION, ATTITUDE, SYS_STATUS, GPS_RAW_INT (R)."""
        for k in rows:
            at, ms = stamp_s(T_S[k]), damaged(k, round((boot_s + T_S[k]) * 1000))
            place = 1, round((EAST_M[k] + east_m) / DEGREE_M * 1e7)
            if "H" in messages and k % 10 == 0:
                self.add(at, "heartbeat", 2, 3, 0, 0, 4, 3)
            if "S" in messages:
                self.add(at, "sys_status", 0, 0, 0, 0, 12_300, 1000, charge(k), *[0] * 6)
            if "G" in messages:
                self.add(at, "global_position_int", ms, *place, 20_000, 0, 0, 500, 0, 0)
            if "L" in messages:
                self.add(at, "local_position_ned", ms, 0.0, EAST_M[k], -20.0, 0.0, 5.0, 0.0)
            if "A" in messages:
                self.add(at, "attitude", ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            if "R" in messages:
                self.add(at, "gps_raw_int", 1000 * ms, 3, *place, 20_000, 65535, 65535, 500, 9000, 10)
        return self

    def read(self, folder: Path) -> FlightLog:
        (folder / "a.tlog").write_bytes(self.data)
        return read_log(folder / "a.tlog")


OFF = "the ground computer's clock is off by over 0.25 s for {} messages; the vehicle's is taken"


@pytest.mark.parametrize(
    ("stamp_s", "boot_s", "said", "utc_s"),
    [
        (lambda t: 1.7e9 + t, 5.0, (), 1.7e9),
        (lambda t: t if t < 3 else 1.7e9 + t, 5.0, (OFF.format(93),), 1.7e9),
        (lambda t: 1.7e9 + t - 3600 * (t >= 5), 5.0, (OFF.format(155),), 1.7e9 - 3600),
        (lambda t: 1.7e9 + t - 3 * (t >= 5), 5.0, (OFF.format(155),), 1.7e9 - 3),
        (lambda t: 1.7e9 + t + 86_400 * (t == 5), 5.0, (OFF.format(4),), 1.7e9),
        (lambda t: 1.7e9, 5.0, (), None),
        (lambda t: 1.7e9 + t + 0.5 * (t >= 5), 5.0, (OFF.format(155),), 1.7e9 + 0.5),
        (lambda t: 1.7e9 + 1.1 * t, 5.0, (OFF.format(216),), 1.7e9 + 0.945),
        (lambda t: 1.7e9 + t, 2**32 / 1000 - 5, (), 1.7e9),
    ],
    ids=[
        "right",
        "1970",
        "an hour back",
        "3 s back",
        "one stamp",
        "stands",
        "half a second",
        "runs fast",
        "32 bits",
    ],
)
def test_the_vehicle_s_clock_counts(
    stamp_s: Callable[[float], float], boot_s: float, said: tuple[str, ...], utc_s: float | None, tmp_path: Path
) -> None:
    telemetry = Telemetry().flight("HGAS", stamp_s, boot_s, damaged=lambda k, ms: ms % 2**32)
    log = telemetry.read(tmp_path)
    assert log.duration_s == pytest.approx(9.9, abs=1e-6)
    assert utc_s is None or log.utc_s == pytest.approx(utc_s, abs=1e-3)
    assert at_rows(log.position).tolist() == at_rows(log.attitude).tolist() == list(range(ROWS))
    assert log.position is not None
    np.testing.assert_allclose(log.position.values[:, 0], EAST_M, atol=0.01)
    assert log.charge is not None
    np.testing.assert_allclose(np.interp(T_S, log.charge.time_s, log.charge.values[:, 0]), CHARGE, atol=0.012)
    assert utc_s is None or log.problems == said


def test_a_clock_that_hardly_runs_is_none(tmp_path: Path) -> None:
    log = Telemetry().flight("HGS", damaged=lambda k, ms: k).read(tmp_path)
    assert log.problems == ()
    assert at_rows(log.position).tolist() == list(range(ROWS))


def test_messages_that_overtook_others_are_put_in_order(tmp_path: Path) -> None:
    """They were stamped as they arrived; the vehicle's clock says when they were sent."""
    telemetry = Telemetry()
    for place, k in enumerate([*range(40), 42, 40, 41, *range(43, ROWS)]):
        telemetry.flight("HL", lambda _, place=place: 1.7e9 + place / 10, rows=[k])
    log = telemetry.read(tmp_path)
    assert "1 rows of position came out of order and are put in order" in log.problems
    assert at_rows(log.position).tolist() == list(range(ROWS))
    assert log.position is not None
    np.testing.assert_allclose(log.position.values[:, 0], EAST_M, atol=1e-5)


def test_a_receiver_s_clock_counts_where_no_message_has_another(tmp_path: Path) -> None:
    log = Telemetry().flight("HSR", lambda t: t if t < 3 else 1.7e9 + t).read(tmp_path)
    assert log.duration_s == pytest.approx(9.9, abs=1e-3)
    assert at_rows(log.position).tolist() == list(range(ROWS))


def test_a_damaged_time_of_the_vehicle_is_left_out(tmp_path: Path) -> None:
    log = Telemetry().flight("HLS", damaged=lambda k, ms: {20: 0, 50: 4_000_000_000}.get(k, ms)).read(tmp_path)
    assert log.problems == ("2 messages have an impossible time of the vehicle's clock and are left out",)
    assert at_rows(log.position).tolist() == sorted(set(range(ROWS)) - {20, 50})
    assert log.duration_s == pytest.approx(9.9)


def test_a_restart_with_a_full_pack_keeps_the_longest_stretch(tmp_path: Path) -> None:
    """Local places begin at 0 again, and 98 % are not held at the old pack's 81 %."""
    telemetry = Telemetry().flight()
    telemetry.flight(stamp_s=lambda t: 1.7e9 + 15 + t, boot_s=2.0, rows=range(60), charge=lambda k: 98, east_m=50.0)
    log = telemetry.read(tmp_path)
    assert log.problems == ("the vehicle restarted 1 time; the longest stretch is taken, messages 1 to 410 of 656",)
    assert at_rows(log.position).tolist() == list(range(ROWS))
    telemetry = Telemetry().flight(rows=range(60), charge=lambda k: 20)
    telemetry.flight(stamp_s=lambda t: 1.7e9 + 15 + t, boot_s=2.0)
    log = telemetry.read(tmp_path)
    assert at_rows(log.position).tolist() == list(range(ROWS))
    assert log.charge is not None
    assert log.charge.values[0, 0] == 0.9


def test_only_the_autopilot_s_component_counts(tmp_path: Path) -> None:
    """Its gimbal looks down and has a clock of its own; its computer calls itself ArduPilot; so does another system's.

    A second autopilot comes after number 1."""
    telemetry = Telemetry()
    for k in range(ROWS):
        at = 1.7e9 + T_S[k]
        telemetry.add(at, "heartbeat", 26, 8, 0, 0, 4, 3, sender=(1, 154))
        telemetry.add(at, "heartbeat", 18, 3, 0, 0, 4, 3, sender=(1, 191))
        telemetry.add(at, "heartbeat", 18, 3, 0, 0, 4, 3, sender=(7, 191))
        telemetry.add(at, "heartbeat", 2, 3, 0, 0, 4, 3, sender=(1, 5))
        for sender in ((1, 154), (1, 191), (7, 191), (1, 5)):
            telemetry.add(at, "attitude", 10 * k, 0.0, -1.3, 0.0, 0.0, 0.0, 0.0, sender=sender)
            telemetry.add(at, "local_position_ned", 10 * k, 9.0, 9.0, 9.0, 0.0, 0.0, 0.0, sender=sender)
        telemetry.flight(rows=[k])
    (tmp_path / "a.tlog").write_bytes(telemetry.data)
    (log,) = read_logs(tmp_path / "a.tlog")
    assert (log.system, log.problems) == (1, ("900 messages of other components of the vehicle are left out",))
    assert log.attitude is not None
    assert len(log.attitude.time_s) == ROWS
    assert np.ptp(log.attitude.values, axis=0).max() == 0
    assert log.position is not None
    np.testing.assert_allclose(log.position.values[:, 0], EAST_M, atol=1e-5)


@pytest.mark.parametrize(
    ("number", "cells", "ext", "volts", "count"),
    [
        (0, [4100] * 3 + [65535] * 7, [0] * 4, 12.3, 3),
        (1, [4100] * 3 + [65535] * 7, [0] * 4, 12.3, 3),
        (0, [4000] * 10, [4000, 4000, 0, 0], 48.0, 12),
        (0, [21_000] + [65535] * 9, [0] * 4, 21.0, 5),
        (0, [65_534, 4_466] + [65535] * 8, [0] * 4, 70.0, 17),
    ],
)
def test_a_battery_is_read_of_whichever_message_knows_it(
    number: int, cells: list[int], ext: list[int], volts: float, count: int, tmp_path: Path
) -> None:
    telemetry = Telemetry().flight("HL")
    for k in range(ROWS):
        at, left = 1.7e9 + T_S[k], {3: -1, 50: 2}.get(k, round(100 * CHARGE[k]))
        telemetry.add(at, "sys_status", 0, 0, 0, 0, 65535, -1, -1, *[0] * 6)
        telemetry.add(at, "battery_status", number, 0, 1, 32767, cells, 1000, 10, -1, left, 0, 0, ext)
    log = telemetry.read(tmp_path)
    assert log.battery is not None
    assert log.charge is not None
    np.testing.assert_allclose(log.battery.values, [[volts, 10.0]] * ROWS)
    assert len(log.charge.time_s) == ROWS - 2
    assert log.charge.values.min() == 0.8
    assert log.cells == count
    name = f"BATTERY_STATUS {number}" if number else "BATTERY_STATUS"
    assert f"battery is read from {name}: 0 of 100 rows of SYS_STATUS count" in log.problems
    assert "1 rows of charge are unknown and are left out" in log.problems
    assert f"1 {CHARGE_OFF}" in log.problems


def test_the_receiver_s_own_message_is_a_place(tmp_path: Path) -> None:
    telemetry = Telemetry().flight("HSR", rows=range(50))
    telemetry.add(1.7e9 + 4.95, "gps_raw_int", 0, 1, 470_000_000, 80_000_000, 0, 65535, 65535, 0, 0, 0)
    log = telemetry.flight("HSR", rows=range(50, ROWS)).read(tmp_path)
    assert "1 rows of fix are without a fix and are left out" in log.problems
    assert log.position is not None
    np.testing.assert_allclose(log.position.values[:, 0], EAST_M, atol=0.02)


# --- sources that begin later than others ------------------------------------------------------------


def test_a_local_place_that_begins_later_goes_on_from_the_globe_s(tmp_path: Path) -> None:
    telemetry = Telemetry()
    for k in range(ROWS):
        telemetry.flight("HGS" if k < 15 else "HGLAS", rows=[k])
    log = telemetry.read(tmp_path)
    assert (
        "15 rows of position before LOCAL_POSITION_NED begins or after it ends are of GLOBAL_POSITION_INT"
        in log.problems
    )
    assert at_rows(log.position).tolist() == list(range(ROWS))
    assert log.position is not None
    np.testing.assert_allclose(log.position.values[:, 0], EAST_M, atol=0.02)
    np.testing.assert_allclose(log.position.values[:, 2], 0.0, atol=0.02)  # both from where they were together
    assert log.attitude is not None
    assert log.attitude.time_s[0] == pytest.approx(1.5)  # by the log's clock, not from its own begin


def test_a_source_that_begins_far_too_late_is_not_taken(tmp_path: Path) -> None:
    telemetry = Telemetry()
    for k in range(ROWS):
        telemetry.flight("HGS" if k < 60 else "HGLS", rows=[k])
    log = telemetry.read(tmp_path)
    assert "position is read from GLOBAL_POSITION_INT: 40 of 40 rows of LOCAL_POSITION_NED count" in log.problems
    assert at_rows(log.position).tolist() == list(range(ROWS))


@pytest.mark.parametrize(("messages", "rows", "east_m"), [("HLS", 40, 0.0), ("HGS", 5, 2.5)])
def test_the_origin_is_where_the_flight_began(messages: str, rows: int, east_m: float, tmp_path: Path) -> None:
    """The first fix may come after the first place of the estimator, or before."""
    telemetry = Telemetry()
    for k in range(ROWS):
        telemetry.flight(messages if k < rows else "HGLS", rows=[k])
    (tmp_path / "a.tlog").write_bytes(telemetry.data)
    _, _, text = flown_log([tmp_path / "a.tlog"], tmp_path)
    longitude_deg = float(text.partition("longitude_deg: ")[2].partition(",")[0])
    assert longitude_deg == pytest.approx(east_m / DEGREE_M, abs=2e-7)


# --- live vehicles -----------------------------------------------------------------------------------


def heard(*messages: tuple[tuple[int, int], str, tuple[Any, ...]]) -> VehicleState:
    state = VehicleState()
    for sender, name, values in messages:
        message = getattr(dialect, f"MAVLink_{name}_message")(*values)
        message._header.srcSystem, message._header.srcComponent = sender
        state = after(state, message, 1.0, None)
    return state


HEARTBEAT = ((1, 1), "heartbeat", (2, 3, 0, 0, 4, 3))


def test_a_live_vehicle_is_its_autopilot_alone() -> None:
    level, down = (0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0, 0.0, -1.3, 0.0, 0.0, 0.0, 0.0)
    computer = ((1, 191), "heartbeat", (18, 3, 0, 0, 4, 3))
    state = heard(computer, HEARTBEAT, computer, ((1, 1), "attitude", level), ((1, 154), "attitude", down))
    assert (state.system, state.component, state.others) == (1, 1, 2)
    assert state.orientation_xyzw == pytest.approx((0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))


def battery(number: int, left: int) -> tuple[tuple[int, int], str, tuple[Any, ...]]:
    return (1, 1), "battery_status", (number, 0, 1, 0, [65535] * 10, 100, 0, 0, left)


def system(left: int) -> tuple[tuple[int, int], str, tuple[Any, ...]]:
    return (1, 1), "sys_status", (0, 0, 0, 0, 0, 0, left, *[0] * 6)


@pytest.mark.parametrize(
    ("said", "soc"),
    [
        ((battery(1, 40),), 0.4),
        ((system(-1), battery(1, 40), battery(2, 30)), 0.4),
        ((battery(1, 40), battery(0, 60), battery(1, 39)), 0.6),
        ((battery(1, 40), system(50), battery(1, 39)), 0.5),
        ((battery(0, 40), battery(0, -1), battery(0, 127), battery(0, 101)), 0.4),
    ],
)
def test_a_live_charge_is_that_of_the_first_battery_that_knows_it(said: tuple[Any, ...], soc: float) -> None:
    assert heard(HEARTBEAT, *said).soc == soc


# --- the inputs that were reported -------------------------------------------------------------------


@pytest.mark.skipif(not CASES.is_dir(), reason=f"{CASES} has no cases")
@pytest.mark.parametrize(
    ("file", "duration_s", "east_m", "soc", "cells"),
    [
        ("01_tlog_reboot/reboot.tlog", 14.9, 149.0, (0.8, 0.73), 3),
        ("02_tlog_gimbal/gimbal.tlog", 9.75, 2.97, (0.9, 0.9), 3),
        ("03_charge_low_sample/ul_glitch.ulg", 19.9, 99.5, (0.95, 0.9102), 3),
        ("03_charge_low_sample/ul_usb.ulg", 19.9, 99.5, (0.946, 0.9102), 3),
        ("04_timestamp_spike/df_spike.bin", 19.9, 30.27, (1.0, 0.9602), 3),
        ("04_timestamp_spike/ul_first0.ulg", 19.8, 99.0, (0.9, 0.8801), 3),
        ("05_tlog_ground_clock/jump.tlog", 9.9, 3.765, (0.9, 0.86), 3),
        ("06_battery_instance/df_inst1.bin", 19.9, 30.27, (1.0, 0.9602), 3),
        ("06_battery_instance/ul_disc.ulg", 19.9, 99.5, (0.9, 0.8801), 4),
        ("06_battery_instance/ul_inst1.ulg", 19.9, 99.5, (0.9, 0.8801), 3),
        ("07_cells/ul_6s.ulg", 19.9, 99.5, (0.9, 0.8801), 6),
        ("07_cells/ul_lihv.ulg", 19.9, 99.5, (0.9, 0.8801), 3),
        ("14_battery_status_only/bs.tlog", 9.9, 3.765, (0.88, 0.88), 3),
        ("14_battery_status_only/raw.tlog", 9.9, 37.65, None, None),
    ],
)
def test_the_reported_inputs(
    file: str, duration_s: float, east_m: float, soc: tuple[float, float] | None, cells: int | None
) -> None:
    log = read_log(CASES / file)
    assert log.duration_s == pytest.approx(duration_s, abs=1e-6)
    assert log.position is not None
    assert log.position.values[-1, 0] == pytest.approx(east_m, abs=0.02)
    assert log.cells == cells
    assert (log.charge is None) == (soc is None)
    if log.charge is not None:
        assert log.charge.values[[0, -1], 0] == pytest.approx(soc, abs=2e-3)
