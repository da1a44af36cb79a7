"""Cars as small rasters in the scenery, compiled: put in, and taken out again."""

from __future__ import annotations

from typing import Any

import numpy as np

from sortie.perception.compiled import compiled

_F = np.float32
_BONNET, _LOWEST = _F(0.62), _F(-1.0)
_TRUCK_M = _F(2.7)
"""What is as high as this is a truck: its load is as high as its cab."""
_GLASS = (np.uint8(30), np.uint8(34), np.uint8(42))


@compiled
def stamp(
    height: Any, colour: Any, light: Any, res_m: Any, spans: Any, middles: Any, turns: Any, sizes: Any, colours: Any
) -> None:
    """Each car: bonnet and boot at 0.62 of its height, a cabin with dark glass at its ends. Trucks are boxes with dark glass in front.

    Where something stands higher (a canopy), it goes on hiding the car.

    Args:
        height: float32 [rows, columns], colour: uint8 [rows, columns, 3] and light: float32 [rows, columns], of `res_m`.
        spans: int64 [n, 4], the pixels to go through: from row, to row, from column, to column.
        middles: [n, 2] column and row of the middle, pixels; turns: [n, 2] cosine and sine of the heading.
        sizes: [n, 3] length, width, height, m; colours: uint8 [n, 3].
    """
    for k in range(len(spans)):
        cos, sin = turns[k]
        length, width, top = sizes[k, 0], sizes[k, 1], _F(sizes[k, 2])
        for r in range(spans[k, 0], spans[k, 1]):
            dy = (r + 0.5 - middles[k, 1]) * res_m
            for c in range(spans[k, 2], spans[k, 3]):
                dx = (c + 0.5 - middles[k, 0]) * res_m
                u = (cos * dx + sin * dy) / length  # −0.5 … 0.5 from tail to nose
                v = (cos * dy - sin * dx) / width
                if abs(u) >= 0.5 or abs(v) >= 0.5:
                    continue
                truck = top > _TRUCK_M
                cabin = truck or -0.42 < u < 0.24
                z = top if cabin else _BONNET * top
                if z <= height[r, c]:
                    continue
                height[r, c] = z
                glass = u > 0.44 if truck else cabin and (u > 0.12 or u < -0.34)
                for i in range(3):
                    colour[r, c, i] = np.uint8(_F(_GLASS[i] if glass else colours[k, i]) * light[r, c])


@compiled
def raised(height: Any, coarse: Any, block: Any, spans: Any) -> None:
    """Have the map of the highest of each block, and of those around it, know what was stamped."""
    rows, columns = coarse.shape
    for k in range(len(spans)):
        top = _LOWEST
        for r in range(spans[k, 0], spans[k, 1]):
            for c in range(spans[k, 2], spans[k, 3]):
                top = max(top, height[r, c])
        for r in range(max(spans[k, 0] // block - 1, 0), min((spans[k, 1] - 1) // block + 2, rows)):
            for c in range(max(spans[k, 2] // block - 1, 0), min((spans[k, 3] - 1) // block + 2, columns)):
                coarse[r, c] = max(coarse[r, c], top)


@compiled
def saved(height: Any, colour: Any, spans: Any) -> tuple[Any, Any]:
    """What stands where cars will be stamped, span after span, [pixels] and [pixels, 3]."""
    pixels = 0
    for k in range(len(spans)):
        pixels += (spans[k, 1] - spans[k, 0]) * (spans[k, 3] - spans[k, 2])
    heights, colours, i = np.empty(pixels, height.dtype), np.empty((pixels, 3), colour.dtype), 0
    for k in range(len(spans)):
        for r in range(spans[k, 0], spans[k, 1]):
            for c in range(spans[k, 2], spans[k, 3]):
                heights[i] = height[r, c]
                colours[i] = colour[r, c]
                i += 1
    return heights, colours


@compiled
def restore(height: Any, colour: Any, spans: Any, heights: Any, colours: Any) -> None:
    """Undo `stamp`, given what was `saved` before."""
    i = 0
    for k in range(len(spans)):
        for r in range(spans[k, 0], spans[k, 1]):
            for c in range(spans[k, 2], spans[k, 3]):
                height[r, c] = heights[i]
                colour[r, c] = colours[i]
                i += 1
