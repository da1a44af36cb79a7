"""What all traces share: tables of numbers over time that drive drones (fleet/traces.py) and links (radio/channel/traces.py).

A trace is a text or Parquet file with named columns of numbers (scenarios/tables.py); their names say the unit. `t_s` counts
from the sortie's begin and increases for each drone or link; between rows values run linearly, before the first and after
the last they hold; an empty cell says nothing of its column, and what no row says is the model's. Columns that a trace
does not know are left unread, so that it can carry notes of its own. A trace that says nothing of any known column but the
time is refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sortie.scenarios.shipped import located
from sortie.scenarios.tables import TableError, read_numbers

Array = npt.NDArray[np.float64]
Bounds = tuple[float, float]

TIME_S: Bounds = (0.0, 86_400.0)
DRONE: Bounds = (0.0, 254.0)
MAX_ROWS = 5_000_000


class TraceError(TableError):
    """A trace is not as it must be; the message names the file, the column, the row and the bound."""


def read_columns(path: Path, bounds: Mapping[str, Bounds], required: Iterable[str] = ("t_s",)) -> dict[str, Array]:
    """A trace's columns that `bounds` names, each within its bounds; empty cells are NaN.

    Args:
        path: as `sortie.scenarios.tables.read_numbers`.
        bounds: column → least and greatest value.
        required: columns that must be there, without an empty cell.

    Raises:
        TraceError: no such file, no table, too many rows or none, a column missing, no number, or out of bounds.
    """
    path, required = located(path), tuple(required)
    try:
        columns, names = read_numbers(path, bounds)
    except TableError as error:
        raise TraceError(error) from error
    for name in required:
        if name not in columns:
            raise TraceError(
                f"{path}: no column {name}, a trace needs {', '.join(required)}; it has {', '.join(names) or 'none'}"
            )
    rows = len(next(iter(columns.values()), ()))
    if not 0 < rows <= MAX_ROWS:
        raise TraceError(f"{path}: {rows} rows, must be 1 to {MAX_ROWS}")
    for name, values in columns.items():
        low, high = bounds[name]
        wrong = ~((values >= low) & (values <= high))
        if name not in required:
            wrong &= ~np.isnan(values)
        if wrong.any():
            row = first_row(wrong)
            raise TraceError(f"{path}: {name} in row {row} is {values[row - 1]:g}, must be within {low:g} … {high:g}")
    return columns


def check_whole(path: Path, name: str, values: Array) -> None:
    """Refuse ids that are no whole numbers."""
    wrong = values != np.round(values)  # NaN too
    if wrong.any():
        row = first_row(wrong)
        raise TraceError(f"{path}: {name} in row {row} is {values[row - 1]:g}, must be a whole number")


def check_drones(path: Path, name: str, values: Array, drones: int) -> None:
    """Refuse ids that are no drones of a fleet."""
    check_whole(path, name, values)
    if (beyond := values >= drones).any():
        row = first_row(beyond)
        raise TraceError(f"{path}: {name} in row {row} is {values[row - 1]:g}, must be below fleet.drones = {drones}")


def check_increasing(path: Path, t_s: Array, rows: npt.NDArray[np.intp], whose: str) -> None:
    """Refuse time that stands or goes back; `rows` are those of one drone or link, counted from 0."""
    late = np.diff(t_s[rows]) <= 0
    if late.any():
        at = int(rows[first_row(late)])  # counted from 1: the later row of the pair
        raise TraceError(f"{path}: t_s in row {at + 1} of {whose} is {t_s[at]:g}, must increase")


def first_row(wrong: npt.NDArray[np.bool_]) -> int:
    """Row of the first true value, counted from 1."""
    return int(np.argmax(wrong)) + 1
