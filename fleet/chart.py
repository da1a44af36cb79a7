"""The chart: which ground the fleet has seen well, as far as one drone knows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from struct import pack
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sortie.policies.contract import COVERAGE_BYTES, COVERAGE_CELL_M, COVERAGE_CELLS, Coverage, Descriptor

_FIRST_CELLS = 1024
_FARTHEST = 1 << 30
"""Rows and columns are held to this: a position may be any 32-bit float."""

Grids = tuple[NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64]]
"""Packed grids [K, 64], and the row and column of each one's south-west cell in the world's lattice, [K]."""


@cache
def loops() -> Any:
    """The compiled loops, imported and made ready at their first use: before a flight, whose drones may be real ones."""
    from sortie.fleet import chart_loops

    keys, new = np.full(1, chart_loops.EMPTY, np.int64), np.zeros(COVERAGE_CELLS**2, np.bool_)
    own = np.frombuffer(bytes(COVERAGE_BYTES), np.uint8)
    grids = np.frombuffer(b"", np.uint8).reshape(0, COVERAGE_BYTES), *(np.zeros(0, np.int64) for _ in range(2))
    chart_loops.fold(keys, 0, *grids, 0)
    chart_loops.enlarge(keys, keys)
    chart_loops.unknown(keys, own, 0, 0, new)
    chart_loops.without(new, 0, 0, 0, *grids)
    chart_loops.mark(np.frombuffer(bytearray(COVERAGE_BYTES), np.uint8), new, 0)
    return chart_loops


def grids_of(claims: Sequence[Descriptor]) -> Grids:
    """The grids of some descriptors."""
    packed = np.frombuffer(b"".join([d.coverage_grid for d in claims]), np.uint8).reshape(-1, COVERAGE_BYTES)
    if not claims:
        return packed, np.empty(0, np.int64), np.empty(0, np.int64)
    numbers: list[float] = []
    for d in claims:
        numbers += d.position_m
    position_m = np.frombuffer(pack(f"{len(numbers)}d", *numbers)).reshape(-1, 3)  # faster than an array of tuples
    cells = np.floor(position_m / COVERAGE_CELL_M)
    corner = np.maximum(np.minimum(cells, _FARTHEST), -_FARTHEST).astype(np.int64) - COVERAGE_CELLS // 2
    return packed, np.ascontiguousarray(corner[:, 1]), np.ascontiguousarray(corner[:, 0])


class Chart:
    """The ground that the fleet has seen well, as far as one drone knows: from its own looks and its peers' grids."""

    def __init__(self) -> None:
        self._loops = ready = loops()
        self._keys = np.full(_FIRST_CELLS, ready.EMPTY, np.int64)
        self._count = 0
        self._known: tuple[bytes, int, int] | None = None
        """A grid of which all that it sees well is in the chart, which forgets nothing."""
        self._new = np.zeros(COVERAGE_CELLS**2, np.bool_)

    def fold(self, claims: Sequence[Descriptor]) -> None:
        """Take note of all that peers see well. Once a second is enough, for cells stay in sight for longer."""
        if claims:
            self._fold(grids_of(claims))

    def _fold(self, grids: Grids) -> None:
        loops, at = self._loops, 0
        while at < len(grids[0]):
            self._count, at = loops.fold(self._keys, self._count, *grids, at)
            if at < len(grids[0]):
                larger = np.full(2 * len(self._keys), loops.EMPTY, np.int64)
                loops.enlarge(self._keys, larger)
                self._keys = larger

    def mark(
        self, grid: bytes, row: int, column: int, claims: Callable[[], Sequence[Descriptor]], told: bool
    ) -> tuple[bytes, bool]:
        """A drone's grid with the cells marked that are newly seen by the fleet, and whether there are any.

        Args:
            grid: what it sees.
            row, column: the grid's south-west cell in the world's lattice.
            claims: gives the latest descriptors of the peers that it believes; called where they matter.
            told: whether the answer goes on the air. From then on the cells are known.
        """
        if (grid, row, column) == self._known:
            return grid, False
        loops, own = self._loops, np.frombuffer(grid, np.uint8)
        count = loops.unknown(self._keys, own, row, column, self._new)
        if not count:
            self._known = grid, row, column
            return grid, False
        count = loops.without(self._new, count, row, column, *grids_of(claims()))
        if told:
            self._fold((own[None], np.array([row]), np.array([column])))
        if not count:
            return grid, False
        out = np.frombuffer(bytearray(grid), np.uint8)
        loops.mark(out, self._new, int(Coverage.NOVEL))
        return out.tobytes(), True
