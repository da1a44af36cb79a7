"""ArduPilot's DataFlash logs (*.bin), read as columns.

A log describes itself: FMT messages name every message type's length, fields and their binary formats. Damage is
expected, since logs end where the power did: what cannot be read is skipped, counted and told, and the rest stands.
pymavlink's reader refuses a log with one damaged description, takes ten times as long, and is an extra.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

Column = npt.NDArray[Any]

MAGIC = b"\xa3\x95"
_FMT_TYPE, _FMT_BYTES = 128, 89
_BINARY = {
    "a": "(32,)<i2",
    "b": "i1",
    "B": "u1",
    "h": "<i2",
    "H": "<u2",
    "i": "<i4",
    "I": "<u4",
    "f": "<f4",
    "d": "<f8",
    "n": "S4",
    "N": "S16",
    "Z": "S64",
    "c": "<i2",
    "C": "<u2",
    "e": "<i4",
    "E": "<u4",
    "L": "<i4",
    "M": "u1",
    "q": "<i8",
    "Q": "<u8",
    "g": "<f2",
}
_Kinds = dict[int, tuple[str, int, str, tuple[str, ...]]]
"""Type → name, length with its header, format, fields."""
_SCALE = {"c": 0.01, "C": 0.01, "e": 0.01, "E": 0.01, "L": 1e-7}


@dataclass(frozen=True, slots=True)
class RawLog:
    """A log's messages as it has them: no unit or frame is changed."""

    tables: Mapping[str, Mapping[str, Column]]
    """Message name → field → values, in the log's order."""
    problems: tuple[str, ...]
    """What was damaged, in plain words."""
    utc_s: float | None = None
    """Seconds since 1970 at which the log's clock is 0, if the file says so itself."""
    orders: Mapping[str, Column] = field(default_factory=dict)
    """Message name → where each row stands in the log. Left out: rows of one number stand side by side."""

    def parameters(self) -> dict[str, float]:
        """The vehicle's parameters, by name; the last value where one was set anew."""
        table = self.tables.get("PARM", {})
        names, values = table.get("Name"), table.get("Value")
        if names is None or values is None or names.dtype.kind != "S" or not is_numbers(values):
            return {}
        named = zip((n.decode("ascii", "replace") for n in names.tolist()), values.tolist(), strict=True)
        return {name: value for name, value in named if math.isfinite(value)}


def is_numbers(column: Column, width: int | None = None) -> bool:
    """Whether a column has a number in each row; with a width, as many numbers in each row."""
    return column.dtype.kind in "biuf" and column.shape[1:] == (() if width is None else (width,))


def parameter_table(values: Mapping[str, float]) -> dict[str, Column]:
    """Parameters as the table PARM."""
    names = np.array([n.encode() for n in values], "S16")
    return {"Name": names, "Value": np.array(list(values.values()), float)}


def is_dataflash(data: bytes) -> bool:
    """Whether a file's first bytes are those of a DataFlash log."""
    return data[:2] == MAGIC


def read_dataflash(data: bytes) -> RawLog:
    """Read a whole log.

    A message counts where its length leads to the next message or to the end; anything else is skipped up to the
    next begin that holds.
    """
    described: _Kinds = {_FMT_TYPE: ("FMT", _FMT_BYTES, "BBnNZ", ("Type", "Length", "Name", "Format", "Columns"))}
    begins: dict[int, list[int]] = {}
    skipped_bytes, stretches, unknown = 0, 0, 0
    at, end, lost = 0, len(data), False
    cut = False
    while at < end:
        kind = data[at + 2] if data[at : at + 2] == MAGIC and at + 2 < end else -1
        length = described[kind][1] if kind in described else 0
        after = at + length
        if length and (after == end or data[after : after + 2] == MAGIC or (after + 1 == end and data[after] == 0xA3)):
            if kind == _FMT_TYPE:
                _describe(data[at + 3 : after], described)
            begins.setdefault(kind, []).append(at)
            at, lost = after, False
            continue
        if length and after > end:
            cut = True
        elif kind >= 0 and not length:
            unknown += 1
        following = data.find(MAGIC, at + 1)
        following = end if following < 0 else following
        skipped_bytes, stretches = skipped_bytes + following - at, stretches + (not lost)
        at, lost = following, True
    problems = []
    if stretches:
        problems.append(f"{skipped_bytes} bytes at {stretches} places are no message")
    if unknown:
        problems.append(f"{unknown} messages of a kind that the log does not describe")
    if cut:
        problems.append("the last message is cut off")
    orders = {described[kind][0]: np.array(offsets) for kind, offsets in begins.items()}
    return RawLog(_tables(data, described, begins), tuple(problems), orders=orders)


def _describe(body: bytes, described: _Kinds) -> None:
    """Take up an FMT message; one that contradicts itself is left out, and its messages are then unknown.

    So is a second one for a kind that is described already: its messages have been counted by the first.
    """
    kind, length = body[0], body[1]
    name, form, columns = (
        part.split(b"\0")[0].decode("ascii", "replace") for part in (body[2:6], body[6:22], body[22:])
    )
    fields = tuple(columns.split(",")) if columns else ()
    if kind not in described and form and all(c in _BINARY for c in form) and len(form) == len(fields):
        dtype = np.dtype([(f"{i}", _BINARY[c]) for i, c in enumerate(form)])
        if dtype.itemsize + 3 == length:
            described[kind] = (name, length, form, fields)


def _tables(data: bytes, described: _Kinds, begins: Mapping[int, list[int]]) -> dict[str, dict[str, Column]]:
    """Every kind's messages as columns, decoded at once."""
    tables: dict[str, dict[str, Column]] = {}
    for kind, offsets in begins.items():
        name, length, form, names = described[kind]
        dtype = np.dtype([(f"{i}", _BINARY[c]) for i, c in enumerate(form)])
        records = np.frombuffer(b"".join(data[at + 3 : at + length] for at in offsets), dtype)
        tables[name] = {
            field: records[f"{i}"] * _SCALE[c] if c in _SCALE else records[f"{i}"]
            for i, (field, c) in enumerate(zip(names, form, strict=True))
        }
    return tables
