"""The boxes of scored fusions, block after block in the order of time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

Key = tuple[float, int]
"""A scored fusion: its time and its ego."""
Columns = dict[str, NDArray[Any]]
BLOCK_FUSIONS = 256
"""Fusions worked out at once."""
REST_S = 60.0
"""How much of the time behind the last fusion is worked out at once."""


def fusion_blocks(t_s: NDArray[np.float64], end_s: float = 0.0) -> Iterator[tuple[slice, float]]:
    """Fusions in blocks, and the time before which a block's boxes stand; those of one time stay together.

    Behind the last fusion come blocks without any, up to `end_s`: drones that no longer fuse may still have truths.
    """
    begin, count = 0, len(t_s)
    while begin + BLOCK_FUSIONS < count:
        after = begin + BLOCK_FUSIONS
        end = int(np.searchsorted(t_s, t_s[after]))
        if end == begin:  # so many at one time
            end = int(np.searchsorted(t_s, t_s[after], side="right"))
        if end >= count:
            break
        yield slice(begin, end), float(t_s[end])
        begin = end
    last_s = float(t_s[-1]) if count else 0.0
    for until_s in (*np.arange(last_s + REST_S, end_s, REST_S).tolist(), float("inf")):
        yield slice(begin, count), until_s
        begin = count


def columns_of(rows: pa.Table) -> Columns:
    """A table's columns as arrays."""
    return {name: rows[name].to_numpy() for name in rows.column_names}


def kinds_of(rows: Columns) -> NDArray[np.int8]:
    """The class of each box; cars where the record does not name classes."""
    return rows["kind"] if "kind" in rows else np.zeros(len(rows["t_s"]), np.int8)


def fusions_of(keys: Sequence[Key], rows: Columns) -> NDArray[np.int64]:
    """Which of some fusions (time, ego) each row belongs to; −1: none. Rows of one fusion stand together."""
    t_s, drone = rows["t_s"], rows["drone"]
    first = np.flatnonzero(np.concatenate([[True], (np.diff(t_s) != 0) | (np.diff(drone) != 0)])[: len(t_s)])
    number = {key: k for k, key in enumerate(keys)}
    of = [number.get(key, -1) for key in zip(t_s[first].tolist(), drone[first].tolist(), strict=True)]
    return np.repeat(np.array(of, np.int64), np.diff(first, append=len(t_s)))
