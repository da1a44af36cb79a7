"""PX4's ULog files (*.ulg), read as columns.

The definitions describe every topic's fields; data messages carry a subscription's number. A size that leads beyond
the file or a kind that does not exist marks damage: reading goes on at the next place from where the chain of sizes
holds, and what was skipped is told. pyulog stops reading there, and does not say in which order rows of several topics
were written, by which damaged times and restarts are known (`sortie.fleet.logs.clocks`).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from sortie.fleet.logs.dataflash import Column, RawLog, parameter_table

MAGIC = b"ULog\x01\x12\x35"
_HEADER_BYTES = 16
_KINDS = frozenset(b"BFIMPQAERDLCSO")
_BINARY = {
    "int8_t": "i1",
    "uint8_t": "u1",
    "int16_t": "<i2",
    "uint16_t": "<u2",
    "int32_t": "<i4",
    "uint32_t": "<u4",
    "int64_t": "<i8",
    "uint64_t": "<u8",
    "float": "<f4",
    "double": "<f8",
    "bool": "?",
    "char": "S1",
}
_FIELD = re.compile(r"(\w+)(?:\[(\d{1,5})\])? (\w+)", re.ASCII)
_KIND = re.compile(b"[" + bytes(sorted(_KINDS)) + b"]")
MAX_NESTING = 16
"""Types within types; PX4 has two or three."""
_MAX_ROW_BYTES = 65_535
"""A message is no longer."""
_CHAIN = 4
"""So many messages in a row have to be sound where reading goes on after damage."""


def is_ulog(data: bytes) -> bool:
    """Whether a file's first bytes are those of a ULog."""
    return data[: len(MAGIC)] == MAGIC


def read_ulog(data: bytes) -> RawLog:
    """Read a whole log; several instances of a topic are `topic`, `topic.1`, …; arrays are [rows, length]."""
    formats: dict[str, str] = {}
    topics: dict[int, tuple[str, str]] = {}
    rows: dict[int, list[tuple[int, int]]] = {}
    parameters: dict[str, float] = {}
    dropouts, dropped_ms, skipped_bytes, stretches, unknown = 0, 0, 0, 0, 0
    at, end, cut = _HEADER_BYTES, len(data), False
    while at + 3 <= end:
        size, kind = struct.unpack_from("<HB", data, at)
        body, after = at + 3, at + 3 + size
        if kind not in _KINDS or after > end:
            places = (found.start() - 2 for found in _KIND.finditer(data, at + 3, max(end - 1, 0)))
            following = next((place for place in places if _sound(data, place, end)), end)
            cut = cut or (kind in _KINDS and following == end)
            skipped_bytes, stretches, at = skipped_bytes + following - at, stretches + 1, following
            continue
        at = after
        match chr(kind):
            case "F":
                name, _, fields = data[body:after].decode("ascii", "replace").partition(":")
                formats[name] = fields
            case "A" if size > 3:
                instance, number = data[body], int.from_bytes(data[body + 1 : body + 3], "little")
                name = data[body + 3 : after].decode("ascii", "replace")
                topics[number] = (f"{name}.{instance}" if instance else name, name)
            case "D" if size > 2:
                number = int.from_bytes(data[body : body + 2], "little")
                rows.setdefault(number, []).append((body + 2, size - 2))
            case "P" if size > 1:
                _parameter(data[body:after], parameters)
            case "O" if size >= 2:
                dropouts, dropped_ms = dropouts + 1, dropped_ms + int.from_bytes(data[body : body + 2], "little")
    tables: dict[str, dict[str, Column]] = {}
    orders: dict[str, Column] = {}
    types = _Types(formats)
    for number, messages in rows.items():
        name, format_name = topics.get(number, ("", ""))
        dtype = types.row(format_name)
        fitting = [p for p, size in messages if dtype is not None and size >= dtype.itemsize]
        unknown += len(messages) - len(fitting)
        if dtype is not None and fitting:
            records = np.frombuffer(b"".join(data[p : p + dtype.itemsize] for p in fitting), dtype)
            tables[name] = {field: records[field] for field in dtype.names or ()}
            orders[name] = np.array(fitting)
    problems = []
    if stretches:
        problems.append(f"{skipped_bytes} bytes at {stretches} places are no message")
    if unknown:
        problems.append(f"{unknown} messages of topics that the log does not describe")
    if dropouts:
        problems.append(f"the logger dropped data {dropouts} times, {dropped_ms / 1000:g} s in all")
    if cut or 0 < end - at < 3:
        problems.append("the last message is cut off")
    tables["PARM"] = parameter_table(parameters)
    return RawLog(tables, tuple(problems), orders=orders)


def _sound(data: bytes, at: int, end: int) -> bool:
    """Whether a chain of messages begins here."""
    for _ in range(_CHAIN):
        if at == end:
            return True
        if at + 3 > end:
            return False
        size, kind = struct.unpack_from("<HB", data, at)
        if kind not in _KINDS or not size:
            return False
        at += 3 + size
    return at <= end


def _parameter(body: bytes, parameters: dict[str, float]) -> None:
    """`int32_t NAME` or `float NAME`, then the value."""
    key, value = body[1 : 1 + body[0]].decode("ascii", "replace"), body[1 + body[0] :]
    kind, _, name = key.partition(" ")
    if len(value) == 4 and kind in ("int32_t", "float"):
        parameters[name] = float(struct.unpack("<i" if kind == "int32_t" else "<f", value)[0])


class _Types:
    """The rows that formats describe; each is made once, however often others name it."""

    def __init__(self, formats: Mapping[str, str]) -> None:
        self._formats = formats
        self._nested: dict[str, np.dtype[Any] | None] = {}

    def row(self, name: str) -> np.dtype[Any] | None:
        """A topic's rows: the padding at their end is not logged. None where there is none that makes sense."""
        return self._made(name, 0)

    def _inner(self, name: str, depth: int) -> np.dtype[Any] | None:
        """A type within another; the padding at its end is logged."""
        if name not in self._nested:
            self._nested[name] = None  # also of a type that leads back to itself
            self._nested[name] = self._made(name, depth) if depth <= MAX_NESTING else None
        return self._nested[name]

    def _made(self, name: str, depth: int) -> np.dtype[Any] | None:
        fields: dict[str, np.dtype[Any]] = {}
        size = 0
        parts = [part for part in self._formats.get(name, "").split(";") if part]
        for i, part in enumerate(parts):
            found = _FIELD.fullmatch(part)
            if found is None:
                return None
            kind, count, field = found.groups()
            if field.startswith("_padding") and i == len(parts) - 1 and not depth:
                break
            binary = np.dtype(_BINARY[kind]) if kind in _BINARY else self._inner(kind, depth + 1)
            if binary is None or field in fields:
                return None
            size += binary.itemsize * int(count or 1)
            if size > _MAX_ROW_BYTES:
                return None
            fields[field] = np.dtype((binary, (int(count),))) if count else binary
        return np.dtype(list(fields.items())) if size else None
