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

from sortie.scenarios.traces import DRONE, TIME_S, TraceError, check_drones, check_increasing, first_row, read_columns

FloatArray = NDArray[np.float64]
QUALITIES = ("snr_db", "loss", "goodput_mbps")
BOUNDS = {
    "t_s": TIME_S,
    "sender": DRONE,
    "receiver": DRONE,
    "snr_db": (-200.0, 200.0),
    "loss": (0.0, 1.0),
    "goodput_mbps": (0.0, 10_000.0),
}


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
        path: as `sortie.scenarios.tables.read_table`.
        drones: drones of the fleet; a trace of another is refused.

    Raises:
        TraceError: as for `sortie.scenarios.traces.read_columns`; no quality, an unknown drone, a link to oneself, time that
            does not increase.
    """
    path = Path(path)
    columns = read_columns(path, BOUNDS, required=("t_s", "sender", "receiver"))
    if all(np.isnan(columns.get(name, np.nan)).all() for name in QUALITIES):
        wanted = f"{', '.join(QUALITIES[:-1])} or {QUALITIES[-1]}"
        raise TraceError(f"{path}: no row has a value of {wanted}, so nothing of the trace would be flown")
    for name in ("sender", "receiver"):
        check_drones(path, name, columns[name], drones)
    ends = np.stack([columns["sender"], columns["receiver"]], axis=1).astype(int)
    if (same := ends[:, 0] == ends[:, 1]).any():
        raise TraceError(
            f"{path}: sender and receiver in row {first_row(same)} are both drone {ends[first_row(same) - 1, 0]}"
        )
    links = {}
    for i, j in np.unique(ends, axis=0).tolist():
        row = np.flatnonzero((ends[:, 0] == i) & (ends[:, 1] == j))
        check_increasing(path, columns["t_s"], row, f"link {i} to {j}")
        known = {}
        for name in QUALITIES:
            if name in columns and (there := ~np.isnan(columns[name][row])).any():
                known[name] = (columns["t_s"][row][there], columns[name][row][there])
        links[i, j] = known
    return LinkTrace(links)
