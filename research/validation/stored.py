"""Measured tables: as they are stored in research/tables, and as Markdown on the pages.

A file NAME.json holds what `make figures FIGURE=NAME` measured: its tables in full precision, the version of Sortie that
measured them, the day, the network where its accuracy counts, and the hardware where times are measured. A page shows a table between `<!-- TABLE:begin -->`
and `<!-- TABLE:end -->`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sortie.perception.metrics.bootstrap import Difference
from sortie.scenarios.report_text import MINUS, NONE, interval, replace_section, table
from sortie.sim.folders import write_text
from sortie.sim.identity import code_version

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "research/tables"
MARKED = re.compile(r"<!-- (\w+):begin -->")

Cell = str | float | None | Sequence[float]
"""Text as it is, a number, nothing (a dash), or a value with the ends of its interval."""


@dataclass(frozen=True, slots=True)
class Column:
    """One column's head, and how its numbers are printed: times `factor`, by a format specification, with a unit.

    Without a specification whole numbers are printed as they are, others with four digits.
    """

    name: str
    form: str = ""
    unit: str = ""
    factor: float = 1.0

    def text(self, cell: Cell) -> str:
        """One cell.

        Example:
            >>> Column("gain", "+.1f", factor=100).text((0.0512, 0.036, 0.067)), Column("data", ".1f", " MB").text(None)
            ('+5.1 [+3.6, +6.7]', '–')
        """
        if cell is None:
            return NONE
        if isinstance(cell, str):
            return cell
        if isinstance(cell, Sequence):
            value, low, high = cell
            return interval(value, low, high, self._number, self.unit)
        return self._number(cell) + self.unit

    def _number(self, value: float) -> str:
        form = self.form or (",d" if isinstance(value, int) and self.factor == 1 else ".4g")
        text = f"{value if form == ',d' else value * self.factor:{form}}"
        return (text if text.strip("+-0.,%") else text.lstrip("+-")).replace("-", MINUS)


@dataclass(frozen=True, slots=True)
class Table:
    """A table's columns and rows, and a sentence before it."""

    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    about: str = ""

    @classmethod
    def of(
        cls, rows: Iterable[Mapping[str, Any]], about: str = "", columns: Mapping[str, Column] | None = None
    ) -> Table:
        """Rows that name their columns; `columns` has those that are printed otherwise, by name."""
        rows = list(rows)
        names = list(dict.fromkeys(name for row in rows for name in row))
        shown = [(columns or {}).get(name, Column(name)) for name in names]
        return cls(shown, [[row.get(name) for name in names] for row in rows], about)

    def markdown(self) -> str:
        """The table with its sentence."""
        head = [self.about, ""] if self.about else []
        cells = ([c.text(cell) for c, cell in zip(self.columns, row, strict=True)] for row in self.rows)
        return "\n".join([*head, *table([c.name for c in self.columns], cells)])


def points(difference: Difference) -> tuple[float, float, float]:
    """A difference of AP with its interval, for a column with the factor 100."""
    return difference.delta, difference.low, difference.high


def save(
    name: str, tables: Mapping[str, Table | str], hardware: str = "", network: str = "", folder: Path = FOLDER
) -> None:
    """Store what was measured just now; a table that a command printed as Markdown is kept as text.

    Args: `hardware`: where times are measured. `network`: the weights by which a table's accuracy was measured.
    """
    made = {"sortie": code_version(), "date": f"{datetime.now(UTC):%Y-%m-%d}"}
    more = {"network": network, "hardware": hardware}
    store(name, tables, made | {key: value for key, value in more.items() if value}, folder)


def store(name: str, tables: Mapping[str, Table | str], made: Mapping[str, str], folder: Path = FOLDER) -> None:
    """Write a file, a row a line, so that a difference between two of them can be read."""
    parts = []
    for title, one in tables.items():
        if isinstance(one, str):
            parts.append(f"  {json.dumps(title)}: {_dumped(one.splitlines(), 3)}")
            continue
        plain = asdict(one)
        default = asdict(Column(""))
        columns = [{k: v for k, v in c.items() if k == "name" or v != default[k]} for c in plain["columns"]]
        lines = [f'   "about": {json.dumps(one.about, ensure_ascii=False)}'] if one.about else []
        lines += [f'   "columns": {_dumped(columns, 4)}', f'   "rows": {_dumped(plain["rows"], 4)}']
        parts.append(f"  {json.dumps(title)}: {{\n" + ",\n".join(lines) + "\n  }")
    head = "".join(f" {json.dumps(key)}: {json.dumps(value)},\n" for key, value in made.items())
    write_text(folder / f"{name}.json", "{\n" + head + ' "tables": {\n' + ",\n".join(parts) + "\n }\n}\n")


def _dumped(rows: Sequence[Any], indent: int) -> str:
    lines = (" " * indent + json.dumps(row, ensure_ascii=False) for row in rows)
    return "[\n" + ",\n".join(lines) + "\n" + " " * (indent - 1) + "]"


def sections(name: str, folder: Path = FOLDER) -> dict[str, str]:
    """A stored file's tables as they stand on pages, each with where it comes from.

    Raises:
        OSError, ValueError: no such file, or not one of these.
    """
    stored = json.loads((folder / f"{name}.json").read_text("utf-8"))
    hardware = f", on {stored['hardware']}" if "hardware" in stored else ""
    network = f", network `{stored['network']}`" if "network" in stored else ""
    made = (
        f"*Made by `make figures FIGURE={name}` with Sortie {stored['sortie']}, {stored['date']}{network}{hardware}.*"
    )
    found = {}
    for title, one in stored["tables"].items():
        if isinstance(one, list):
            text = "\n".join(one)
        else:
            columns = [Column(**c) for c in one["columns"]]
            text = Table(columns, one["rows"], one.get("about", "")).markdown()
        found[title] = f"{text}\n\n{made}"
    return found


def rendered(page: str, found: Mapping[str, str]) -> str:
    """A page with every section between markers made anew.

    Raises:
        ValueError: a section that no table is for, or markers that are doubled or in the wrong order.
    """
    for title in MARKED.findall(page):
        if title not in found:
            raise ValueError(f"no table is called {title}; there are {', '.join(found)}")
        begin, end = f"<!-- {title}:begin -->", f"<!-- {title}:end -->"
        page = replace_section(page, f"{begin}\n\n{found[title]}\n\n{end}", begin, end)
    return page
