"""Link traces: measured or made-up links, flown in place of the models.

A trace is a CSV or Parquet table with one row a link and time:

    t_s                 seconds since the sortie's begin, increasing for each link              must be there
    sender, receiver    whose link, in this direction                                           must be there
    snr_db              mean SNR in the whole channel; fading, PER and rate control go on from it
    loss                probability that a frame is lost at a try, in place of the PER and of bursts
    goodput_mbps        payload rate of the link when it has the channel for itself; 0 is no link

Each column replaces its model alone. A link with a goodput and no loss loses nothing, and its descriptors are heard
as long as the goodput is above 0. `link_drop` events and jammers act on a traced SNR, not on a traced loss or goodput.

The rules of time are those of the other traces (scenarios/traces.py): between rows values run linearly, before the
first and after the last they hold, an empty cell says nothing of its column, and what no row says is the model's.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
QUALITIES = ("snr_db", "loss", "goodput_mbps")
COLUMNS = ("t_s", "sender", "receiver", *QUALITIES)
BOUNDS = {
    "t_s": (0.0, 86_400.0),
    "sender": (0.0, 254.0),
    "receiver": (0.0, 254.0),
    "snr_db": (-200.0, 200.0),
    "loss": (0.0, 1.0),
    "goodput_mbps": (0.0, 10_000.0),
}
MAX_ROWS = 5_000_000


class TraceError(ValueError):
    """A trace is not as it must be; the message names the file, the column, the row and the bound."""


class Given(NamedTuple):
    """What a trace says of a frame: [N, N] each, sender by receiver, NaN where it says nothing."""

    snr_db: FloatArray
    loss: FloatArray
    goodput_mbps: FloatArray


@dataclass(frozen=True, slots=True)
class LinkTrace:
    """A trace's links by (sender, receiver), and of each its qualities as (times, values)."""

    links: dict[tuple[int, int], dict[str, tuple[FloatArray, FloatArray]]]

    def at(self, t_s: float, n: int) -> Given:
        """What it says at a time, for a fleet of n drones."""
        given = Given(*(np.full((n, n), np.nan) for _ in QUALITIES))
        for (i, j), known in self.links.items():
            for name, matrix in zip(QUALITIES, given, strict=True):
                if name in known:
                    matrix[i, j] = np.interp(t_s, *known[name])
        if "goodput_mbps" in {name for known in self.links.values() for name in known}:
            lossless = ~np.isnan(given.goodput_mbps) & np.isnan(given.loss)
            given.loss[lossless] = np.where(given.goodput_mbps[lossless] > 0.0, 0.0, 1.0)
        return given


def read_links(path: str | Path, drones: int) -> LinkTrace:
    """Read a link trace.

    Args:
        path: *.csv, or anything else as Parquet.
        drones: drones of the fleet; a trace of another is refused.

    Raises:
        TraceError: no such file, no table, a column missing, a value out of bounds, a link to oneself, time that does
            not increase.
    """
    path = Path(path)
    columns = _columns(path)
    ends = np.stack([columns["sender"], columns["receiver"]], axis=1)
    for name in ("sender", "receiver"):
        wrong = columns[name] != np.round(columns[name])  # NaN too
        if wrong.any():
            raise TraceError(f"{path}: {name} in row {_first(wrong)}, must be a whole number")
        if (beyond := columns[name] >= drones).any():
            at = _first(beyond)
            raise TraceError(
                f"{path}: {name} in row {at} is {ends[at - 1].max():g}, must be below fleet.drones = {drones}"
            )
    if (same := ends[:, 0] == ends[:, 1]).any():
        raise TraceError(f"{path}: row {_first(same)} links drone {ends[_first(same) - 1, 0]:g} to itself")
    links = {}
    for i, j in np.unique(ends, axis=0).astype(int).tolist():
        row = np.flatnonzero((ends[:, 0] == i) & (ends[:, 1] == j))
        t_s = columns["t_s"][row]
        if (late := np.diff(t_s) <= 0).any():
            at = int(row[_first(late)])
            raise TraceError(f"{path}: t_s in row {at + 1} of link {i} to {j} is {columns['t_s'][at]:g}, must increase")
        known = {}
        for name in QUALITIES:
            if name in columns and (there := ~np.isnan(columns[name][row])).any():
                known[name] = (t_s[there], columns[name][row][there])
        links[i, j] = known
    return LinkTrace(links)


def _columns(path: Path) -> dict[str, FloatArray]:
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    if not path.is_file():
        raise TraceError(f"{path}: no such trace")
    try:
        table = pa.csv.read_csv(path) if path.suffix.lower() == ".csv" else pa.parquet.read_table(path)
    except (pa.ArrowException, OSError) as error:
        raise TraceError(f"{path}: is not a {path.suffix or 'Parquet'} table: {str(error).splitlines()[0]}") from error
    missing = [name for name in COLUMNS[:3] if name not in table.column_names]
    if missing or not any(name in table.column_names for name in QUALITIES):
        lacks = ", ".join(missing) or " or ".join(QUALITIES)
        raise TraceError(f"{path}: no column {lacks}, a link trace needs {', '.join(COLUMNS[:3])} and a quality")
    if not 0 < table.num_rows <= MAX_ROWS:
        raise TraceError(f"{path}: {table.num_rows} rows, must be 1 to {MAX_ROWS}")
    columns = {}
    for name in (name for name in COLUMNS if name in table.column_names):
        try:
            values = table[name].cast(pa.float64()).to_numpy()
        except pa.ArrowException:
            raise TraceError(f"{path}: column {name} does not hold numbers") from None
        low, high = BOUNDS[name]
        wrong = ~((values >= low) & (values <= high) | (np.isnan(values) & (name in QUALITIES)))
        if wrong.any():
            at = _first(wrong)
            raise TraceError(f"{path}: {name} in row {at} is {values[at - 1]:g}, must be within {low:g} … {high:g}")
        columns[name] = values
    return columns


def _first(wrong: NDArray[np.bool_]) -> int:
    """Row of the first true value, counted from 1."""
    return int(np.argmax(wrong)) + 1
