"""What a drone says about what it sees: footprint and coverage grid, from geometry alone (no content).

The grid is 16 × 16 cells of 12.8 m, north-aligned and snapped to the world's 12.8 m lattice, so that two drones'
grids can be compared cell by cell. It covers the ±102.4 m that the perception covers.
"""

from __future__ import annotations

import math

import numpy as np

from policies.contract import COVERAGE_CELLS, Coverage

CELL_M = 12.8
HALF_FIELD_OF_VIEW_DEG = 35.0
"""Half of the nadir camera's 70° field of view: at 60 m a footprint radius of 42 m (FACTS §1)."""
RANGE_M = 102.4
_HALF_FIELD_OF_VIEW_TAN = math.tan(math.radians(HALF_FIELD_OF_VIEW_DEG))
_CELLS = np.arange(COVERAGE_CELLS)
_PLACES = np.array([1, 4, 16, 64], np.uint8)
NOVEL_FLAG, TARGET_FLAG = 1, 2


def footprint_radius_m(height_m: float) -> float:
    """Radius of the nadir footprint at a height above ground."""
    return max(0.0, height_m) * _HALF_FIELD_OF_VIEW_TAN


def pack_grid(states: np.ndarray) -> bytes:
    """16 × 16 coverage states (rows from south, columns from west) to 64 B, lowest bits first."""
    return (states.astype(np.uint8).reshape(-1, 4) @ _PLACES).tobytes()


def unpack_grid(grid: bytes) -> np.ndarray:
    """The inverse of `pack_grid`: uint8 [16, 16]."""
    packed = np.frombuffer(grid, np.uint8)[:, None]
    return ((packed >> np.array([0, 2, 4, 6], np.uint8)) & 3).reshape(COVERAGE_CELLS, COVERAGE_CELLS)


class CoverageMap:
    """One drone's coverage statement and its memory of what it has seen well."""

    def __init__(self) -> None:
        self._seen_well: set[tuple[int, int]] = set()

    def look(self, x_m: float, y_m: float, radius_m: float) -> tuple[bytes, bool]:
        """The grid from here, and whether any cell is seen well for the first time.

        Args:
            x_m, y_m: where the drone believes it is, ENU.
            radius_m: its footprint radius.
        """
        half = COVERAGE_CELLS // 2
        west, south = math.floor(x_m / CELL_M) - half, math.floor(y_m / CELL_M) - half
        distance_m = np.hypot((west + _CELLS + 0.5) * CELL_M - x_m, ((south + _CELLS + 0.5) * CELL_M - y_m)[:, None])
        well = distance_m <= radius_m
        states = (distance_m <= RANGE_M).astype(np.uint8)  # UNSEEN or POOR
        states[well] = Coverage.WELL
        seen = self._seen_well
        new = [(r, c) for r, c in np.argwhere(well).tolist() if (west + c, south + r) not in seen]
        for r, c in new:
            states[r, c] = Coverage.NOVEL
            seen.add((west + c, south + r))
        return pack_grid(states), bool(new)
