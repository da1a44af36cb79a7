"""Footprint and coverage grid of a drone, from geometry alone.

The grid is 16 × 16 cells of 12.8 m, north-aligned and snapped to the world's 12.8 m lattice, so that two drones'
grids can be compared cell by cell. It covers the ±102.4 m that the perception covers.
"""

from __future__ import annotations

import math
from typing import overload

import numpy as np
import numpy.typing as npt

from sortie.perception.geometry import FULL
from sortie.policies.contract import COVERAGE_CELL_M as CELL_M
from sortie.policies.contract import COVERAGE_CELLS, Coverage

Array = npt.NDArray[np.float64]

HALF_FIELD_OF_VIEW_DEG = 35.0
"""Half of the nadir camera's 70° field of view: at 60 m a footprint radius of 42 m (FACTS §1)."""
RANGE_M = FULL.half_extent_m
"""From the drone to each edge of the square that perception covers."""
NOVEL_FLAG, TARGET_FLAG = 1, 2
_HALF_FIELD_OF_VIEW_TAN = math.tan(math.radians(HALF_FIELD_OF_VIEW_DEG))
_HALF = COVERAGE_CELLS // 2
_CELLS = np.arange(COVERAGE_CELLS)
_PLACES = np.array([1, 4, 16, 64], np.uint8)


@overload
def footprint_radius_m(height_m: float) -> float: ...
@overload
def footprint_radius_m(height_m: Array) -> Array: ...
def footprint_radius_m(height_m: float | Array) -> float | Array:
    """Radius of the nadir footprint at a height above ground, any shape."""
    radius_m: Array = np.maximum(0.0, height_m) * _HALF_FIELD_OF_VIEW_TAN
    return radius_m


def pack_grid(states: npt.NDArray[np.uint8]) -> bytes:
    """16 × 16 coverage states (rows from south, columns from west) to 64 B, lowest bits first."""
    return (states.astype(np.uint8).reshape(-1, 4) @ _PLACES).tobytes()


def unpack_grid(grid: bytes) -> npt.NDArray[np.uint8]:
    """The inverse of `pack_grid`: uint8 [16, 16]."""
    packed = np.frombuffer(grid, np.uint8)[:, None]
    states: npt.NDArray[np.uint8] = (packed >> np.array([0, 2, 4, 6], np.uint8)) & np.uint8(3)
    return states.reshape(COVERAGE_CELLS, COVERAGE_CELLS)


def survey(x_m: npt.ArrayLike, y_m: npt.ArrayLike, radius_m: npt.ArrayLike) -> list[tuple[bytes, bool]]:
    """One drone's coverage statements along its way, all at once.

    Args:
        x_m, y_m: [K] where it believes it is at each look, ENU, in the order of time.
        radius_m: [K] its footprint radius.

    Returns:
        At each look the grid, and whether any cell is seen well for the first time.
    """
    x, y, radius = (np.asarray(v, dtype=float)[:, None] for v in (x_m, y_m, radius_m))
    columns = np.floor(x / CELL_M).astype(np.int64) - _HALF + _CELLS  # [K, 16] of the world's lattice
    rows = np.floor(y / CELL_M).astype(np.int64) - _HALF + _CELLS
    distance_m = np.hypot(((columns + 0.5) * CELL_M - x)[:, None, :], ((rows + 0.5) * CELL_M - y)[:, :, None])
    well = distance_m <= radius[:, None]
    states = (distance_m <= RANGE_M).astype(np.uint8)  # UNSEEN or POOR
    states[well] = Coverage.WELL
    look, row, column = np.nonzero(well)  # in the order of looks, so that a cell's first entry is its first sight
    north, east = rows[look, row] - rows.min(initial=0), columns[look, column] - columns.min(initial=0)
    _, first = np.unique(north * (columns.max(initial=0) - columns.min(initial=0) + 1) + east, return_index=True)
    states[look[first], row[first], column[first]] = Coverage.NOVEL
    novel = np.zeros(len(states), bool)
    novel[look[first]] = True
    return list(zip(map(pack_grid, states), novel.tolist(), strict=True))
