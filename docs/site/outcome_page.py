"""Make `sim/results/outcome.md`, the reference of outcome and record, from `sortie.sim.results.outcome_fields` and `.record`.

`python docs/site/outcome_page.py` writes it anew; a test holds it to the code, and the code to what a sortie gives.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints, is_typeddict

import pyarrow as pa

from sortie.scenarios.report_text import table
from sortie.sim.folders import write_text
from sortie.sim.results import accuracy_table, beliefs, disagreement, links, rosters, views
from sortie.sim.results.outcome_fields import Outcome
from sortie.sim.results.record import ABOUT, TABLES

PAGE = Path(__file__).resolve().parents[2] / "sim" / "results" / "outcome.md"
_NAMES = {float: "number", int: "whole number", bool: "true, false", str: "text", NoneType: "null"}
_COLUMNS = {
    pa.float64(): "",
    pa.int32(): "int",
    pa.int64(): "int",
    pa.string(): "text",
    pa.bool_(): "bool",
    pa.binary(): "bytes",
}


def page() -> str:
    """The page as it should stand."""
    lines = [
        "# What a run leaves behind",
        "",
        "Made by `python docs/site/outcome_page.py`; do not edit.",
        "",
        "A run's folder holds `outcome.json`, the record's tables as Parquet, `scenario.yaml` (what was flown, every default "
        "written out), `record.json` (totals and wall clock) and `sortie.rrd` (the recording for Rerun; `sortie view` makes "
        "one where there is none).",
        "",
        "## outcome.json",
        "",
        "A dot leads into an object, `*` stands for each of its keys, `[]` for each entry of a list. Bounds of `expect:` in "
        "a scenario name a field in the same way: `bytes.context_sent`, `battery.1`.",
        "",
        *table(
            ("field", "value", "meaning"), ((f"`{path}`", value, meaning) for path, value, meaning in fields(Outcome))
        ),
        "",
        "## The record's tables",
        "",
        "One Parquet file a table, rows in order of time. Units stand in the names: `_m`, `_s`, `_mps`, `_j`, `_db`. "
        "Columns are numbers where nothing else is said.",
        "",
        *table(
            ("table", "a row is", "columns"),
            ((f"`{name}`", ABOUT[name], _columns(columns)) for name, columns in TABLES.items()),
        ),
        "",
        "Where a scenario has trucks or thermal cameras, `detections` and `truths` have the column `kind` too: 0 a car, 1 a "
        "truck, 2 a person. `car` is then a person's number where the box is of one.",
        "",
        "Every run has the first two of these too; `accuracy` is computed from the others. With `record.views: true` it has "
        "the next three, with `record.disagreement: true` the sixth, with `context.roster: true`, or more than 200 drones, "
        "the seventh, with `record.beliefs: true` the last one. They are no part of the fingerprint.",
        "",
        *table(
            ("table", "a row is", "columns"),
            (
                (f"`{name}`", about, _columns(columns))
                for name, about, columns in (
                    (links.TABLE, links.ABOUT, links.COLUMNS),
                    (accuracy_table.TABLE, accuracy_table.ABOUT, accuracy_table.COLUMNS),
                    *((name, views.ABOUT[name], columns) for name, columns in views.TABLES.items()),
                    (disagreement.TABLE, disagreement.ABOUT, disagreement.COLUMNS),
                    (rosters.TABLE, rosters.ABOUT, rosters.COLUMNS),
                    (beliefs.TABLE, beliefs.ABOUT, beliefs.COLUMNS),
                )
            ),
        ),
        "",
    ]
    return "\n".join(lines)


def fields(section: Any, path: str = "") -> Iterator[tuple[str, str, str]]:
    """Path, value and meaning of every field of a typed dictionary, those inside it after it."""
    for name, hint in get_type_hints(section, include_extras=True).items():
        kind, meaning, *_ = get_args(hint)
        inner, mark = _inner(kind)
        yield f"{path}{name}", _value(kind), meaning
        if inner is not None:
            yield from fields(inner, f"{path}{name}{mark}.")


def _inner(kind: Any) -> tuple[Any, str]:
    """The typed dictionary that a field holds, and the mark by which a path goes there."""
    if is_typeddict(kind):
        return kind, ""
    of = get_args(kind)
    if of and is_typeddict(of[-1]):
        return of[-1], ".*" if get_origin(kind) is dict else "[]"
    return None, ""


def _value(kind: Any) -> str:
    origin, of = get_origin(kind), get_args(kind)
    if is_typeddict(kind):
        return "object"
    if origin is dict:
        if is_typeddict(of[1]):
            return "object"
        kinds = get_args(of[1]) or (of[1],)
        return f"object of {_NAMES[kinds[0]]}s" + " or null" * (NoneType in kinds)
    if origin is list:
        return "list" if is_typeddict(of[0]) else f"list of {_NAMES[of[0]]}s"
    if origin is UnionType:
        return ", ".join(_NAMES[member] for member in of)
    return _NAMES[kind]


def _columns(columns: dict[str, pa.DataType]) -> str:
    return ", ".join(f"`{name}`{_kind(type_)}" for name, type_ in columns.items())


def _kind(type_: pa.DataType) -> str:
    if pa.types.is_list(type_):
        return f" (list{_kind(type_.value_type)})"
    if pa.types.is_struct(type_):
        return f" ({', '.join(field.name for field in type_)})"
    name = _COLUMNS[type_]
    return f" {name}" if name else ""


if __name__ == "__main__":
    write_text(PAGE, page())
