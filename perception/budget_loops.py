"""The compiled count of the cells in a disc (`sortie.perception.budget`); it rounds as Python does."""

from __future__ import annotations

import numpy as np

from sortie.scenarios.compiled import compiled, part

_GRID = 64  # that of the file above: kept machine code does not see that another file has changed


@part
def _held(place):
    return int(min(max(place, 0.0), 1.0 * _GRID))  # held first: the place of a huge disc is no whole number of 64 bits


@compiled
def count(forward_m, left_m, radius_m, cell_m):
    """How many cells have their centre in a disc at this place of the sender's level frame."""
    square, found, half = radius_m * radius_m, 0, _GRID // 2
    first = _held(np.floor((left_m - radius_m) / cell_m) + half)
    last = _held(np.ceil((left_m + radius_m) / cell_m) + half)
    for row in range(
        _held(np.floor((forward_m - radius_m) / cell_m) + half),
        _held(np.ceil((forward_m + radius_m) / cell_m) + half),
    ):
        x_m = (row + 0.5 - _GRID / 2) * cell_m
        room = square - (x_m - forward_m) * (x_m - forward_m)
        for column in range(first, last):
            y_m = (column + 0.5 - _GRID / 2) * cell_m
            found += (y_m - left_m) * (y_m - left_m) <= room
    return found
