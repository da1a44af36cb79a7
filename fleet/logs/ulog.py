"""PX4's ULog files (*.ulg), read as columns.

The definitions describe every topic's fields; data messages carry a subscription's number. A size that leads beyond
the file or a kind that does not exist marks damage: reading goes on at the next place from where the chain of sizes
holds, and what was skipped is told.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from sortie.fleet.logs.dataflash import Column, RawLog

MAGIC = b"ULog\x01\x12\x35"
_HEADER_BYTES = 16
_KINDS = frozenset(b"BFIMPQAERDLCSO")
_BINARY = {
    "int8_t": "i1", "uint8_t": "u1", "int16_t": "<i2", "uint16_t": "<u2", "int32_t": "<i4", "uint32_t": "<u4",
    "int64_t": "<i8", "uint64_t": "<u8", "float": "<f4", "double": "<f8", "bool": "?", "char": "S1",
}  # fmt: skip
_FIELD = re.compile(r"(\w+)(?:\[(\d+)\])? (\w+)")
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
            following = next((p for p in range(at + 1, end - 3) if _sound(data, p, end)), end)
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
    for number, places in rows.items():
        name, format_name = topics.get(number, ("", ""))
        dtype = _dtype(formats, format_name)
        fitting = [p for p, size in places if dtype is not None and size >= dtype.itemsize]
        unknown += len(places) - len(fitting)
        if dtype is not None and fitting:
            octets = np.frombuffer(data, np.uint8)[np.array(fitting)[:, None] + np.arange(dtype.itemsize)]
            records = np.ascontiguousarray(octets).view(dtype)[:, 0]
            tables[name] = {field: records[field] for field in dtype.names or ()}
    problems = []
    if stretches:
        problems.append(f"{skipped_bytes} bytes at {stretches} places are no message")
    if unknown:
        problems.append(f"{unknown} messages of topics that the log does not describe")
    if dropouts:
        problems.append(f"the logger dropped data {dropouts} times, {dropped_ms / 1000:g} s in all")
    if cut or 0 < end - at < 3:
        problems.append("the last message is cut off")
    tables["PARM"] = {
        "Name": np.array([n.encode() for n in parameters], "S16"),
        "Value": np.array(list(parameters.values()), float),
    }
    return RawLog(tables, tuple(problems))


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


def _dtype(formats: Mapping[str, str], name: str, nested: bool = False) -> np.dtype[Any] | None:
    """A topic's rows; the padding at their end is not logged, that at the end of a nested type is."""
    fields: list[Any] = []
    parts = [part for part in formats.get(name, "").split(";") if part]
    for i, part in enumerate(parts):
        found = _FIELD.fullmatch(part)
        if found is None:
            return None
        kind, count, field = found.groups()
        if field.startswith("_padding") and i == len(parts) - 1 and not nested:
            break
        if kind in _BINARY:
            binary: Any = _BINARY[kind]
        else:
            binary = _dtype(formats, kind, nested=True) if kind != name else None
            if binary is None:
                return None
        fields.append((field, binary, (int(count),)) if count else (field, binary))
    names = {field for field, *_ in fields}
    return np.dtype(fields) if fields and len(names) == len(fields) else None
