"""Compiled loops of `sortie.fleet.chart`: a set of cells as a hash table of their keys, and grids as packed bytes."""

from __future__ import annotations

import numpy as np

from sortie.scenarios.compiled import compiled, part

# constants of the file itself: kept machine code does not see that another file has changed
CELLS = 16
"""Cells a side of a grid."""
WELL = 2
_ANY_WELL = np.uint8(0b10101010)
"""Of a byte with four cells: what is not zero where any of them is seen well."""
EMPTY = -(1 << 63)
"""A place of the table without a cell."""
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)


@part
def _place(keys, key):
    """Where a cell is in the table, or would be."""
    mask = len(keys) - 1
    at = np.int64((np.uint64(key) * _GOLDEN) >> np.uint64(33)) & mask
    while keys[at] != EMPTY and keys[at] != key:
        at = (at + 1) & mask
    return at


@part
def _state(grid, cell):
    return (grid[cell >> 2] >> np.uint8(2 * (cell & 3))) & np.uint8(3)


@part
def _key(row, column):
    return (row << 32) + column


@compiled
def fold(keys, count, grids, rows, columns, since):
    """Add what grids [K, 64] see well, from grid `since` on; (row, column) is the south-west cell of each.

    Returns: how many cells the table holds, and the first grid for which it has too little room, K at the end.
    """
    for k in range(since, len(grids)):
        if 2 * (count + CELLS * CELLS) > len(keys):
            return count, k
        for four in range(CELLS * CELLS // 4):
            if not grids[k, four] & _ANY_WELL:
                continue
            for cell in range(4 * four, 4 * four + 4):
                if _state(grids[k], cell) >= WELL:
                    key = _key(rows[k] + cell // CELLS, columns[k] + cell % CELLS)
                    at = _place(keys, key)
                    if keys[at] == EMPTY:
                        keys[at] = key
                        count += 1
    return count, len(grids)


@compiled
def enlarge(keys, larger):
    """Move the cells to a larger table."""
    for key in keys:
        if key != EMPTY:
            larger[_place(larger, key)] = key


@compiled
def unknown(keys, grid, row, column, new):
    """Mark the cells that a grid sees well and that are not in the table, in `new` [256]; returns how many."""
    count = 0
    for four in range(CELLS * CELLS // 4):
        any_well = grid[four] & _ANY_WELL
        for cell in range(4 * four, 4 * four + 4):
            new[cell] = (
                any_well
                and _state(grid, cell) >= WELL
                and keys[_place(keys, _key(row + cell // CELLS, column + cell % CELLS))] == EMPTY
            )
            count += new[cell]
    return count


@compiled
def without(new, count, row, column, grids, rows, columns):
    """Take away from `new` what grids [K, 64] see well; returns how many are left."""
    for k in range(len(grids)):
        if count == 0:
            break
        north, east = row - rows[k], column - columns[k]
        if abs(north) >= CELLS or abs(east) >= CELLS:
            continue
        for cell in range(CELLS * CELLS):
            at_row, at_column = cell // CELLS + north, cell % CELLS + east
            inside = 0 <= at_row < CELLS and 0 <= at_column < CELLS
            if new[cell] and inside and _state(grids[k], at_row * CELLS + at_column) >= WELL:
                new[cell] = False
                count -= 1
    return count


@compiled
def mark(grid, new, state):
    """Raise the marked cells of a grid [64] to a state."""
    for cell in range(CELLS * CELLS):
        if new[cell]:
            grid[cell >> 2] |= np.uint8(state << (2 * (cell & 3)))
