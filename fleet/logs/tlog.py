"""Telemetry logs of ground stations (*.tlog), read as columns: times and MAVLink frames of one or several vehicles.

Damage is expected: a frame whose checksum is wrong, or a stretch that is no frame, is skipped, counted and told.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect  # the widest set of messages

from sortie.fleet.logs.clocks import DRIFT_S, Arrivals, sent_when
from sortie.fleet.logs.dataflash import Column, RawLog, parameter_table
from sortie.fleet.logs.mavlink import LOG_STAMP
from sortie.fleet.logs.vehicle import is_autopilot

_STAMP_BYTES = 8
_MARKS = {0xFE: 8, 0xFD: 12}
"""First byte of a MAVLink 1 and 2 frame, and what stands around its payload; a signature adds 13."""
_MARK = re.compile(rb"[\xfd\xfe]")
_SIGNED, _SIGNATURE_BYTES = 0x01, 13
_YEARS_US = (0, 4_000_000_000_000_000)  # 1970 … 2096
_OF_A_RADIO = ("RADIO_STATUS", "RADIO")
"""What a telemetry radio sends in a name of its own."""

_OF_A_RECEIVER = ("GPS_RAW_INT", "GPS2_RAW")

_Row = tuple[int, str, dict[str, Any]]
"""A message: its time in µs since 1970, its name and its fields."""
_Sender = tuple[int, int]
"""System and component."""


def is_tlog(data: bytes) -> bool:
    """Whether a file begins as a telemetry log: a time and a MAVLink frame."""
    return _frame_bytes(data, 0) > 0


def read_tlog(data: bytes) -> dict[int, RawLog]:
    """A telemetry log's messages as columns, by the vehicle's system id; `timestamp` is in µs since the log's first message.

    A vehicle is a system with the heartbeat of an autopilot; without one the log is that of system 0, and empty. Of a
    system only the component that sends this heartbeat counts, number 1 before others: its gimbal, cameras and computers
    have an attitude and a clock of their own. Of other systems only RADIO_STATUS is kept, and only for a single vehicle: several share the
    ground's radio. Parameters become the table PARM.
    """
    heard, told = _frames(data)
    autopilots = {sender for sender, rows in heard.items() if any(map(_is_vehicle, rows))}
    vehicles = dict(sorted(autopilots, key=lambda sender: (sender[0], sender[1] == 1, -sender[1])))
    radio = [row for rows in heard.values() for row in rows if row[1][1] in _OF_A_RADIO]
    if not vehicles:
        told.append("no heartbeat of an autopilot in it")
    if radio and len(vehicles) > 1:
        told.append(f"{len(vehicles)} vehicles share a radio, and its signal strength is left out")
    each: dict[int, tuple[list[_Row], Arrivals]] = {}
    for system, component in (vehicles or {0: 0}).items():
        own = [row for row in heard.get((system, component), ()) if row[1][1] not in _OF_A_RADIO]
        rows = [row for _, row in sorted(own + radio * (len(vehicles) == 1), key=lambda row: row[0])]
        each[system] = rows, _sent(rows)
    begins_us = [int(sent.time_us[sent.kept].min()) for _, sent in each.values() if sent.moved]
    begin_us = min(begins_us or [rows[0][1][0] for rows in heard.values()], default=0)
    logs = {}
    for system, (rows, sent) in each.items():
        others = sum(len(of) for (s, c), of in heard.items() if s == system and c != vehicles[system])
        own_told = [*told, f"{others} messages of other components of the vehicle are left out"] if others else told
        tables, orders = _tables(rows, sent, begin_us)
        logs[system] = RawLog(tables, (*own_told, *_told(sent)), begin_us * 1e-6, orders)
    return logs


def _is_vehicle(row: tuple[int, _Row]) -> bool:
    """Whether a message is the heartbeat of an autopilot."""
    _, (_, name, said) = row
    return name == "HEARTBEAT" and is_autopilot(said["autopilot"], said["type"])


def _sent(rows: list[_Row]) -> Arrivals:
    """When a vehicle sent its messages."""
    numbers = {name: number for number, name in enumerate(sorted({name for _, name, _ in rows}))}
    boot_ms = np.array([said.get("time_boot_ms", np.nan) for _, _, said in rows], np.float64)
    if np.isnan(boot_ms).all():  # a receiver's messages have a clock, too
        boot_ms = np.array(
            [(said["time_usec"] or np.nan) * 1e-3 if name in _OF_A_RECEIVER else np.nan for _, name, said in rows]
        )
    return sent_when(
        np.array([stamp_us for stamp_us, _, _ in rows], np.int64),
        boot_ms,
        np.array([numbers[name] for _, name, _ in rows], np.int64),
    )


def _told(sent: Arrivals) -> list[str]:
    """What was wrong with the times, in words."""
    told = (
        (sent.odd, f"{sent.odd} messages have an impossible time of the vehicle's clock and are left out"),
        (
            sent.restarts,
            f"the vehicle restarted {sent.restarts} time{'s' if sent.restarts > 1 else ''}; the longest stretch is "
            f"taken, messages {sent.begin + 1} to {sent.end} of {len(sent.kept)}",
        ),
        (
            sent.moved,
            f"the ground computer's clock is off by over {DRIFT_S:g} s for {sent.moved} messages; the vehicle's is taken",
        ),
    )
    return [text for happened, text in told if happened]


def _tables(rows: list[_Row], sent: Arrivals, begin_us: int) -> tuple[dict[str, dict[str, Column]], dict[str, Column]]:
    """A vehicle's messages as columns, each with the time when it was sent, and their places in the log."""
    places: dict[str, list[int]] = {}
    for k in np.flatnonzero(sent.kept).tolist():
        places.setdefault(rows[k][1], []).append(k)
    settings = {said["param_id"]: float(said["param_value"]) for _, name, said in rows if name == "PARAM_VALUE"}
    tables = {"PARM": parameter_table(settings)}
    for name, at in places.items():
        if name != "PARAM_VALUE":
            said = [rows[k][2] for k in at]
            numbers = [key for key, value in said[0].items() if _is_number(value)]
            tables[name] = {key: np.array([each[key] for each in said]) for key in numbers}
            tables[name]["timestamp"] = sent.time_us[at] - begin_us
    return tables, {name: np.array(at) for name, at in places.items()}


def _is_number(value: object) -> bool:
    """Whether a field holds a number, or a row of them."""
    return isinstance(value, int | float) or (
        isinstance(value, list) and all(isinstance(v, int | float) for v in value)
    )


def _frames(data: bytes) -> tuple[dict[_Sender, list[tuple[int, _Row]]], list[str]]:
    """What each sender said, numbered in the order of the log, and the damage in words."""
    parser = dialect.MAVLink(None)
    heard: dict[_Sender, list[tuple[int, _Row]]] = {}
    at, end, skipped, stretches, bad, cut = 0, len(data), 0, 0, 0, False
    while at < end:
        size = _frame_bytes(data, at)
        if not size:
            cut = cut or _may_begin(data, at)
            following = _next_frame(data, at + 1)
            skipped, stretches, at = skipped + following - at, stretches + 1, following
            continue
        stamp_us = LOG_STAMP.unpack_from(data, at)[0]
        try:
            message = parser.decode(bytearray(data[at + _STAMP_BYTES : at + size]))
        except dialect.MAVError:
            bad += 1
        else:
            if message.get_msgId() in dialect.mavlink_map:
                sender = message.get_srcSystem(), message.get_srcComponent()
                heard.setdefault(sender, []).append((at, (stamp_us, message.get_type(), message.to_dict())))
            else:
                bad += 1
        at += size
    told = (
        (stretches, f"{skipped} bytes at {stretches} places are no message"),
        (bad, f"{bad} messages are damaged or of no known kind"),
        (cut, "the last message is cut off"),
    )
    return heard, [text for happened, text in told if happened]


def _may_begin(data: bytes, at: int) -> bool:
    """Whether a time that could be one and a frame's first byte stand here, or the file ends before."""
    if len(data) - at <= _STAMP_BYTES:
        return True
    return data[at + _STAMP_BYTES] in _MARKS and _YEARS_US[0] <= LOG_STAMP.unpack_from(data, at)[0] < _YEARS_US[1]


def _frame_bytes(data: bytes, at: int) -> int:
    """Bytes of the stamp and frame that begin here, 0 where none does: the next has to begin where it ends."""
    mark = at + _STAMP_BYTES
    if mark + 3 > len(data) or not _may_begin(data, at):
        return 0
    version2 = data[mark] == 0xFD
    size = _STAMP_BYTES + data[mark + 1] + _MARKS[data[mark]]
    size += _SIGNATURE_BYTES if version2 and data[mark + 2] & _SIGNED else 0
    after = at + size
    return size if after == len(data) or (after < len(data) and _may_begin(data, after)) else 0


def _next_frame(data: bytes, at: int) -> int:
    """Where the next frame begins; the end where none does."""
    places = (found.start() - _STAMP_BYTES for found in _MARK.finditer(data, at + _STAMP_BYTES))
    return next((place for place in places if _frame_bytes(data, place)), len(data))
