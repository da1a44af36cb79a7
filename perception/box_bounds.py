"""What a box must be where a user's detector, fusion or recording hands it over."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

COLUMNS = ("x", "y", "length", "width", "yaw", "score")
"""Of boxes as rows."""
SIZE_M = (1e-3, 1e3)
TURNS = 2
"""A yaw may be so many whole turns, either way: sums of angles are not always wrapped."""
YAW_RAD = 2 * np.pi * TURNS


def wrong_yaw(yaw_rad: ArrayLike) -> NDArray[np.bool_]:
    """Which yaws are not finite, or more than `TURNS`."""
    return np.asarray(~(np.abs(yaw_rad) <= YAW_RAD))


def wrong_box(rows: NDArray[Any]) -> str:
    """What is wrong with the first wrong value of boxes [n, 5 or 6] as `COLUMNS`, in words; nothing if all are right."""
    rows = rows.astype(np.float64)
    low, high = SIZE_M
    size = rows[:, 2:4]
    wrong = np.zeros(rows.shape, bool)
    wrong[:, :2] = ~np.isfinite(rows[:, :2])
    wrong[:, 2:4] = ~((size >= low) & (size <= high))
    wrong[:, 4] = wrong_yaw(rows[:, 4])
    wrong[:, 5:] = ~((rows[:, 5:] >= 0.0) & (rows[:, 5:] <= 1.0))
    if not wrong.any():
        return ""
    row, column = np.argwhere(wrong)[0].tolist()
    bounds = ("finite", "finite", *[f"{low:g} to {high:g} m"] * 2, f"within ±{YAW_RAD:.2f} rad, not degrees", "0 to 1")
    return f"{COLUMNS[column]} in row {row} (from 0) is {rows[row, column]:g}, must be {bounds[column]}"
