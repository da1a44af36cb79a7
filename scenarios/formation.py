"""Where each drone flies in the formation: pure geometry, one function a shape.

Slots are given in the formation's frame (x forward, y left, metres, origin at the moving reference
point). Slot i of cross, line, wedge and grid is a function of i alone, so that adding a drone moves
nobody. A circle cannot do that: its slots share the round evenly, so one more drone moves all but the
bearing of the first.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt


def _cross(i: int) -> tuple[float, float]:
    """Centre, then four arms growing outward: front, left, rear, right."""
    if i == 0:
        return 0.0, 0.0
    ring, arm = divmod(i - 1, 4)
    x, y = ((1, 0), (0, 1), (-1, 0), (0, -1))[arm]
    return float(x * (ring + 1)), float(y * (ring + 1))


def _line(i: int) -> tuple[float, float]:
    """Abreast: centre, then left and right in turn."""
    k = (i + 1) // 2
    return 0.0, float(k if i % 2 else -k)


def _wedge(i: int) -> tuple[float, float]:
    """A leader, then wingmen left and right in turn, each behind the last at 45°."""
    k = (i + 1) // 2 / math.sqrt(2)
    return -k, k if i % 2 else -k


def _grid(i: int) -> tuple[float, float]:
    """A square spiral from the centre; a full, centred square whenever n is an odd number squared."""
    if i == 0:
        return 0.0, 0.0
    ring = (math.isqrt(i) + 1) // 2  # ring r holds (2r − 1)² … (2r + 1)² − 1
    side, step = divmod(i - (2 * ring - 1) ** 2, 2 * ring)
    along = step + 1 - ring
    return ((ring, along), (-along, ring), (-ring, -along), (along, -ring))[side]


_GROWING: dict[str, Callable[[int], tuple[float, float]]] = {
    "cross": _cross,
    "line": _line,
    "wedge": _wedge,
    "grid": _grid,
}


def slots(shape: str, n: int, spacing_m: float) -> npt.NDArray[np.float64]:
    """Slots of a formation.

    Args:
        shape: "cross", "line", "wedge", "grid" or "circle".
        n: number of drones, ≥ 1.
        spacing_m: distance between neighbouring slots, > 0; in a circle, along the arc.

    Returns:
        [n, 2], x forward and y left of the reference point, metres.

    Raises:
        ValueError: an unknown shape, n below 1 or a spacing that is not positive.
    """
    if n < 1:
        raise ValueError(f"n is {n}, must be at least 1")
    if not spacing_m > 0:
        raise ValueError(f"spacing_m is {spacing_m}, must be > 0")
    if shape == "circle":
        angles = 2 * np.pi * np.arange(n) / n
        radius_m = n * spacing_m / (2 * np.pi) if n > 1 else 0.0
        return radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    if shape not in _GROWING:
        raise ValueError(f"shape is {shape!r}, must be one of {[*_GROWING, 'circle']}")
    return spacing_m * np.array([_GROWING[shape](i) for i in range(n)], dtype=float)
