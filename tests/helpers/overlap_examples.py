"""Overlap of boxes by shapely's polygons and exact fractions."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import shapely
from hypothesis import strategies as st
from shapely import affinity

box = st.tuples(
    st.floats(-3, 3), st.floats(-3, 3), st.floats(0.5, 6), st.floats(0.5, 3), st.floats(-7, 7)
)  # x, y, length, width, yaw


def polygon(b: np.ndarray) -> shapely.Polygon:
    flat = shapely.box(-b[2] / 2, -b[3] / 2, b[2] / 2, b[3] / 2)
    return affinity.translate(affinity.rotate(flat, b[4], origin=(0, 0), use_radians=True), b[0], b[1])


def plain_iou(a: np.ndarray, b: np.ndarray) -> float:
    return exact_iou(polygon(a), polygon(b))


def exact_iou(p: shapely.Polygon, q: shapely.Polygon) -> float:
    """IoU of two convex polygons by clipping one with every edge of the other, in fractions.

    shapely's own intersection is empty for some polygons that lie 1e-16 m apart.
    """
    clipped, other = (
        [(Fraction(x), Fraction(y)) for x, y in shapely.orient_polygons(each).exterior.coords[:-1]] for each in (p, q)
    )
    union = shoelace(clipped) + shoelace(other)
    for (x0, y0), (x1, y1) in zip(other, other[1:] + other[:1], strict=True):
        side = [(x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) for x, y in clipped]
        left = []
        for k, ((x, y), d) in enumerate(zip(clipped, side, strict=True)):
            (before_x, before_y), e = clipped[k - 1], side[k - 1]
            if d * e < 0:
                left.append((x + (before_x - x) * d / (d - e), y + (before_y - y) * d / (d - e)))
            if d >= 0:
                left.append((x, y))
        clipped = left
    return float(shoelace(clipped) / (union - shoelace(clipped)))


def shoelace(points: list[tuple[Fraction, Fraction]]) -> Fraction:
    twice = Fraction()
    for (x0, y0), (x1, y1) in zip(points, points[1:] + points[:1], strict=True):
        twice += x0 * y1 - x1 * y0
    return twice / 2
