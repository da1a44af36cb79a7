"""Crafted logs, which a reader reads or refuses in one line; traces of a log, and logs of several vehicles."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import log_examples as examples
import numpy as np
import pytest
from log_tables import known
from pymavlink.dialects.v20 import common as mavlink2

from sortie.fleet.logs.dataflash import read_dataflash
from sortie.fleet.logs.flightlog import FlightLog, LogError, Series, read_log, read_logs
from sortie.fleet.logs.geodesy import Origin
from sortie.fleet.logs.logtrace import _resampled, beside, context_trace, on_one_clock
from sortie.fleet.logs.mavlink import Transmitter, messages
from sortie.fleet.logs.ulog import read_ulog

FLIGHT = examples.ulog(20)


def ulog(*formats: str, topic: str = "a", rows: bytes = bytes(200)) -> bytes:
    """A log of one topic and one row, then the flight."""
    out = FLIGHT[:16] + b"".join(examples.ulog_message("F", text.encode()) for text in formats)
    out += examples.ulog_message("A", struct.pack("<BH", 0, 900) + topic.encode())
    return out + examples.ulog_message("D", struct.pack("<H", 900) + rows) + FLIGHT[16:]


def read(folder: Path, kind: str, data: bytes) -> FlightLog:
    (folder / f"a.{kind}").write_bytes(data)
    return read_log(folder / f"a.{kind}")


DOUBLED = [f"t{k}:t{k + 1} x;t{k + 1} y;" for k in range(40)]
"""Each type holds the next one twice: 2⁴⁰ fields."""
CHAIN = [f"t{k}:t{k + 1} x;" for k in range(3000)]
SENSELESS = {
    "circle": ["a:b x;", "b:a y;"],
    "itself": ["a:a x;"],
    "doubled": ["a:t0 x;", *DOUBLED, "t40:uint8_t z;"],
    "chain": ["a:t0 x;", *CHAIN, "t3000:uint8_t z;"],
    "long": ["a:uint8_t[99999] x;"],
    "digits": [f"a:uint8_t[{'9' * 5000}] x;"],
    "empty": ["a:uint8_t[0] x;"],
    "too long": ["a:" + "uint64_t[60000] x;"],
    "other digits": ["a:uint8_t[\N{ARABIC-INDIC DIGIT THREE}] x;"],
    "one name twice": ["a:float y;float y;"],
}


def test_a_ulog_format_that_makes_no_sense_describes_no_topic(tmp_path: Path) -> None:
    """2⁴⁰ fields took for ever, a circle or a chain ended in RecursionError, 5,000 digits in ValueError."""
    for name, formats in SENSELESS.items():
        data = ulog(*formats)
        assert "a" not in read_ulog(data).tables, name
        log = read(tmp_path, "ulg", data)
        assert log.problems[0] == "1 messages of topics that the log does not describe", name
        assert log.position is not None


def test_a_type_that_many_name_is_read_in_all_of_them() -> None:
    formats = ["a:b x;b y;c z;", "b:c x;c y;", "c:uint8_t v;"]
    table = read_ulog(ulog(*formats, rows=bytes(range(5)))).tables["a"]
    assert [int(v) for v in (table["x"]["x"]["v"][0], table["x"]["y"]["v"][0], table["y"]["x"]["v"][0])] == [0, 1, 2]
    assert int(table["z"]["v"][0]) == 4


def test_an_attitude_without_a_length_is_no_attitude(tmp_path: Path) -> None:
    """Quaternions of denormal, huge and no numbers ended in ValueError or a warning."""
    out = FLIGHT.replace(struct.pack("<4f", 1, 0, 0, 0), struct.pack("<4f", 3e38, 3e38, 3e38, 3e38), 3)
    out = out.replace(struct.pack("<4f", 1, 0, 0, 0), struct.pack("<4f", 1e-38, 0, 0, 0), 3)
    (tmp_path / "a.ulg").write_bytes(out.replace(struct.pack("<4f", 1, 0, 0, 0), b"\x01\x00\x80\x7f" * 4, 3))
    log = read_log(tmp_path / "a.ulg")
    assert "9 rows of attitude are not finite and are left out" in log.problems
    assert log.attitude is not None
    assert len(log.attitude.time_s) == 11


def described(number: int, name: str, form: str, columns: str, length: int) -> bytes:
    """A DataFlash FMT message."""
    return examples.dataflash_message("FMT", number, length, name.encode(), form.encode(), columns.encode())


def test_a_kind_described_twice_keeps_its_first_description() -> None:
    """The second one was longer: messages at the end of the log were read beyond it, an IndexError."""
    data = examples.dataflash(20)
    tail = described(134, "RAD", "QBBZ", "TimeUS,RSSI,RemRSSI,Text", 3 + 10 + 64) + examples.dataflash_step(20)
    tables = read_dataflash(data + tail).tables
    assert list(tables["RAD"]) == ["TimeUS", "RSSI", "RemRSSI"]
    assert len(tables["RAD"]["RSSI"]) == 21


def test_parameters_of_another_form_or_without_a_number_are_none(tmp_path: Path) -> None:
    """A value of text, a name of numbers, neither, nothing at all: four kinds of traceback."""
    begin = examples.dataflash_begin()
    begin = begin[: begin.index(b"\xa3\x95\x81")].replace(b"\x81\x1fPARM", b"\xc8\x1fPXXX")
    steps = b"".join(map(examples.dataflash_step, range(20)))
    names = "TimeUS,Name,Value"
    for form, columns, size in (("QNZ", names, 88), ("QQf", names, 20), ("Q", "TimeUS", 8), ("", "", 0)):
        parameter = described(129, "PARM", form, columns, 3 + size) + b"\xa3\x95\x81" + bytes(size)
        log = read(tmp_path, "bin", begin + parameter + steps)
        assert log.parameters == {}, form
        assert log.position is not None
    infinite = examples.dataflash(20).replace(struct.pack("<f", 5000.0), struct.pack("<f", float("inf")))
    assert read(tmp_path, "bin", infinite).parameters == {}


# --- traces of a log --------------------------------------------------------------------------------------


def test_what_cannot_be_made_a_trace_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.ulg"
    path.write_bytes(examples.ulog())
    log = read_log(path)
    for arguments, told in (
        ((10.0, 9.5), "0.4 s from 9.5 s on, must be 1 s at least"),
        ((0.1, 0.0, 5.0), "5.0 s at 0.1 rows a second are one row, must be two at least"),
        ((1e6, 0.0, 9.0), "9.0 s at 1e+06 rows a second are 9000001 rows, must be at most 5000000"),
    ):
        with pytest.raises(LogError) as caught:
            context_trace(log, *arguments)
        assert str(caught.value) == f"{path}: {told}"


def flight(name: str = "a.log", system: int | None = None, begin_s: float = 0.0, **changes: Any) -> FlightLog:
    """A flight of ten seconds of which nothing is known but what is given."""
    nothing: dict[str, Any] = dict.fromkeys(("position", "velocity", "attitude", "battery", "charge", "rssi", "fix"))
    of = {"path": Path(name), "system": system, "kind": "ULog", "begin_s": begin_s, "duration_s": 10.0}
    return FlightLog(**of | {"rssi_unit": "dBm", "parameters": {}, "problems": ()} | nothing | changes)


def series(time_s: Any, *columns: Any) -> Series:
    return Series(np.asarray(time_s, float), np.stack([np.asarray(c, float) for c in columns], axis=-1))


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


def test_a_value_that_is_unknown_for_a_while_is_a_gap_of_its_own_column() -> None:
    """Other columns of the series go on; a short pause is bridged, and nothing is known after a column's end."""
    time_s = np.arange(11.0) / 2
    holed, ends, whole = (np.arange(11.0) for _ in range(3))
    holed[3:8] = np.nan  # 1.5 to 3.5 s, from 1.0 s to 4.0 s without a sample
    ends[9:] = np.nan
    found = _resampled(series(time_s, holed, ends, whole), np.array([0.75, 2.5, 4.25, 4.75]))
    np.testing.assert_array_equal(found, [(1.5, 1.5, 1.5), (np.nan, 5.0, 5.0), (8.5, np.nan, 8.5), (9.5, np.nan, 9.5)])


# --- several vehicles -------------------------------------------------------------------------------------


def fleet_log(drones: int, steps: int = 40, drop: tuple[str, ...] = ()) -> bytes:
    """Drones 10 m east of one another, as system ids 1, 2, …, with their ground station."""
    transmitters = [Transmitter(drone) for drone in range(drones)]
    station = mavlink2.MAVLink(None, srcSystem=255, srcComponent=190)
    out = b""
    for k in range(steps):
        out += examples.stamped(k, mavlink2.MAVLink_heartbeat_message(6, 0, 0, 0, 0, 3).pack(station))
        for drone, transmitter in enumerate(transmitters):
            x, y, z = examples.state(k).position_m
            moved = replace(examples.state(k), position_m=(x + 10 * drone, y, z))
            for message in messages(moved, Origin(47.0, 8.0, 400.0)):
                if not {f"{drone + 1} {message.get_type()}", message.get_type()} & {*drop}:
                    out += examples.stamped(k, transmitter.pack(message))
    return out


def test_telemetry_of_several_vehicles_is_as_many_flights(tmp_path: Path) -> None:
    """The first system was taken, and nothing said so."""
    path = tmp_path / "fleet.tlog"
    path.write_bytes(fleet_log(3))
    logs = read_logs(path)
    assert [log.system for log in logs] == [1, 2, 3]
    assert all(log.problems == () for log in logs)
    with pytest.raises(LogError) as caught:
        read_log(path)
    assert str(caught.value) == f"{path}: is of 3 vehicles, systems 1, 2, 3; must be of one"
    columns = context_trace(logs)
    assert columns["drone"].tolist() == [0.0] * 40 + [1.0] * 40 + [2.0] * 40
    wanted_x = [3 * 0.1 * k + 10 * drone for drone in range(3) for k in range(40)]
    np.testing.assert_allclose(columns["x_m"], wanted_x, atol=0.02)
    np.testing.assert_allclose(columns["z_m"], [0.1 * k for k in range(40)] * 3, atol=0.02)


def test_a_vehicle_that_is_heard_later_begins_later(tmp_path: Path) -> None:
    """System 2 is heard for the last second alone, and stands 10 m east of the first then too."""
    for drop in ((), ("LOCAL_POSITION_NED",)):
        first, second = fleet_log(1, drop=drop), fleet_log(2, drop=drop)
        (tmp_path / "a.tlog").write_bytes(first[: len(first) * 3 // 4] + second[len(second) * 3 // 4 :])
        columns = context_trace(read_logs(tmp_path / "a.tlog"))
        late = {name: column[columns["drone"] == 1] for name, column in columns.items()}
        heard = ~np.isnan(late["x_m"])
        assert 8 <= heard.sum() <= 12
        assert not heard[:28].any()
        t_s = late["t_s"][heard]
        np.testing.assert_allclose(late["x_m"][heard], 3 * t_s + 10, atol=0.03)
        np.testing.assert_allclose(late["y_m"][heard], 4 * t_s, atol=0.03)


def test_a_vehicle_without_a_place_on_the_globe_is_not_put_beside_others(tmp_path: Path) -> None:
    (tmp_path / "a.tlog").write_bytes(fleet_log(2, drop=("2 GLOBAL_POSITION_INT", "2 GPS_RAW_INT")))
    columns = context_trace(read_logs(tmp_path / "a.tlog"))
    assert np.isnan(columns["x_m"][40:]).all()
    assert not np.isnan(columns["x_m"][:40]).any()
    assert not np.isnan(columns["soc"][40:]).any()


def test_the_ground_s_radio_is_a_single_vehicle_s(tmp_path: Path) -> None:
    radio = mavlink2.MAVLink(None, srcSystem=51, srcComponent=68)
    status = mavlink2.MAVLink_radio_status_message(190, 150, 90, 0, 0, 0, 0)
    said = b"".join(examples.stamped(k, status.pack(radio)) for k in range(40))
    for drones, has in ((1, True), (2, False)):
        (tmp_path / "a.tlog").write_bytes(fleet_log(drones) + said)
        for log in read_logs(tmp_path / "a.tlog"):
            assert (log.rssi is not None) == has
            assert ("2 vehicles share a radio, and its signal strength is left out" in log.problems) == (not has)


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


def placed_beside(lat_deg: list[float], alt_m: float, position_s: list[float]) -> list[list[float]]:
    """Where a vehicle is put that has these fixes each second, beside one that stands at the origin's fixes."""
    count = len(lat_deg)
    time_s, fixes = np.arange(float(count)), np.tile([47.0, 8.0, 400.0], (count, 1))
    own = np.stack([lat_deg, np.full(count, 8.0), np.full(count, alt_m)], axis=-1)
    anchor = flight("a.log", 1, fix=Series(time_s, fixes), position=series(time_s, *[[0.0] * count] * 3))
    places = series(position_s, *[[0.0] * len(position_s)] * 3)
    _, placed = beside([anchor, flight("a.log", 2, fix=Series(time_s, own), position=places)])
    return known(placed.position).values.tolist()


def test_places_side_by_side_are_moved_by_the_median_of_their_fixes() -> None:
    """One fix that is off moves nothing, nor do fixes from before the estimator ran: it was carried north then."""
    lat_deg = [47.0] * 4 + [47.0109] + [47.0009] * 4
    found = placed_beside(lat_deg, 400.0, [4.0, 5.0, 6.0, 7.0, 8.0])
    np.testing.assert_allclose(found, [[0.0, 0.0009 * 111_180, 0.0]] * 5, atol=0.5)


def test_a_vehicle_whose_fixes_all_lie_outside_its_places_is_placed_by_the_nearest() -> None:
    np.testing.assert_allclose(placed_beside([47.0] * 5, 410.0, [7.0, 8.0]), [[0.0, 0.0, 10.0]] * 2, atol=1e-6)
