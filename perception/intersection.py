"""Covariance intersection: one place from several with errors in common, without claiming more than they give. Free of torch.

S. J. Julier and J. K. Uhlmann (American Control Conference, 1997) join places x_i with covariances P_i by

    P⁻¹ = Σ ω_i P_i⁻¹,  x = P Σ ω_i P_i⁻¹ x_i,  ω_i ≥ 0,  Σ ω_i = 1.

If every P_i covers its error, P covers the error of x, whatever the errors have in common. That is cautious: two equal
places give the covariance of one. Where it is known that at most a share c of each variance is common to several places,
the rest is independent (split covariance intersection: S. J. Julier and J. K. Uhlmann, in Handbook of Multisensor Data
Fusion, 2001), and with P_i = c P_i + (1 − c) P_i

    P⁻¹ = Σ g(ω_i) P_i⁻¹,  g(ω) = ω / (c + (1 − c) ω).

With c = 1 this is the first rule, with c = 0 the mean of independent places. The weights ω give the least determinant of P.
For c = 1 to find them is a D-optimal design: ω_i is multiplied by tr(P P_i⁻¹) / 2 until no such number is above 1 (D. M.
Titterington, Algorithms for computing D-optimal designs on a finite design space, 1976). For other c, the derivative g'(ω_i)
is one more factor, and the products are scaled to a sum of one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
TOLERANCE = 1e-4
"""By which share the largest slope of log det P⁻¹ may be above the mean slope; at the best weights none is above it."""
MOST_ROUNDS = 2000


class Intersection(NamedTuple):
    """Of g groups of places, n in all."""

    xy_m: Floats
    """[g, 2]"""
    covariance_m2: Floats
    """[g, 3] east, east–north and north variance."""
    weight: Floats
    """[n] ω of each place within its group."""


def inverse(symmetric: Floats) -> Floats:
    """Inverses [n, 3] of symmetric 2 × 2 matrices [n, 3] (first, mixed and second entry)."""
    a, b, c = symmetric.T
    det = a * c - b * b
    return np.stack([c / det, -b / det, a / det], axis=1)


def intersect(xy_m: Floats, information: Floats, group: NDArray[np.intp], common: float = 1.0) -> Intersection:
    """The intersection of each group.

    Args:
        xy_m: [n, 2] places.
        information: [n, 3] inverse covariances, as `inverse` gives them.
        group: [n] numbers of groups, 0 … g − 1, each with one place at least.
        common: c, the share of each variance that may be common to several places, 0 … 1.

    Example:
        >>> two = intersect(np.array([[0.0, 0.0], [1.0, 1.0]]), np.array([[4.0, 0, 1], [1, 0, 4]]), np.array([0, 0]))
        >>> two.weight.tolist(), two.xy_m.round(3).tolist(), (two.covariance_m2.round(3) + 0.0).tolist()
        ([0.5, 0.5], [[0.2, 0.8]], [[0.4, 0.0, 0.4]])
    """
    count = int(group.max()) + 1
    sizes = np.bincount(group, minlength=count)
    weight = 1.0 / sizes[group]
    # of groups that are not done; a place alone is, and without common errors weights say nothing
    at = np.flatnonzero((sizes > 1)[group] & (common > 0.0))
    for _ in range(MOST_ROUNDS):
        if not len(at):
            break
        where, omega = np.unique(group[at], return_inverse=True)[1], weight[at]
        slope = _slopes(information[at], omega, where, common)
        mean = np.bincount(where, omega * slope)
        ratio = slope / mean[where]
        high = np.zeros(len(mean))
        np.maximum.at(high, where, ratio)
        go = (high > 1.0 + TOLERANCE)[where]
        weight[at] = np.where(go, omega * ratio, omega)
        at = at[go]
    used = _used(weight, common)[:, None] * information
    covariance = inverse(_sums(used, group, count))
    a, b, c = used.T
    x, y = xy_m.T
    pull = _sums(np.stack([a * x + b * y, b * x + c * y], axis=1), group, count)
    xx, xy, yy = covariance.T
    place = np.stack([xx * pull[:, 0] + xy * pull[:, 1], xy * pull[:, 0] + yy * pull[:, 1]], axis=1)
    return Intersection(place, covariance, weight)


def _used(weight: Floats, common: float) -> Floats:
    """g(ω): how much of each place's information counts."""
    return weight / (common + (1.0 - common) * weight) if common > 0.0 else np.ones_like(weight)


def _slopes(information: Floats, weight: Floats, group: NDArray[np.intp], common: float) -> Floats:
    """The derivative of log det P⁻¹ by each ω."""
    count = int(group.max()) + 1
    a, b, c = inverse(_sums(_used(weight, common)[:, None] * information, group, count))[group].T
    trace = a * information[:, 0] + 2.0 * b * information[:, 1] + c * information[:, 2]
    return np.asarray(trace * common / (common + (1.0 - common) * weight) ** 2)


def _sums(values: Floats, group: NDArray[np.intp], count: int) -> Floats:
    return np.stack([np.bincount(group, v, count) for v in values.T], axis=1)
