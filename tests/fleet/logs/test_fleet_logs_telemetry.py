"""Telemetry of a vehicle: whose clock counts, which messages are taken, and the inputs that were reported."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log_tables import CHARGE, DEGREE_M, EAST_M, ROWS, T_S, at_rows, flies_east, known
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sortie.fleet.logs.flightlog import FlightLog, read_log, read_logs
from sortie.sim.cli.import_log import flown_log


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
        self,
        messages: str = "HGLAS",
        stamp_s: Callable[[float], float] = lambda t: 1.7e9 + t,
        boot_s: float = 5.0,
        rows: Iterable[int] = range(ROWS),
        charge: Callable[[int], int] = lambda k: round(100 * CHARGE[k]),
        east_m: float = 0.0,
        damaged: Callable[[int, int], int] = lambda k, ms: ms,
    ) -> Telemetry:
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


# --- clocks -----------------------------------------------------------------------------------------------


OFF = "the ground computer's clock is off by over 0.25 s for {} messages; the vehicle's is taken"
STAMPS: dict[str, tuple[Callable[[float], float], float, tuple[str, ...] | None, float | None]] = {
    "right": (lambda t: 1.7e9 + t, 5.0, (), 1.7e9),
    "1970": (lambda t: t if t < 3 else 1.7e9 + t, 5.0, (OFF.format(93),), 1.7e9),
    "an hour back": (lambda t: 1.7e9 + t - 3600 * (t >= 5), 5.0, (OFF.format(155),), 1.7e9 - 3600),
    "3 s back": (lambda t: 1.7e9 + t - 3 * (t >= 5), 5.0, (OFF.format(155),), 1.7e9 - 3),
    "one stamp": (lambda t: 1.7e9 + t + 86_400 * (t == 5), 5.0, (OFF.format(4),), 1.7e9),
    "stands": (lambda t: 1.7e9, 5.0, None, None),
    "half a second": (lambda t: 1.7e9 + t + 0.5 * (t >= 5), 5.0, (OFF.format(155),), 1.7e9 + 0.5),
    "runs fast": (lambda t: 1.7e9 + 1.1 * t, 5.0, (OFF.format(216),), 1.7e9 + 0.945),
    "32 bits": (lambda t: 1.7e9 + t, 2**32 / 1000 - 5, (), 1.7e9),
}
"""The ground computer's stamps, the vehicle's time of the begin, what the log says, and its begin in UTC."""


def test_the_vehicle_s_clock_counts(tmp_path: Path) -> None:
    for name, (stamp_s, boot_s, said, utc_s) in STAMPS.items():
        log = Telemetry().flight("HGAS", stamp_s, boot_s, damaged=lambda k, ms: ms % 2**32).read(tmp_path)
        assert log.duration_s == pytest.approx(9.9, abs=1e-6), name
        assert said is None or log.problems == said, name
        assert utc_s is None or log.utc_s == pytest.approx(utc_s, abs=1e-3), name
        assert flies_east(log, within_m=0.01), name
        assert at_rows(log.attitude).tolist() == list(range(ROWS))
        charge = known(log.charge)
        found = np.interp(T_S, charge.time_s, charge.values[:, 0])
        np.testing.assert_allclose(found, CHARGE, atol=0.012, err_msg=name)


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
    assert flies_east(log)


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
    assert known(log.charge).values[0, 0] == 0.9


# --- which message ----------------------------------------------------------------------------------------


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
    assert len(known(log.attitude).time_s) == ROWS
    assert np.ptp(known(log.attitude).values, axis=0).max() == 0
    assert flies_east(log)


def test_a_battery_is_read_of_whichever_message_knows_it(tmp_path: Path) -> None:
    rows: list[tuple[int, list[int], list[int], float, int]] = [
        (0, [4100] * 3 + [65535] * 7, [0] * 4, 12.3, 3),
        (1, [4100] * 3 + [65535] * 7, [0] * 4, 12.3, 3),
        (0, [4000] * 10, [4000, 4000, 0, 0], 48.0, 12),
        (0, [21_000] + [65535] * 9, [0] * 4, 21.0, 5),
        (0, [65_534, 4_466] + [65535] * 8, [0] * 4, 70.0, 17),
    ]
    for number, cells, more, volts, count in rows:
        telemetry = Telemetry().flight("HL")
        for k in range(ROWS):
            at, left = 1.7e9 + T_S[k], {3: -1, 50: 2}.get(k, round(100 * CHARGE[k]))
            telemetry.add(at, "sys_status", 0, 0, 0, 0, 65535, -1, -1, *[0] * 6)
            telemetry.add(at, "battery_status", number, 0, 1, 32767, cells, 1000, 10, -1, left, 0, 0, more)
        log = telemetry.read(tmp_path)
        np.testing.assert_allclose(known(log.battery).values, [[volts, 10.0]] * ROWS)
        assert len(known(log.charge).time_s) == ROWS - 2
        assert known(log.charge).values.min() == 0.8
        assert log.cells == count
        name = f"BATTERY_STATUS {number}" if number else "BATTERY_STATUS"
        assert f"battery is read from {name}: 0 of 100 rows of SYS_STATUS count" in log.problems
        assert "1 rows of charge are unknown and are left out" in log.problems
        assert "1 rows of charge do not fit the others and are left out" in log.problems


def test_the_receiver_s_own_message_is_a_place(tmp_path: Path) -> None:
    telemetry = Telemetry().flight("HSR", rows=range(50))
    telemetry.add(1.7e9 + 4.95, "gps_raw_int", 0, 1, 470_000_000, 80_000_000, 0, 65535, 65535, 0, 0, 0)
    log = telemetry.flight("HSR", rows=range(50, ROWS)).read(tmp_path)
    assert "1 rows of fix are without a fix and are left out" in log.problems
    assert flies_east(log, within_m=0.02)


def in_turn(first: str, rows: int, then: str) -> Telemetry:
    telemetry = Telemetry()
    for k in range(ROWS):
        telemetry.flight(first if k < rows else then, rows=[k])
    return telemetry


def test_a_local_place_that_begins_later_goes_on_from_the_globe_s(tmp_path: Path) -> None:
    log = in_turn("HGS", 15, "HGLAS").read(tmp_path)
    said = "15 rows of position before LOCAL_POSITION_NED begins or after it ends are of GLOBAL_POSITION_INT"
    assert said in log.problems
    assert flies_east(log, within_m=0.02)
    np.testing.assert_allclose(known(log.position).values[:, 2], 0.0, atol=0.02)  # from where they were together
    assert known(log.attitude).time_s[0] == pytest.approx(1.5)  # by the log's clock, not from its own begin


def test_a_source_that_begins_far_too_late_is_not_taken(tmp_path: Path) -> None:
    log = in_turn("HGS", 60, "HGLS").read(tmp_path)
    assert "position is read from GLOBAL_POSITION_INT: 40 of 40 rows of LOCAL_POSITION_NED count" in log.problems
    assert at_rows(log.position).tolist() == list(range(ROWS))


def test_the_origin_is_where_the_flight_began(tmp_path: Path) -> None:
    """The first fix may come after the first place of the estimator, or before."""
    for messages, rows, east_m in (("HLS", 40, 0.0), ("HGS", 5, 2.5)):
        (tmp_path / "a.tlog").write_bytes(in_turn(messages, rows, "HGLS").data)
        _, _, text = flown_log([tmp_path / "a.tlog"], tmp_path)
        longitude_deg = float(text.partition("longitude_deg: ")[2].partition(",")[0])
        assert longitude_deg == pytest.approx(east_m / DEGREE_M, abs=2e-7)


# --- the inputs that were reported ------------------------------------------------------------------------
