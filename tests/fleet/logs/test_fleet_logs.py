"""Flight logs: the same flight in three formats, the readers against pymavlink's and pyulog's, and damage."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import log_examples as examples
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_tables import known

from sortie.fleet.logs.dataflash import read_dataflash
from sortie.fleet.logs.flightlog import LogError, read_log
from sortie.fleet.logs.geodesy import geodetic
from sortie.fleet.logs.mavlink import Transmitter, messages
from sortie.fleet.logs.sources import local_m
from sortie.fleet.logs.tlog import read_tlog
from sortie.fleet.logs.ulog import read_ulog

LOGS = Path(os.environ.get("SORTIE_FLIGHT_LOGS", Path(__file__).resolve().parents[4] / "shared/flightlogs"))
needs_logs = pytest.mark.skipif(not (LOGS / "log171.bin").is_file(), reason=f"{LOGS} has no flight logs")
WHOLE = {kind: make() for kind, make in examples.KINDS.items()}


def written(folder: Path, kind: str, data: bytes) -> Path:
    path = folder / f"flight.{kind}"
    path.write_bytes(data)
    return path


def test_the_same_flight_whatever_wrote_it(tmp_path: Path) -> None:
    t_s = np.arange(examples.STEPS) * examples.PERIOD_S
    position = np.stack([3 * t_s, 4 * t_s, t_s], -1)
    for kind, data in WHOLE.items():
        log = read_log(written(tmp_path, kind, data))
        assert log.duration_s == pytest.approx(t_s[-1])
        assert log.problems == ()
        for series, wanted, precision in (
            (log.position, position, 0.02),
            (log.velocity, np.tile([3.0, 4.0, 1.0], (len(t_s), 1)), 0.006),
            (log.battery, np.stack([16.0 - 0.1 * t_s, np.full_like(t_s, 15.0)], -1), 1e-3),
            (log.charge, (0.9 - 0.01 * t_s)[:, None], 0.0051),
        ):
            np.testing.assert_allclose(known(series).time_s, t_s, atol=1e-6)
            np.testing.assert_allclose(known(series).values, wanted, atol=precision, err_msg=kind)
        north = [0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4)]  # yaw 0 in NED: FLU turned by 90° in ENU
        np.testing.assert_allclose(np.abs(known(log.attitude).values @ north), 1, atol=1e-6)


def test_a_telemetry_log_that_begins_in_1970_is_read(tmp_path: Path) -> None:
    """`sortie export --tlog --begin 1970-01-01` wrote a first stamp of 0, which was no time to the reader."""
    transmitter = Transmitter(0)
    data = b"".join(
        struct.pack(">Q", k * 100_000) + transmitter.pack(message)
        for k in range(20)
        for message in messages(examples.state(k), examples.ORIGIN)
    )
    log = read_log(written(tmp_path, "tlog", data))
    assert log.problems == ()
    assert log.position is not None
    assert len(log.position.time_s) == 20
    assert log.utc_s == 0.0


@given(st.tuples(st.floats(-3000, 3000), st.floats(-3000, 3000), st.floats(-100, 500)))
def test_local_metres_undo_the_geodetic(position: tuple[float, float, float]) -> None:
    fixes = np.array([geodetic((0.0, 0.0, 0.0), examples.ORIGIN), geodetic(position, examples.ORIGIN)])
    np.testing.assert_allclose(local_m(fixes)[1], position, atol=1e-4)


def test_nested_topics_keep_their_padding_and_rows_lose_theirs() -> None:
    """Two inner records of 3 bytes and one of padding each, then a last field; the outer padding is not logged."""
    data = WHOLE["ulg"][:16]
    data += examples.ulog_message("F", b"inner:uint16_t a;uint8_t b;uint8_t[1] _padding0;")
    data += examples.ulog_message("F", b"outer:uint64_t timestamp;inner[2] pair;uint8_t last;uint8_t[7] _padding0;")
    data += examples.ulog_message("A", struct.pack("<BH", 0, 3) + b"outer")
    data += examples.ulog_message("D", struct.pack("<HQHBBHBBB", 3, 1, 10, 11, 0, 20, 21, 0, 99))
    table = read_ulog(data).tables["outer"]
    assert table["pair"]["a"].tolist() == [[10, 20]]
    assert table["pair"]["b"].tolist() == [[11, 21]]
    assert table["last"].tolist() == [99]


# --- damage -----------------------------------------------------------------------------------------------


def test_a_log_cut_off_keeps_what_came_before(tmp_path: Path) -> None:
    for kind, data in WHOLE.items():
        log = read_log(written(tmp_path, kind, data[: len(data) * 2 // 3 - 5]))
        assert log.battery is not None
        assert 5.0 < log.duration_s < 9.0
        assert any("cut off" in problem for problem in log.problems), kind


def test_garbage_in_the_middle_is_skipped_and_told(tmp_path: Path) -> None:
    for kind, data in WHOLE.items():
        half = len(data) // 2
        log = read_log(written(tmp_path, kind, data[:half] + bytes(range(7, 107)) + data[half:]))
        assert log.duration_s == pytest.approx(9.9, abs=0.2)
        assert len(known(log.battery).time_s) > 95
        assert any("are no message" in problem for problem in log.problems), kind


def test_a_wrong_checksum_is_counted(tmp_path: Path) -> None:
    data = bytearray(WHOLE["tlog"])
    at = data.index(b"\xfd", len(data) // 2)
    data[at + 12] ^= 0xFF
    log = read_log(written(tmp_path, "tlog", bytes(data)))
    assert any("1 messages are damaged" in problem for problem in log.problems)


DESCRIPTIONS: list[tuple[str, bytes, bytes, str, str]] = [
    ("bin", b"Instance,Volt,", b"Instance,Vo1t,", "BAT has no Volt", "battery"),
    ("bin", b"TimeUS,Roll", b"T1meUS,Roll", "ATT has no time", "attitude"),
    ("bin", b"VN,VE,VD,PN,PE,PD", b"VN,VE,VD,PM,PE,QD", "XKF1 has no PN, PD", "velocity"),
    ("ulg", b"float remaining", b"float remainxng", "battery_status has no remaining", "battery"),
    ("ulg", b"float[4] q;", b"float[2] q;", "vehicle_attitude has no q", "attitude"),
    ("ulg", b"float[4] q;", b"char[16] q;", "vehicle_attitude has no q", "attitude"),
    ("ulg", b"float remaining;", b"char[4] remaining;", "battery_status has no remaining", "battery"),
    ("ulg", b"timestamp;float[4] q;", b"timestomp;float[4] q;", "vehicle_attitude has no time", "attitude"),
    ("ulg", b"int32_t rssi;", b"char[4] rssi;", "input_rc has no rssi", "rssi"),
]
"""A message's description, as it is damaged, what is said of it, and what is lost."""


def ulog_of(old: bytes, new: bytes) -> bytes:
    """The flight with another description; each message has the length of its body in front."""
    flight = WHOLE["ulg"]
    out, at = flight[:16], 16
    while at < len(flight):
        size = struct.unpack_from("<H", flight, at)[0]
        out += examples.ulog_message(chr(flight[at + 2]), flight[at + 3 : at + 3 + size].replace(old, new))
        at += 3 + size
    return out


def test_a_message_without_its_fields_is_left_out_and_told(tmp_path: Path) -> None:
    """A description is as easily damaged as what it describes; the rest of the flight stands."""
    for kind, described, damaged, told, lost in DESCRIPTIONS:
        data = ulog_of(described, damaged) if kind == "ulg" else WHOLE[kind].replace(described, damaged)
        assert damaged in data
        log = read_log(written(tmp_path, kind, data))
        assert f"{told} and is left out" in log.problems, damaged
        assert getattr(log, lost) is None
        assert log.position is not None


def test_a_gap_is_told_with_its_place(tmp_path: Path) -> None:
    begin, step = len(examples.dataflash_begin()), len(examples.dataflash_step(0))
    data = WHOLE["bin"]
    cut = data[: begin + 30 * step] + data[begin + 60 * step :]
    log = read_log(written(tmp_path, "bin", cut))
    assert "battery: 1 gaps, the longest 3.1 s at 2.9 s" in log.problems


@settings(max_examples=60)
@given(st.sampled_from(sorted(WHOLE)), st.data())
def test_no_damage_stops_a_reader(kind: str, data: st.DataObject) -> None:
    """Cuts, flips, insertions anywhere after the header: columns of equal length, or nothing."""
    flight = bytearray(WHOLE[kind][:6000])
    for _ in range(data.draw(st.integers(0, 5))):
        at = data.draw(st.integers(16, len(flight) - 1))
        match data.draw(st.sampled_from(["flip", "cut", "insert"])):
            case "flip":
                flight[at] ^= data.draw(st.integers(1, 255))
            case "cut":
                del flight[at : at + data.draw(st.integers(1, 300))]
            case "insert":
                flight[at:at] = data.draw(st.binary(max_size=50))
        if len(flight) < 20:
            break
    damaged = bytes(flight)
    logs = {"bin": read_dataflash, "ulg": read_ulog}[kind](damaged) if kind != "tlog" else read_tlog(damaged)
    for log in logs.values() if isinstance(logs, dict) else [logs]:
        for table in log.tables.values():
            assert len({len(column) for column in table.values()}) == 1


@settings(max_examples=60)
@given(st.binary(max_size=400))
def test_noise_is_no_flight(tmp_path_factory: pytest.TempPathFactory, noise: bytes) -> None:
    path = tmp_path_factory.mktemp("noise") / "noise.bin"
    for begin in (b"", b"\xa3\x95", b"ULog\x01\x12\x35\x01" + bytes(8)):
        path.write_bytes(begin + noise)
        with pytest.raises(LogError):
            read_log(path)


def test_what_cannot_be_read_is_told_in_a_line(tmp_path: Path) -> None:
    known_kinds = "is no DataFlash log (.bin), MAVLink telemetry (.tlog) or ULog (.ulg)"
    long = [b"ULog\x01\x12\x35\x01" + bytes(400_008), bytes(8) + b"\xfd" * 400_000, b"\xa3\x95" * 200_000]
    path = tmp_path / "nowhere.bin"
    for data, said in (
        (None, "cannot be read, No such file or directory"),
        (b"hello", known_kinds),
        (WHOLE["bin"][:400], "holds no position, attitude or battery"),
        *((garbage, "") for garbage in long),
    ):
        if data is not None:
            path = written(tmp_path, "bin", data)
        with pytest.raises(LogError) as caught:
            read_log(path)
        assert str(caught.value).startswith(f"{path}: {said}")
        assert len(str(caught.value).splitlines()) == 1


# --- beside the readers that others use -------------------------------------------------------------------


def as_pyulog_reads_it(path: Path) -> None:
    from pyulog import ULog

    ours, theirs = read_ulog(path.read_bytes()), ULog(str(path))
    names = {f"{d.name}.{d.multi_id}" if d.multi_id else d.name: d for d in theirs.data_list}
    assert set(names) == set(ours.tables) - {"PARM"}
    for name, topic in names.items():
        for field, values in ours.tables[name].items():
            if values.dtype.kind in "VS":  # a type within a type, or letters
                continue
            columns = [f"{field}[{k}]" for k in range(values.shape[1])] if values.ndim > 1 else [field]
            for k, column in enumerate(columns):
                mine = values[:, k] if values.ndim > 1 else values
                np.testing.assert_array_equal(mine, topic.data[column], err_msg=f"{name}.{column}")
    parameters = dict(zip(*(ours.tables["PARM"][c].tolist() for c in ("Name", "Value")), strict=True))
    assert {k.decode(): v for k, v in parameters.items()} == {k[:16]: v for k, v in theirs.initial_parameters.items()}


def test_an_intact_ulog_is_read_as_pyulog_reads_it(tmp_path: Path) -> None:
    as_pyulog_reads_it(written(tmp_path, "ulg", WHOLE["ulg"]))


@needs_logs
def test_every_topic_of_a_real_ulog_as_pyulog_reads_it() -> None:
    as_pyulog_reads_it(LOGS / "sample_log_small.ulg")


@needs_logs
def test_every_message_of_a_real_log_as_pymavlink_reads_it() -> None:
    from pymavlink import DFReader

    ours = read_dataflash((LOGS / "log171.bin").read_bytes())
    assert ours.problems == ()
    reader = DFReader.DFReader_binary(str(LOGS / "log171.bin"))
    rows = dict.fromkeys(ours.tables, 0)
    while (message := reader.recv_msg()) is not None:
        name = message.get_type()
        row, rows[name] = rows[name], rows[name] + 1
        if row % 50:
            continue
        for field, value in message.to_dict().items():
            if field == "mavpackettype" or name == "FMT":
                continue
            mine = ours.tables[name][field][row]
            if isinstance(value, str):
                assert mine.decode("ascii", "replace") == value
            elif isinstance(value, int | float):
                assert float(mine) == pytest.approx(float(value), rel=1e-6, abs=1e-9), (name, field)
    reader.close() if hasattr(reader, "close") else None
    assert rows == {name: len(next(iter(table.values()))) for name, table in ours.tables.items()}


@needs_logs
def test_three_real_logs() -> None:
    for name, kind, seconds, told in (
        ("log171.bin", "DataFlash", 242.6, "position: 1 gaps, the longest 2.1 s at 61.1 s"),
        ("fs-batt.tlog", "MAVLink telemetry", 20.1, "battery: 1 gaps, the longest 9.8 s at 0.1 s"),
        ("sample_log_small.ulg", "ULog", 6.5, "2 batteries, the first is taken"),
    ):
        log = read_log(LOGS / name)
        assert (log.kind, round(log.duration_s, 1)) == (kind, seconds)
        assert told in log.problems
        assert log.battery is not None
        assert log.attitude is not None
