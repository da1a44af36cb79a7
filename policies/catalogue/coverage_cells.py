"""Coverage grids as sets of cells of the world's lattice, so that drones' grids can be compared."""

from __future__ import annotations

from functools import lru_cache
from math import hypot

from sortie.policies.contract import COVERAGE_CELL_M, COVERAGE_CELLS, Coverage, Descriptor, Disc

Cells = frozenset[tuple[int, int]]
"""(row, column) in the world's lattice of 12.8 m."""

_PLACES = {
    least: tuple(tuple(k for k in range(4) if (byte >> 2 * k) & 3 >= least) for byte in range(256))
    for least in (Coverage.POOR, Coverage.WELL)
}
"""Which of a byte's four cells are seen at least so well."""
_HALF_DIAGONAL_M = COVERAGE_CELL_M * 2**0.5 / 2


def seen_well(d: Descriptor) -> Cells:
    """Cells that a drone reports as seen well, new ones included."""
    return well_cells(d.coverage_grid, *d.coverage_corner)


def seen_at_all(d: Descriptor) -> Cells:
    """Cells that a drone reports as seen, well or poorly: its map has them."""
    return well_cells(d.coverage_grid, *d.coverage_corner, Coverage.POOR)


def centre_cell(d: Descriptor) -> Cells:
    """The one cell below the middle of the grid."""
    row, column = d.coverage_corner
    return frozenset(((row + COVERAGE_CELLS // 2, column + COVERAGE_CELLS // 2),))


def well_cells(grid: bytes, row: int, column: int, least: Coverage = Coverage.WELL) -> Cells:
    """Cells of a grid that are seen at least so well; (row, column) is its south-west cell."""
    if type(grid) is bytes and type(row) is type(column) is int and type(least) is Coverage:
        return _well_cells(grid, row, column, least)
    return _cells(grid, row, column, least)  # arguments of other types, though equal, have cells of their own


@lru_cache(maxsize=4096)  # every drone reads a grid
def _well_cells(grid: bytes, row: int, column: int, least: Coverage) -> Cells:
    return _cells(grid, row, column, least)


def _cells(grid: bytes, row: int, column: int, least: Coverage) -> Cells:
    cells = [4 * i + k for i, byte in enumerate(grid) if byte for k in _PLACES[least][byte]]
    return frozenset([(row + cell // COVERAGE_CELLS, column + cell % COVERAGE_CELLS) for cell in cells])


@lru_cache(maxsize=4096)
def disc_around(cells: Cells) -> Disc:
    """A disc that contains all of the cells, centred on their bounding box; ENU.

    Raises:
        ValueError: no cells.
    """
    if not cells:
        raise ValueError("cells is empty, must have at least one")
    rows, columns = [r for r, _ in cells], [c for _, c in cells]
    x = (min(columns) + max(columns) + 1) / 2
    y = (min(rows) + max(rows) + 1) / 2
    reach = max(hypot(c + 0.5 - x, r + 0.5 - y) for r, c in cells)
    return Disc(x * COVERAGE_CELL_M, y * COVERAGE_CELL_M, reach * COVERAGE_CELL_M + _HALF_DIAGONAL_M)


def sees(d: Descriptor, disc: Disc) -> bool:
    """Whether a drone reports as seen any cell with its centre in the disc, or within half a diagonal of it."""
    reach_m = disc.radius_m + _HALF_DIAGONAL_M
    return any(
        hypot((c + 0.5) * COVERAGE_CELL_M - disc.x_m, (r + 0.5) * COVERAGE_CELL_M - disc.y_m) <= reach_m
        for r, c in seen_at_all(d)
    )


@lru_cache(maxsize=65536)
def new_share(key: Cells, known: Cells) -> float:
    """The share of `key`, what one drone sees well, that another does not see well, 0 … 1."""
    return len(key - known) / len(key) if key else 0.0
