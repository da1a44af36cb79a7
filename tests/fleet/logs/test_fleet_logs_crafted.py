"""Crafted logs: whatever a file claims, a reader reads it or refuses it in one line that names it, in no time."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import log_examples as examples
import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink2

from sortie.fleet.logs.dataflash import read_dataflash
from sortie.fleet.logs.flightlog import LogError, read_log, read_logs
from sortie.fleet.logs.geodesy import Origin
from sortie.fleet.logs.logtrace import context_trace
from sortie.fleet.logs.mavlink import Transmitter, messages
from sortie.fleet.logs.telemetry import Telemetry
from sortie.fleet.logs.ulog import read_ulog

FLIGHT = examples.ulog(20)


def ulog(*formats: str, topic: str = "a", rows: bytes = bytes(200)) -> bytes:
    """A log of one topic and one row, then the flight."""
    out = FLIGHT[:16] + b"".join(examples.ulog_message("F", text.encode()) for text in formats)
    out += examples.ulog_message("A", struct.pack("<BH", 0, 900) + topic.encode())
    return out + examples.ulog_message("D", struct.pack("<H", 900) + rows) + FLIGHT[16:]


def described(number: int, name: str, form: str, columns: str, length: int) -> bytes:
    """A DataFlash FMT message."""
    return examples.dataflash_message("FMT", number, length, name.encode(), form.encode(), columns.encode())


DOUBLED = [f"t{k}:t{k + 1} x;t{k + 1} y;" for k in range(40)]
"""Each type holds the next one twice: 2⁴⁰ fields."""
CHAIN = [f"t{k}:t{k + 1} x;" for k in range(3000)]


@pytest.mark.parametrize(
    "formats",
    [
        ["a:b x;", "b:a y;"],
        ["a:a x;"],
        ["a:t0 x;", *DOUBLED, "t40:uint8_t z;"],
        ["a:t0 x;", *CHAIN, "t3000:uint8_t z;"],
        ["a:uint8_t[99999] x;"],
        [f"a:uint8_t[{'9' * 5000}] x;"],
        ["a:uint8_t[0] x;"],
        ["a:" + "uint64_t[60000] x;"],
        ["a:uint8_t[\N{ARABIC-INDIC DIGIT THREE}] x;"],
    ],
    ids=["circle", "itself", "doubled", "chain", "long", "digits", "empty", "too long", "other digits"],
)
def test_a_ulog_format_that_makes_no_sense_describes_no_topic(formats: list[str], tmp_path: Path) -> None:
    """2⁴⁰ fields took for ever, a circle or a chain ended in RecursionError, 5,000 digits in ValueError."""
    data = ulog(*formats)
    assert "a" not in read_ulog(data).tables
    (tmp_path / "a.ulg").write_bytes(data)
    log = read_log(tmp_path / "a.ulg")
    assert log.problems[0] == "1 messages of topics that the log does not describe"
    assert log.position is not None


def test_a_type_that_many_name_is_read_in_all_of_them() -> None:
    formats = ["a:b x;b y;c z;", "b:c x;c y;", "c:uint8_t v;"]
    table = read_ulog(ulog(*formats, rows=bytes(range(5)))).tables["a"]
    assert [int(v) for v in (table["x"]["x"]["v"][0], table["x"]["y"]["v"][0], table["y"]["x"]["v"][0])] == [0, 1, 2]
    assert int(table["z"]["v"][0]) == 4


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (b"float[4] q;", b"float[2] q;", "vehicle_attitude has no q and is left out"),
        (b"float[4] q;", b"char[16] q;", "vehicle_attitude has no q and is left out"),
        (b"float remaining;", b"char[4] remaining;", "battery_status has no remaining and is left out"),
        (b"uint64_t timestamp;float[4] q;", b"char[8] timestamp;float[4] q;", "vehicle_attitude has no time and is left out"),
        (b"int32_t rssi;", b"char[4] rssi;", "input_rc has no rssi and is left out"),
    ],
)  # fmt: skip
def test_a_ulog_field_of_another_type_is_left_out_and_told(old: bytes, new: bytes, told: str, tmp_path: Path) -> None:
    out, at = FLIGHT[:16], 16
    while at < len(FLIGHT):
        size = struct.unpack_from("<H", FLIGHT, at)[0]
        body = FLIGHT[at + 3 : at + 3 + size].replace(old, new)
        out += examples.ulog_message(chr(FLIGHT[at + 2]), body)
        at += 3 + size
    assert new in out
    (tmp_path / "a.ulg").write_bytes(out)
    assert told in read_log(tmp_path / "a.ulg").problems


def test_an_attitude_without_a_length_is_no_attitude(tmp_path: Path) -> None:
    """Quaternions of denormal, huge and no numbers ended in ValueError or a warning."""
    out = FLIGHT.replace(struct.pack("<4f", 1, 0, 0, 0), struct.pack("<4f", 3e38, 3e38, 3e38, 3e38), 3)
    out = out.replace(struct.pack("<4f", 1, 0, 0, 0), struct.pack("<4f", 1e-38, 0, 0, 0), 3)
    (tmp_path / "a.ulg").write_bytes(out.replace(struct.pack("<4f", 1, 0, 0, 0), b"\x01\x00\x80\x7f" * 4, 3))
    log = read_log(tmp_path / "a.ulg")
    assert "9 rows of attitude are not finite and are left out" in log.problems
    assert log.attitude is not None
    assert len(log.attitude.time_s) == 11


def test_a_kind_described_twice_keeps_its_first_description() -> None:
    """The second one was longer: messages at the end of the log were read beyond it, an IndexError."""
    data = examples.dataflash(20)
    tail = described(134, "RAD", "QBBZ", "TimeUS,RSSI,RemRSSI,Text", 3 + 10 + 64) + examples.dataflash_step(20)
    tables = read_dataflash(data + tail).tables
    assert list(tables["RAD"]) == ["TimeUS", "RSSI", "RemRSSI"]
    assert len(tables["RAD"]["RSSI"]) == 21


@pytest.mark.parametrize(
    ("form", "columns", "size"),
    [("QNZ", "TimeUS,Name,Value", 88), ("QQf", "TimeUS,Name,Value", 20), ("Q", "TimeUS", 8), ("", "", 0)],
)
def test_parameters_of_another_form_are_none(form: str, columns: str, size: int, tmp_path: Path) -> None:
    """A value of text, a name of numbers, neither, nothing at all: four kinds of traceback."""
    begin = examples.dataflash_begin()
    begin = begin[: begin.index(b"\xa3\x95\x81")].replace(b"\x81\x1fPARM", b"\xc8\x1fPXXX")
    data = begin + described(129, "PARM", form, columns, 3 + size) + b"\xa3\x95\x81" + bytes(size)
    (tmp_path / "a.bin").write_bytes(data + b"".join(map(examples.dataflash_step, range(20))))
    log = read_log(tmp_path / "a.bin")
    assert log.parameters == {}
    assert log.position is not None


def test_a_parameter_that_is_no_number_is_none(tmp_path: Path) -> None:
    data = examples.dataflash(20).replace(struct.pack("<f", 5000.0), struct.pack("<f", float("inf")))
    (tmp_path / "a.bin").write_bytes(data)
    assert read_log(tmp_path / "a.bin").parameters == {}


@pytest.mark.parametrize(
    "garbage",
    [b"ULog\x01\x12\x35\x01" + bytes(400_008), bytes(8) + b"\xfd" * 400_000, b"\xa3\x95" * 200_000],
    ids=["ulog", "tlog", "bin"],
)
def test_a_log_of_garbage_alone_is_refused_by_name(garbage: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(garbage)
    with pytest.raises(LogError) as caught:
        read_log(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert len(str(caught.value).splitlines()) == 1


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


# --- several vehicles ------------------------------------------------------------------------------


def fleet_log(at: Callable[[int], Telemetry], drones: int, steps: int = 40, drop: tuple[str, ...] = ()) -> bytes:
    """Drones 10 m east of one another, as system ids 1, 2, …, with their ground station."""
    transmitters = [Transmitter(drone) for drone in range(drones)]
    station = mavlink2.MAVLink(None, srcSystem=255, srcComponent=190)
    out = b""
    for k in range(steps):
        out += examples.stamped(k, mavlink2.MAVLink_heartbeat_message(6, 0, 0, 0, 0, 3).pack(station))
        for drone, transmitter in enumerate(transmitters):
            state = at(k)
            x, y, z = state.position_m
            moved = Telemetry(
                **{f: getattr(state, f) for f in state.__slots__} | {"position_m": (x + 10 * drone, y, z)}
            )
            for message in messages(moved, Origin(47.0, 8.0, 400.0)):
                if f"{drone + 1} {message.get_type()}" not in drop and message.get_type() not in drop:
                    out += examples.stamped(k, transmitter.pack(message))
    return out


def test_telemetry_of_several_vehicles_is_as_many_flights(tmp_path: Path) -> None:
    """The first system was taken, and nothing said so."""
    path = tmp_path / "fleet.tlog"
    path.write_bytes(fleet_log(examples.state, 3))
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


@pytest.mark.parametrize("local", [True, False])
def test_a_vehicle_that_is_heard_later_begins_later(local: bool, tmp_path: Path) -> None:
    """System 2 is heard for the last second alone, and stands 10 m east of the first then too."""
    drop = () if local else ("LOCAL_POSITION_NED",)
    first, second = fleet_log(examples.state, 1, drop=drop), fleet_log(examples.state, 2, drop=drop)
    (tmp_path / "a.tlog").write_bytes(first[: len(first) * 3 // 4] + second[len(second) * 3 // 4 :])
    logs = read_logs(tmp_path / "a.tlog")
    columns = context_trace(logs)
    late = columns["drone"] == 1
    known = ~np.isnan(columns["x_m"][late])
    assert 8 <= known.sum() <= 12
    assert not known[:28].any()
    t_s = columns["t_s"][late][known]
    np.testing.assert_allclose(columns["x_m"][late][known], 3 * t_s + 10, atol=0.03)
    np.testing.assert_allclose(columns["y_m"][late][known], 4 * t_s, atol=0.03)


def test_a_vehicle_without_a_place_on_the_globe_is_not_put_beside_others(tmp_path: Path) -> None:
    (tmp_path / "a.tlog").write_bytes(fleet_log(examples.state, 2, drop=("2 GLOBAL_POSITION_INT", "2 GPS_RAW_INT")))
    columns = context_trace(read_logs(tmp_path / "a.tlog"))
    assert np.isnan(columns["x_m"][40:]).all()
    assert not np.isnan(columns["x_m"][:40]).any()
    assert not np.isnan(columns["soc"][40:]).any()


def test_the_ground_s_radio_is_a_single_vehicle_s(tmp_path: Path) -> None:
    radio = mavlink2.MAVLink(None, srcSystem=51, srcComponent=68)
    said = b"".join(
        examples.stamped(k, mavlink2.MAVLink_radio_status_message(190, 150, 90, 0, 0, 0, 0).pack(radio))
        for k in range(40)
    )
    for drones, has in ((1, True), (2, False)):
        (tmp_path / "a.tlog").write_bytes(fleet_log(examples.state, drones) + said)
        for log in read_logs(tmp_path / "a.tlog"):
            assert (log.rssi is not None) == has
            assert ("2 vehicles share a radio, and its signal strength is left out" in log.problems) == (not has)
