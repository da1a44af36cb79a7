"""Make `sim/results/outcome.md`, the reference of outcome and record, from the outcome's JSON Schema and `sortie.sim.results.record`.

`python docs/site/outcome_page.py` writes it anew; a test holds it to the code, and the code to what a sortie gives.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa

from sortie.scenarios.report_text import table
from sortie.sim.folders import write_text
from sortie.sim.results import accuracy_table, beliefs, disagreement, links, rosters, views
from sortie.sim.results.outcome import fields
from sortie.sim.results.record import ABOUT, TABLES

PAGE = Path(__file__).resolve().parents[2] / "sim" / "results" / "outcome.md"
_NAMES = {"number": "number", "integer": "whole number", "boolean": "true, false", "string": "text", "null": "null"}
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
        "a scenario name a field in the same way: `bytes.context_sent`, `battery.1`. `run.outcome.model()` gives it as a "
        "pydantic model, `Outcome`. A share is 0 … 1; other units are of numbers that are 0 or more.",
        "",
        *table(
            ("field", "value", "unit", "meaning"),
            ((f"`{name}`", value(declared), unit(declared), declared["description"]) for name, declared, _ in fields()),
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


def value(kind: dict[str, Any]) -> str:
    """What a field holds, in words, by its JSON Schema."""
    if "anyOf" in kind:
        return ", ".join(map(value, kind["anyOf"]))
    if kind.get("type") == "array":
        return "list" if "$ref" in kind["items"] else f"list of {value(kind['items'])}s"
    if not (inner := kind.get("additionalProperties")) or "$ref" in inner:
        return _NAMES.get(kind.get("type", ""), "object")
    first, *null = inner.get("anyOf", [inner])
    return f"object of {value(first)}s" + " or null" * bool(null)


def unit(kind: dict[str, Any]) -> str:
    """The unit of a field, or of what it holds; empty where it has none."""
    inner = kind.get("anyOf", [kind])[0]
    inner = inner.get("additionalProperties") or inner.get("items") or inner
    return str(inner.get("unit", ""))


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
