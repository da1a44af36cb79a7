"""What all traces share: tables of numbers over time that drive drones (fleet/traces.py) and links (radio/channel/traces.py).

A trace is a CSV or Parquet file whose columns are numbers with their unit in the name. `t_s` counts from the
sortie's begin and increases for each drone or link; between rows values run linearly, before the first and after the
last they hold; an empty cell says nothing of its column, and what no row says is the model's. Columns that a trace
does not know are left unread, so that it can carry notes of its own.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sortie.scenarios.errors import SortieError
from sortie.scenarios.shipped import located

Array = npt.NDArray[np.float64]
Bounds = tuple[float, float]

TIME_S: Bounds = (0.0, 86_400.0)
DRONE: Bounds = (0.0, 254.0)
MAX_ROWS = 5_000_000


class TraceError(SortieError):
    """A trace is not as it must be; the message names the file, the column, the row and the bound."""


def read_columns(path: Path, bounds: Mapping[str, Bounds], required: Iterable[str] = ("t_s",)) -> dict[str, Array]:
    """A trace's columns that `bounds` names, each within its bounds; empty cells are NaN.

    Args:
        path: *.csv, or anything else as Parquet.
        bounds: column → least and greatest value.
        required: columns that must be there, without an empty cell.

    Raises:
        TraceError: no such file, no table, too many rows or none, a column missing, no number, or out of bounds.
    """
    import pyarrow as pa  # here, because most sorties read none
    import pyarrow.csv
    import pyarrow.parquet

    path = located(path)
    if not os.path.isfile(path):
        raise TraceError(f"{path}: no such trace")
    try:
        table = pa.csv.read_csv(path) if path.suffix.lower() == ".csv" else pa.parquet.read_table(path)
        names = table.column_names
    except UnicodeDecodeError as error:
        raise TraceError(f"{path}: names of columns are in another encoding, must be UTF-8") from error
    except (pa.ArrowException, OSError) as error:
        raise TraceError(f"{path}: is not a {path.suffix or 'Parquet'} table: {str(error).splitlines()[0]}") from error
    required = tuple(required)
    for name in required:
        if name not in names:
            raise TraceError(f"{path}: no column {name}, a trace needs {', '.join(required)}")
    for name in bounds:
        if names.count(name) > 1:
            raise TraceError(f"{path}: {names.count(name)} columns {name}, must be one at most")
    if not 0 < table.num_rows <= MAX_ROWS:
        raise TraceError(f"{path}: {table.num_rows} rows, must be 1 to {MAX_ROWS}")
    columns = {}
    for name, (low, high) in bounds.items():
        if name not in names:
            continue
        try:
            values = table[name].cast(pa.float64()).to_numpy()
        except pa.ArrowException:
            raise TraceError(f"{path}: column {name} does not hold numbers") from None
        wrong = ~((values >= low) & (values <= high))
        if name not in required:
            wrong &= ~np.isnan(values)
        if wrong.any():
            row = first_row(wrong)
            raise TraceError(f"{path}: {name} in row {row} is {values[row - 1]:g}, must be within {low:g} … {high:g}")
        columns[name] = values
    return columns


def check_whole(path: Path, name: str, values: Array) -> None:
    """Refuse ids that are no whole numbers."""
    wrong = values != np.round(values)  # NaN too
    if wrong.any():
        raise TraceError(f"{path}: {name} in row {first_row(wrong)}, must be a whole number")


def check_increasing(path: Path, t_s: Array, rows: npt.NDArray[np.intp], whose: str) -> None:
    """Refuse time that stands or goes back; `rows` are those of one drone or link, counted from 0."""
    late = np.diff(t_s[rows]) <= 0
    if late.any():
        at = int(rows[first_row(late)])  # counted from 1: the later row of the pair
        raise TraceError(f"{path}: t_s in row {at + 1} of {whose} is {t_s[at]:g}, must increase")


def first_row(wrong: npt.NDArray[np.bool_]) -> int:
    """Row of the first true value, counted from 1."""
    return int(np.argmax(wrong)) + 1
