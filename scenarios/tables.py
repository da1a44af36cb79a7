"""Tables that a user hands over as text (CSV) or Parquet: their columns by name.

Text is UTF-8, with or without a byte-order mark. Its first line that is not empty has the names. Cells are separated by
commas, semicolons or tabs, whichever that line has most of. Where it is no comma, numbers may have a decimal comma. Names
and cells may be in double quotes. Names are compared without case, quotes and blanks about them. Rows are counted from 1,
below the names; empty lines are no rows.
"""

from __future__ import annotations

import codecs
import csv
import os
import re
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from sortie.scenarios.errors import SortieError
from sortie.scenarios.regular import regular

if TYPE_CHECKING:
    import pyarrow as pa

PARQUET = b"PAR1"
"""How Parquet files begin."""
EMPTY = ("", "#n/a", "#na", "n/a", "na", "nan", "-nan", "null")
"""Cells that hold no number, in small letters."""
NUMBER = r"^-?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[-+]?[0-9]+)?$|^-?inf(?:inity)?$"
"""In small letters."""
_FIRST_LINE = 2**20
"""Names end before so many bytes."""


class TableError(SortieError):
    """A table is not as it must be; the message names the file, the column and the row."""


class Table(NamedTuple):
    """The columns of a file that were asked for."""

    columns: dict[str, pa.ChunkedArray]
    """By their names as they were asked for; of a text file texts."""
    names: list[str]
    """Of all columns, as the file has them."""
    decimal_comma: bool
    """Whether numbers may have one."""


def read_table(path: Path, wanted: Collection[str]) -> Table:
    """The wanted columns of a file, those of them that it has.

    Args:
        path: Parquet if its name ends in .parquet or it begins as Parquet does, else text.
        wanted: their names.

    Raises:
        TableError: no such file, no table, or two columns of a wanted name.
    """
    import pyarrow as pa  # here, because most sorties read none
    import pyarrow.parquet

    if not os.path.exists(path):
        raise TableError(f"{path}: no such file")
    try:
        regular(path)
    except OSError as error:
        raise TableError(f"{path}: {error.strerror}") from None
    try:
        with path.open("rb") as file:
            begin = file.read(len(PARQUET))
        if path.suffix.lower() != ".parquet" and begin != PARQUET:
            return _text(path, wanted)
        names = pa.parquet.read_schema(path).names
        chosen = _chosen(path, names, wanted)
        table = pa.parquet.read_table(path, columns=[names[k] for k in chosen.values()])
        return Table({name: table[names[k]] for name, k in chosen.items()}, names, False)
    except UnicodeDecodeError as error:
        raise TableError(f"{path}: names of columns are in another encoding, must be UTF-8") from error
    except (pa.ArrowException, OSError) as error:
        raise TableError(f"{path}: is not a {path.suffix or 'Parquet'} table: {str(error).splitlines()[0]}") from error


def read_numbers(path: Path, wanted: Collection[str]) -> tuple[dict[str, npt.NDArray[np.float64]], list[str]]:
    """The wanted columns of a file as numbers, NaN where a cell is empty; and the names of all its columns.

    Raises:
        TableError: as `read_table`, or a cell that is no number.
    """
    table = read_table(path, wanted)
    columns = {name: _numbers(f"{path}: {name}", column, table) for name, column in table.columns.items()}
    return columns, table.names


def _chosen(path: Path, names: Collection[str], wanted: Collection[str]) -> dict[str, int]:
    """Which column each wanted name is."""
    plain, sought = [_plain(name) for name in names], {name: _plain(name) for name in wanted}
    for name, its in sought.items():
        if plain.count(its) > 1:
            raise TableError(f"{path}: {plain.count(its)} columns {name}, must be one at most")
    return {name: plain.index(its) for name, its in sought.items() if its in plain}


def _plain(name: str) -> str:
    """A name as it is compared."""
    return name.strip().strip('"').strip().casefold()


def _text(path: Path, wanted: Collection[str]) -> Table:
    """The wanted columns of a text file."""
    import pyarrow as pa
    import pyarrow.csv

    ragged: list[Any] = []

    def other_width(row: Any) -> str:
        if not row.text.strip():
            return "skip"
        ragged.append(row)
        return "error"

    with path.open("rb") as file:
        begin = re.match(rb"(?:\xef\xbb\xbf)?[\r\n]*([^\r\n]*)", file.read(_FIRST_LINE))
        assert begin is not None  # noqa: S101 (all of it may be empty)
        line = begin[1].decode()
        bare = re.sub('"[^"]*"', "", line)
        separator = max(",;\t", key=bare.count)
        names = next(csv.reader([line], delimiter=separator, skipinitialspace=separator != "\t"), [])
        chosen = _chosen(path, names, wanted)
        if not chosen or file.seek(0, os.SEEK_END) == begin.end():  # pyarrow refuses that
            return Table({name: pa.chunked_array([], pa.string()) for name in chosen}, names, separator != ",")
        file.seek(begin.end())
        handler = other_width if _is_utf8(file) else None  # pyarrow decodes the row that it hands over
        file.seek(begin.end())
        columns = [str(k) for k in range(len(names))]
        its = [str(k) for k in chosen.values()]
        try:
            table = pa.csv.read_csv(
                file,
                pa.csv.ReadOptions(column_names=columns, use_threads=False),  # so that an error names the row
                pa.csv.ParseOptions(delimiter=separator, invalid_row_handler=handler),
                pa.csv.ConvertOptions(column_types=dict.fromkeys(its, pa.string()), include_columns=its),
            )
        except pa.ArrowInvalid:
            if not ragged:
                raise
            row = ragged[0]
            cells = f"row {row.number} has {row.actual_columns} cells, must have {row.expected_columns}, as the names"
            raise TableError(f"{path}: {cells}") from None
    return Table({name: table[str(k)] for name, k in chosen.items()}, names, separator != ",")


def _is_utf8(file: BinaryIO) -> bool:
    """Whether the rest of a file is UTF-8."""
    decoder = codecs.getincrementaldecoder("utf-8")()
    try:
        while chunk := file.read(2**20):
            decoder.decode(chunk)
        decoder.decode(b"", final=True)
    except UnicodeDecodeError:
        return False
    return True


def _numbers(where: str, column: pa.ChunkedArray, table: Table) -> npt.NDArray[np.float64]:
    """Cells as numbers; `where` names the file and the column."""
    import pyarrow as pa
    import pyarrow.compute as pc

    if not (pa.types.is_string(column.type) or pa.types.is_large_string(column.type)):
        try:
            return np.asarray(column.cast(pa.float64()).to_numpy())
        except pa.ArrowException:
            raise TableError(f"{where} holds {column.type}, must hold numbers") from None
    try:
        text = pc.utf8_lower(pc.utf8_trim(column, ' \t\u00a0"'))
    except pa.ArrowException:  # Parquet may hold any bytes
        raise TableError(f"{where} holds texts that are not UTF-8, must hold numbers") from None
    text = pc.if_else(pc.is_in(text, pa.array(EMPTY)), pa.scalar(None, text.type), text)
    if table.decimal_comma:
        comma = pc.match_substring(text, ",")
        if pc.any(pc.match_substring(text, ".")).as_py() and pc.any(comma).as_py():
            row = pc.index(comma, True).as_py() + 1
            raise TableError(
                f"{where} in row {row} is {column[row - 1].as_py()!r}, and the column has points too: must be one of them"
            )
        text = pc.replace_substring(text, ",", ".")
    try:
        return np.asarray(text.cast(pa.float64()).to_numpy())
    except pa.ArrowException:
        row = pc.index(pc.match_substring_regex(text, NUMBER), False).as_py() + 1
        raise TableError(f"{where} in row {row} is {column[row - 1].as_py()!r}, must be a number") from None
