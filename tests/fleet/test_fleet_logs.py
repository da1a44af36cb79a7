"""Flight logs: the same flight in three formats, the readers against pymavlink's, and every kind of damage."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import log_examples as examples
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.dataflash import read_dataflash
from fleet.flightlog import LogError, local_m, read_log
from fleet.mavlink import geodetic, read_tlog
from fleet.ulog import read_ulog

LOGS = Path(os.environ.get("SORTIE_FLIGHT_LOGS", Path(__file__).resolve().parents[3] / "shared/flightlogs"))
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


def test_signal_strength_where_the_log_has_it(tmp_path: Path) -> None:
    radio, remote = (read_log(written(tmp_path, kind, WHOLE[kind])) for kind in ("bin", "ulg"))
    assert radio.rssi is not None
    assert remote.rssi is not None
    assert (radio.rssi_unit, radio.rssi.values[0, 0]) == ("dBm", pytest.approx(-27.0))  # 190/1.9 − 127
    assert (remote.rssi_unit, remote.rssi.values[0, 0]) == ("percent", 80.0)
    assert read_log(written(tmp_path, "tlog", WHOLE["tlog"])).rssi is None


def test_without_an_estimate_the_receivers_positions_are_taken(tmp_path: Path) -> None:
    log = read_log(written(tmp_path, "bin", WHOLE["bin"].replace(b"XKF1", b"ZZZ1")))
    assert log.position is not None
    assert log.origin_deg == pytest.approx((47.0, 8.0))
    np.testing.assert_allclose(log.position.values[-1], [29.7, 39.6, 9.9], atol=0.02)
    assert log.velocity is None


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
    assert any("the clock of battery restarts 1 times" in problem for problem in log.problems)
    assert log.battery is not None
    assert len(log.battery.time_s) == 100


def test_values_that_are_no_numbers_and_places_that_are_too_far(tmp_path: Path) -> None:
    bad = examples.dataflash_message("XKF1", 15_000_000, 0, 0.0, 0.0, 0.0, 9e6, 0.0, 0.0, 0.0)
    worse = examples.dataflash_message("XKF1", 15_100_000, 0, float("nan"), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    log = read_log(written(tmp_path, "bin", WHOLE["bin"] + bad + worse))
    assert "1 positions lie over 20 km off and are left out" in log.problems
    assert "1 rows of velocity are not finite and are left out" in log.problems


def test_a_charge_that_rises_is_held(tmp_path: Path) -> None:
    more = examples.dataflash_message("BAT", 15_000_000, 0, 16.0, 1.0, 100.0)
    log = read_log(written(tmp_path, "bin", WHOLE["bin"] + more))
    assert log.charge is not None
    assert log.charge.values[-1, 0] == pytest.approx(0.801)
    assert any(problem.startswith("the charge rises by up to 17.9%") for problem in log.problems)


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
    read = {"bin": read_dataflash, "ulg": read_ulog, "tlog": read_tlog}[kind]
    for table in read(bytes(flight)).tables.values():
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
