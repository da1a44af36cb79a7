"""Tiles: feature cells cut into fragments that can each be used alone.

A feature map sent as one sample is lost with any of its fragments. Cut into tiles, each fragment carries whole cells
with their indices and a header of its own, best cells first, so that whatever arrives can be fused. It costs a header
a fragment, and an index also where all cells go.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

from sortie.perception import budget

TILE_HEADER_BYTES = 44
"""Capture stamp (8), sender (4), estimated position (12) and attitude (16), tile number (2), fusion weight (1), rung (1)."""
_CELL_BYTES = budget.payload_bytes(1)


class Tiles(NamedTuple):
    """Number and sizes of the tiles of one payload."""

    cells_each: int
    """Of every tile but the last."""
    tile_bytes: int
    """Of every tile but the last."""
    number: int
    index_bytes: int
    size_bytes: int
    """Of all tiles."""


def _tile_bytes(cells: int) -> int:
    """A tile lists its indices: it has too few cells for a bitmap."""
    return TILE_HEADER_BYTES + cells * _CELL_BYTES + budget.index_list_bytes(cells)


@lru_cache(maxsize=budget.CELLS + 1)
def cut(cells: int, fragment_bytes: int) -> Tiles:
    """Cut ≥ 1 cells into tiles of at most `fragment_bytes`.

    Raises:
        ValueError: if a fragment does not hold one cell.
    """
    each = 8 * (fragment_bytes - TILE_HEADER_BYTES) // (8 * _CELL_BYTES + budget.INDEX_BITS)
    if each < 1:
        raise ValueError(
            f"fragment_bytes is {fragment_bytes}, must be at least {_tile_bytes(1)} for a tile of one cell"
        )
    count = -(-cells // each)
    last = cells - (count - 1) * each
    index_bytes = (count - 1) * budget.index_list_bytes(each) + budget.index_list_bytes(last)
    return Tiles(each, _tile_bytes(each), count, index_bytes, (count - 1) * _tile_bytes(each) + _tile_bytes(last))


def cells_of(tiles: Iterable[int], cells: int, cells_each: int) -> tuple[int, ...]:
    """Ranks (0 the best) of the cells that some tiles of `cells` cells carry, ascending with the tiles."""
    return tuple(rank for t in tiles for rank in range(t * cells_each, min(cells, (t + 1) * cells_each)))
