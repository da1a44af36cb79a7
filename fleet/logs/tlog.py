"""Telemetry logs of ground stations (*.tlog), read as columns: times and MAVLink frames of one or several vehicles.

Damage is expected: a frame whose checksum is wrong, or a stretch that is no frame, is skipped, counted and told.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect  # the widest set of messages

from sortie.fleet.logs.dataflash import Column, RawLog, parameter_table
from sortie.fleet.logs.mavlink import LOG_STAMP

_STAMP_BYTES = 8
_MARKS = {0xFE: 8, 0xFD: 12}
"""First byte of a MAVLink 1 and 2 frame, and what stands around its payload; a signature adds 13."""
_MARK = re.compile(rb"[\xfd\xfe]")
_SIGNED, _SIGNATURE_BYTES = 0x01, 13
_YEARS_US = (0, 4_000_000_000_000_000)  # 1970 … 2096
_OF_A_RADIO = ("RADIO_STATUS", "RADIO")
"""What a telemetry radio sends in a name of its own."""

_Row = tuple[int, dict[str, Any]]
"""A message: its time in µs since 1970, and its fields."""


def is_tlog(data: bytes) -> bool:
    """Whether a file begins as a telemetry log: a time and a MAVLink frame."""
    return _frame_bytes(data, 0) > 0


def read_tlog(data: bytes) -> dict[int, RawLog]:
    """A telemetry log's messages as columns, by the vehicle's system id; `timestamp` is the ground's clock, µs since the first.

    A vehicle is a system with the heartbeat of an autopilot; without one the log is that of system 0, and empty. Of other
    systems only RADIO_STATUS is kept, and only for a single vehicle: several share the ground's radio. Parameters become
    the table PARM.
    """
    heard, told = _frames(data)
    vehicles = sorted(system for system, each in heard.items() if any(map(_is_vehicle, each.rows.get("HEARTBEAT", ()))))
    begin_us = min((rows[0][0] for each in heard.values() for rows in each.rows.values()), default=0)
    radio = {name: rows for each in heard.values() for name, rows in each.rows.items() if name in _OF_A_RADIO}
    if not vehicles:
        told.append("no heartbeat of an autopilot in it")
    if radio and len(vehicles) > 1:
        told.append(f"{len(vehicles)} vehicles share a radio, and its signal strength is left out")
    logs = {}
    for system in vehicles or [0]:
        own = heard.get(system, _Heard())
        kept = {name: rows for name, rows in own.rows.items() if name not in _OF_A_RADIO}
        kept |= radio if len(vehicles) == 1 else {}
        settings = kept.pop("PARAM_VALUE", [])
        tables = {name: _columns(rows, begin_us) for name, rows in kept.items()}
        tables["PARM"] = parameter_table({row["param_id"]: float(row["param_value"]) for _, row in settings})
        own_told = [f"the vehicle restarted {own.restarts} times"] if own.restarts else []
        logs[system] = RawLog(tables, (*told, *own_told), begin_us * 1e-6)
    return logs


@dataclass(slots=True)
class _Heard:
    """What one system said."""

    rows: dict[str, list[_Row]] = field(default_factory=dict)
    """By message."""
    boot_ms: int = 0
    restarts: int = 0

    def add(self, stamp_us: int, name: str, values: dict[str, Any]) -> None:
        if "time_boot_ms" in values:
            self.restarts += values["time_boot_ms"] < self.boot_ms - 1000
            self.boot_ms = values["time_boot_ms"]
        self.rows.setdefault(name, []).append((stamp_us, values))


def _is_vehicle(heartbeat: _Row) -> bool:
    """Whether a heartbeat is an autopilot's; ground stations' and cameras' are not."""
    said = heartbeat[1]
    return not (said["autopilot"] == dialect.MAV_AUTOPILOT_INVALID or said["type"] == dialect.MAV_TYPE_GCS)


def _frames(data: bytes) -> tuple[dict[int, _Heard], list[str]]:
    """What each system said, and the damage in words."""
    parser = dialect.MAVLink(None)
    heard: dict[int, _Heard] = {}
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
                system = heard.setdefault(message.get_srcSystem(), _Heard())
                system.add(stamp_us, message.get_type(), message.to_dict())
            else:
                bad += 1
        at += size
    told = (
        (stretches, f"{skipped} bytes at {stretches} places are no message"),
        (bad, f"{bad} messages are damaged or of no known kind"),
        (cut, "the last message is cut off"),
    )
    return heard, [text for happened, text in told if happened]


def _columns(rows: list[_Row], begin_us: int) -> dict[str, Column]:
    """The fields that are numbers, and the time."""
    numbers = [key for key, value in rows[0][1].items() if isinstance(value, int | float)]
    columns: dict[str, Column] = {key: np.array([values[key] for _, values in rows]) for key in numbers}
    columns["timestamp"] = np.array([stamp_us - begin_us for stamp_us, _ in rows])
    return columns


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
