"""Flight logs: the same flight in three formats, the readers against pymavlink's, and every kind of damage."""

from __future__ import annotations

import gc
import os
import struct
from pathlib import Path

import log_examples as examples
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sortie.fleet.logs.dataflash import RawLog, read_dataflash
from sortie.fleet.logs.fields import from_dataflash, from_tlog, from_ulog
from sortie.fleet.logs.flightlog import FlightLog, LogError, _assemble, read_log
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


@pytest.mark.parametrize("kind", WHOLE)
def test_the_same_flight_whatever_wrote_it(kind: str, tmp_path: Path) -> None:
    log = read_log(written(tmp_path, kind, WHOLE[kind]))
    t_s = np.arange(examples.STEPS) * examples.PERIOD_S
    assert log.duration_s == pytest.approx(t_s[-1])
    assert log.problems == ()
    for series, wanted, precision in (
        (log.position, np.stack([3 * t_s, 4 * t_s, t_s], -1), 0.02),
        (log.velocity, np.tile([3.0, 4.0, 1.0], (len(t_s), 1)), 0.006),
        (log.battery, np.stack([16.0 - 0.1 * t_s, np.full_like(t_s, 15.0)], -1), 1e-3),
        (log.charge, (0.9 - 0.01 * t_s)[:, None], 0.0051),
    ):
        assert series is not None
        np.testing.assert_allclose(series.time_s, t_s, atol=1e-6)
        np.testing.assert_allclose(series.values, wanted, atol=precision)
    assert log.attitude is not None
    # yaw 0 in NED is north: FLU turned by 90° in ENU
    np.testing.assert_allclose(np.abs(log.attitude.values @ [0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4)]), 1, atol=1e-6)


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


def test_signal_strength_where_the_log_has_it(tmp_path: Path) -> None:
    radio, remote = (read_log(written(tmp_path, kind, WHOLE[kind])) for kind in ("bin", "ulg"))
    assert radio.rssi is not None
    assert remote.rssi is not None
    assert (radio.rssi_unit, radio.rssi.values[0, 0]) == ("dBm", pytest.approx(-27.0))  # 190/1.9 − 127
    assert (remote.rssi_unit, remote.rssi.values[0, 0]) == ("percent", 80.0)
    assert read_log(written(tmp_path, "tlog", WHOLE["tlog"])).rssi is None


@pytest.mark.parametrize(
    ("kind", "name", "field"),
    [
        ("DataFlash", "RAD", "RSSI"),
        ("ULog", "radio_status", "rssi"),
        ("MAVLink telemetry", "RADIO_STATUS", "rssi"),
        ("MAVLink telemetry", "RADIO", "rssi"),
    ],
)
def test_a_signal_strength_that_the_radio_does_not_know_is_left_out_and_told(kind: str, name: str, field: str) -> None:
    """MAVLink's 255 was read as +7.2 dBm."""
    log = assembled(kind, **{name: {field: [190, 255, 190]}})
    assert log.rssi is not None
    np.testing.assert_allclose(log.rssi.values, [[-27.0], [-27.0]])
    assert log.problems == ("1 rows of rssi are not finite and are left out",)
    assert assembled(kind, **{name: {field: [255, 255]}}).rssi is None


def test_without_an_estimate_the_receivers_positions_are_taken(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, "bin", WHOLE["bin"].replace(b"XKF1", b"ZZZ1")))
    assert log.position is not None
    assert log.origin_deg == pytest.approx((47.0, 8.0))
    np.testing.assert_allclose(log.position.values[-1], [29.7, 39.6, 9.9], atol=0.02)
    assert log.velocity is None


@pytest.mark.parametrize("named", [b"TimeUS,Inst,Volt,Curr,CurrTot", b"TimeUS,Instance,Volt,Curr,CurrTot"])
def test_the_first_battery_is_taken_however_the_version_numbers_them(named: bytes, tmp_path: Path) -> None:
    """ArduPilot calls the column Instance up to 4.0 and Inst since."""
    begin = examples.dataflash_begin().replace(b"TimeUS,Instance,Volt,Curr,CurrTot", named.ljust(33, b"\0"))
    steps = (
        examples.dataflash_step(k) + examples.dataflash_message("BAT", 5_000_001 + k * 100_000, 1, 12.0, 1.0, 4000.0)
        for k in range(20)
    )
    log = read_log(written(tmp_path, "bin", begin + b"".join(steps)))
    assert log.battery is not None
    assert log.charge is not None
    np.testing.assert_allclose(log.battery.values, [[16.0 - 0.01 * k, 15.0] for k in range(20)], atol=1e-5)
    np.testing.assert_allclose(log.charge.values[:, 0], [0.9 - 0.001 * k for k in range(20)], atol=1e-5)


def assembled(kind: str, **tables: dict[str, list[object]]) -> FlightLog:
    """A log of some tables, a row every tenth of a second."""
    stamp, translate = {
        "ULog": ("timestamp", from_ulog),
        "DataFlash": ("TimeUS", from_dataflash),
        "MAVLink telemetry": ("timestamp", from_tlog),
    }[kind]
    columns = {name: {k: np.array(v) for k, v in table.items()} for name, table in tables.items()}
    for name, table in columns.items():
        if name != "PARM":
            table[stamp] = np.arange(len(next(iter(table.values())))) * 100_000
    return _assemble(Path("a.log"), kind, RawLog(columns, ()), translate)


def test_the_first_receiver_is_taken() -> None:
    """Two 100 m apart, in turn."""
    places = {"Lat": [47.0, 47.0009] * 5, "Lng": [8.0] * 10, "Alt": [400.0] * 10}
    log = assembled("DataFlash", GPS={"I": [0, 1] * 5, "Status": [3] * 10, **places})
    assert log.position is not None
    assert log.position.values.tolist() == [[0.0, 0.0, 0.0]] * 5


def test_what_an_autopilot_does_not_know_is_no_value() -> None:
    """Both say 0 V before they measure, PX4 −1 A and −1 of the charge; ArduPilot counts nothing where it has no sensor."""
    log = assembled("ULog", battery_status={"voltage_v": [0, 16, 16], "current_a": [-1, -1, 5], "remaining": [-1] * 3})
    assert log.charge is None
    assert log.battery is not None
    np.testing.assert_array_equal(log.battery.values, [[16, np.nan], [16, 5]])
    log = assembled(
        "DataFlash",
        BAT={"Volt": [0.0, 16.0, 16.0], "Curr": [0.0] * 3, "CurrTot": [0.0] * 3},
        PARM={"Name": [b"BATT_CAPACITY"], "Value": [5000.0]},
    )
    assert log.battery is not None
    assert log.battery.values.tolist() == [[16.0, 0.0]] * 2
    assert log.charge is None


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


# --- damage ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", WHOLE)
def test_a_log_cut_off_keeps_what_came_before(kind: str, tmp_path: Path) -> None:
    data = WHOLE[kind]
    log = read_log(written(tmp_path, kind, data[: len(data) * 2 // 3 - 5]))
    assert log.battery is not None
    assert 5.0 < log.duration_s < 9.0
    assert any("cut off" in problem for problem in log.problems)


@pytest.mark.parametrize("kind", WHOLE)
def test_garbage_in_the_middle_is_skipped_and_told(kind: str, tmp_path: Path) -> None:
    data = WHOLE[kind]
    half = len(data) // 2
    log = read_log(written(tmp_path, kind, data[:half] + bytes(range(7, 107)) + data[half:]))
    assert log.battery is not None
    assert log.duration_s == pytest.approx(9.9, abs=0.2)
    assert len(log.battery.time_s) > 95
    assert any("are no message" in problem for problem in log.problems)


def test_a_wrong_checksum_is_counted(tmp_path: Path) -> None:
    data = bytearray(WHOLE["tlog"])
    at = data.index(b"\xfd", len(data) // 2)
    data[at + 12] ^= 0xFF
    log = read_log(written(tmp_path, "tlog", bytes(data)))
    assert any("1 messages are damaged" in problem for problem in log.problems)


@pytest.mark.parametrize(
    ("kind", "described", "damaged", "told", "lost"),
    [
        ("bin", b"Instance,Volt,", b"Instance,Vo1t,", "BAT has no Volt and is left out", "battery"),
        ("bin", b"TimeUS,Roll", b"T1meUS,Roll", "ATT has no time and is left out", "attitude"),
        ("bin", b"VN,VE,VD,PN,PE,PD", b"VN,VE,VD,PM,PE,QD", "XKF1 has no PN, PD and is left out", "velocity"),
        ("ulg", b"float remaining", b"float remainxng", "battery_status has no remaining and is left out", "battery"),
    ],
)
def test_a_message_without_its_fields_is_left_out_and_told(
    kind: str, described: bytes, damaged: bytes, told: str, lost: str, tmp_path: Path
) -> None:
    """A description is as easily damaged as what it describes; the rest of the flight stands."""
    assert described in WHOLE[kind]
    log = read_log(written(tmp_path, kind, WHOLE[kind].replace(described, damaged)))
    assert told in log.problems
    assert getattr(log, lost) is None
    assert log.position is not None


def test_a_gap_is_told_with_its_place(tmp_path: Path) -> None:
    begin, step = len(examples.dataflash_begin()), len(examples.dataflash_step(0))
    data = WHOLE["bin"]
    cut = data[: begin + 30 * step] + data[begin + 60 * step :]
    log = read_log(written(tmp_path, "bin", cut))
    assert "battery: 1 gaps, the longest 3.1 s at 2.9 s" in log.problems


def test_a_restart_keeps_the_longest_stretch(tmp_path: Path) -> None:
    begin, step = len(examples.dataflash_begin()), len(examples.dataflash_step(0))
    data = WHOLE["bin"]
    twice = data[:begin] + data[begin + 70 * step :] + data[begin:]
    log = read_log(written(tmp_path, "bin", twice))
    assert "the clock restarts 1 times; the longest stretch is taken, rows 181 to 780 of 780" in log.problems
    assert log.battery is not None
    assert len(log.battery.time_s) == 100


def test_values_that_are_no_numbers_and_places_that_are_too_far(tmp_path: Path) -> None:
    bad = examples.dataflash_message("XKF1", 15_000_000, 0, 0.0, 0.0, 0.0, 9e6, 0.0, 0.0, 0.0)
    worse = examples.dataflash_message("XKF1", 15_100_000, 0, float("nan"), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    log = read_log(written(tmp_path, "bin", WHOLE["bin"] + bad + worse))
    assert "1 positions lie over 20 km off and are left out" in log.problems
    assert "1 rows of velocity are not finite and are left out" in log.problems


@pytest.mark.parametrize("wrong", [0, 4, 9])
def test_a_fix_that_is_too_far_is_left_out_wherever_it_stands(wrong: int) -> None:
    """A degree off, the first one too: it is no origin, from which all others would lie too far."""
    lat = [47.0 + 1e-5 * k for k in range(10)]
    lat[wrong] -= 1.0
    log = assembled("DataFlash", GPS={"Status": [3] * 10, "Lat": lat, "Lng": [8.0] * 10, "Alt": [400.0] * 10})
    assert "1 positions lie over 20 km off and are left out" in log.problems
    assert log.position is not None
    first = int(wrong == 0)
    assert log.origin_deg == pytest.approx((47.0 + 1e-5 * first, 8.0))
    north_m = [1.1117 * (k - first) for k in range(10) if k != wrong]
    np.testing.assert_allclose(log.position.values[:, 1], north_m, atol=1e-3)


def test_places_are_told_from_the_first_that_is_no_error(tmp_path: Path) -> None:
    bad = examples.dataflash_message("XKF1", 4_900_000, 0, 0.0, 0.0, 0.0, 9e6, 0.0, 0.0, 0.0)
    log = read_log(written(tmp_path, "bin", examples.dataflash_begin() + bad + WHOLE["bin"]))
    assert log.position is not None
    np.testing.assert_allclose(log.position.values[[0, -1]], [[0, 0, 0], [29.7, 39.6, 9.9]], atol=0.02)


def test_a_charge_that_rises_slowly_is_held() -> None:
    """A gauge by the voltage recovers after a load."""
    left = np.concatenate([np.linspace(0.9, 0.8, 50), np.linspace(0.8, 0.85, 50)])
    rows = {"voltage_v": [16.0] * 100, "current_a": [1.0] * 100, "remaining": left.tolist()}
    log = assembled("ULog", battery_status=rows)
    assert log.charge is not None
    assert log.charge.values[-1, 0] == pytest.approx(0.8)
    assert log.problems == ("the charge rises by up to 5.0%; it is held",)


def test_a_format_with_two_fields_of_one_name_describes_no_topic() -> None:
    damaged = WHOLE["ulg"].replace(b"float x;", b"float y;")
    assert damaged != WHOLE["ulg"]
    found = read_ulog(damaged)
    assert any("of topics that the log does not describe" in problem for problem in found.problems)


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
    with pytest.raises(LogError, match=r"nowhere\.bin: cannot be read, No such file or directory"):
        read_log(tmp_path / "nowhere.bin")
    with pytest.raises(
        LogError, match=r"is no DataFlash log \(\.bin\), MAVLink telemetry \(\.tlog\) or ULog \(\.ulg\)"
    ):
        read_log(written(tmp_path, "bin", b"hello"))
    with pytest.raises(LogError, match="holds no position, attitude or battery"):
        read_log(written(tmp_path, "bin", WHOLE["bin"][:400]))


# --- beside the readers that others use ------------------------------------------------------------


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


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_pyulog_stops_at_damage_and_pymavlink_refuses_it(tmp_path: Path) -> None:
    """Why ULog and DataFlash have readers of this project's own: one damaged byte of a log costs a message, not a flight."""
    from pymavlink import DFReader
    from pyulog import ULog

    half = len(WHOLE["ulg"]) // 2
    path = written(tmp_path, "ulg", WHOLE["ulg"][:half] + bytes(range(7, 107)) + WHOLE["ulg"][half:])
    assert all(len(topic.data["timestamp"]) < 60 for topic in ULog(str(path)).data_list)
    assert len(read_ulog(path.read_bytes()).tables["vehicle_attitude"]["timestamp"]) > 95
    path = written(tmp_path, "bin", WHOLE["bin"].replace(b"RAD\0QBB", b"RAD\0QB\x05"))
    with pytest.raises(Exception, match="Unsupported format char"):
        DFReader.DFReader_binary(str(path))
    gc.collect()  # it leaves the file open
    assert len(read_dataflash(path.read_bytes()).tables["ATT"]["TimeUS"]) == examples.STEPS


@needs_logs
def test_every_topic_of_a_real_ulog_as_pyulog_reads_it() -> None:
    as_pyulog_reads_it(LOGS / "sample_log_small.ulg")


# --- the real ones ---------------------------------------------------------------------------------


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
@pytest.mark.parametrize(
    ("name", "kind", "seconds", "told"),
    [
        ("log171.bin", "DataFlash", 242.6, "position: 1 gaps, the longest 2.1 s at 61.1 s"),
        ("fs-batt.tlog", "MAVLink telemetry", 20.1, "battery: 1 gaps, the longest 9.8 s at 0.1 s"),
        ("sample_log_small.ulg", "ULog", 6.5, "2 batteries, the first is taken"),
    ],
)
def test_three_real_logs(name: str, kind: str, seconds: float, told: str) -> None:
    log = read_log(LOGS / name)
    assert (log.kind, round(log.duration_s, 1)) == (kind, seconds)
    assert told in log.problems
    assert log.battery is not None
    assert log.attitude is not None
