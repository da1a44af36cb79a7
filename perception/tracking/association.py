"""Which box is of which track: gated by Mahalanobis distance, assigned at the least cost (the Hungarian method). Free of torch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sortie.perception.metrics.assignment import least_cost
from sortie.perception.metrics.overlap import near_pairs

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

GATE = 9.21
"""Squared Mahalanobis distance beyond which a box is not of a track: 99 % of its own lie within it (χ², two degrees)."""
FEW = 10_000
"""So many pairs are all tried; of more, those that are near are looked up first."""


def assigned(
    xy_m: Floats, variance_m2: Floats, owner: Ints, places_m: Floats, places_owner: Ints, gate: float = GATE
) -> tuple[Ints, Ints]:
    """Pairs (i, j) of things expected and places found, at most one of each; i ascends.

    Args:
        xy_m, variance_m2, owner: [n, 2], [n], [n] where each thing is expected, the variance of the difference along each
            axis, and to whom it belongs.
        places_m, places_owner: [m, 2], [m] the places; only those of one owner make pairs.
        gate: the largest squared Mahalanobis distance of a pair.

    The sum of squared distances is least, where everything expected that gets no place costs `gate`.
    """
    i, j, cost = gated(xy_m, variance_m2, owner, places_m, places_owner, gate)
    taken = least_cost(i, j, cost, owner[i], gate)
    return i[taken], j[taken]


def gated(
    xy_m: Floats, variance_m2: Floats, owner: Ints, places_m: Floats, places_owner: Ints, gate: float
) -> tuple[Ints, Ints, Floats]:
    """Pairs (i, j) of one owner within the gate, and their squared Mahalanobis distances; i ascends."""
    if len(xy_m) * len(places_m) <= FEW:
        off_x, off_y = (xy_m[:, k, None] - places_m[:, k] for k in (0, 1))
        every = (off_x * off_x + off_y * off_y) / variance_m2[:, None]
        i, j = np.nonzero((every < gate) & (owner[:, None] == places_owner))
        return i, j, every[i, j]
    i, j = near_pairs(_discs(xy_m, np.sqrt(gate * variance_m2)), _discs(places_m, 0.0), owner, places_owner)
    off = xy_m[i] - places_m[j]
    cost = (off[:, 0] * off[:, 0] + off[:, 1] * off[:, 1]) / variance_m2[i]
    near = cost < gate
    return i[near], j[near], cost[near]


def _discs(xy_m: Floats, radius_m: Floats | float) -> Floats:
    """Boxes [n, 5] whose circumscribed circles have these radii."""
    out = np.zeros((len(xy_m), 5))
    out[:, :2], out[:, 2] = xy_m, 2.0 * radius_m
    return out
