"""How far boxes on the ground overlap, for many pairs at once. Free of torch.

Boxes are rows x, y, length, width, yaw. numpy and not torch: the record of what was found is numpy's, and on a CPU
torch is no faster at it (measured in `research/paper/README.md`).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sortie.perception.classes import NEAR_M, PERSON

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Kind = Literal["rotated", "axis-aligned"]
"""Boxes as they stand, or their axis-aligned hulls, in the frame in which they are given."""
_BLOCK = 8192
"""Pairs at a time, so that a block stays in the cache."""


def corners(boxes: Floats) -> Floats:
    """Corners [n, 4, 2], anticlockwise, of boxes [n, 5]."""
    c, s = np.cos(boxes[:, 4]), np.sin(boxes[:, 4])
    u = boxes[:, 2, None] * np.array([0.5, -0.5, -0.5, 0.5])
    v = boxes[:, 3, None] * np.array([0.5, 0.5, -0.5, -0.5])
    return np.stack(
        [boxes[:, 0, None] + c[:, None] * u - s[:, None] * v, boxes[:, 1, None] + s[:, None] * u + c[:, None] * v],
        axis=-1,
    )


def iou_pairs(a: Floats, b: Floats) -> Floats:
    """Rotated IoU [n] of boxes a[i] with b[i], both [n, 5]. Exact to rounding, also where edges all but coincide."""
    out = np.zeros(len(a))
    for at in range(0, len(a), _BLOCK):
        one, other = (np.asarray(boxes[at : at + _BLOCK], np.float64).T for boxes in (a, b))
        overlap = _common_area(one, other)
        union = one[2] * one[3] + other[2] * other[3] - overlap
        out[at : at + _BLOCK] = np.clip(overlap / np.where(union > 0.0, union, 1.0), 0.0, 1.0)
    return out


def _common_area(a: Floats, b: Floats) -> Floats:
    """Area [n] that boxes a and b, both [5, n], have in common.

    Seen from b, it is the part of a where |x| ≤ h and |y| ≤ w. By Green's theorem that is the integral of
    clamp(x, −h, h) dy along a's outline, where |y| ≤ w. What an edge adds to it changes continuously with the boxes.
    So edges that coincide are no special case, and there is no tolerance.
    """
    turn = a[4] - b[4]
    c, s = np.cos(turn), np.sin(turn)
    cb, sb = np.cos(b[4]), np.sin(b[4])
    dx, dy = a[0] - b[0], a[1] - b[1]
    x, y = cb * dx + sb * dy, cb * dy - sb * dx  # a's centre
    la, wa, h, w = a[2] / 2, a[3] / 2, b[2] / 2, b[3] / 2
    # a's edges from corner to corner, anticlockwise from front left
    px = np.stack([x + c * la - s * wa, x - c * la - s * wa, x - c * la + s * wa, x + c * la + s * wa])
    py = np.stack([y + s * la + c * wa, y - s * la + c * wa, y - s * la - c * wa, y + s * la - c * wa])
    ex, ey = np.roll(px, -1, axis=0) - px, np.roll(py, -1, axis=0) - py
    y0, y1 = np.clip(py, -w, w), np.clip(py + ey, -w, w)
    part = np.where(ey == 0.0, 1.0, ey)
    x0 = px + ex * np.clip((y0 - py) / part, 0.0, 1.0)
    x1 = px + ex * np.clip((y1 - py) / part, 0.0, 1.0)
    c0, c1 = np.clip(x0, -h, h), np.clip(x1, -h, h)
    # the mean of the clamped x from y0 to y1: linear between c0 and c1, and level beyond each
    across = x1 - x0
    beyond = (c0 - c1) * ((c0 - x0) - (x1 - c1)) / np.where(across == 0.0, 1.0, across)
    return np.asarray(np.maximum((0.5 * (c0 + c1 + beyond) * (y1 - y0)).sum(axis=0), 0.0))


def hulls(boxes: Floats) -> Floats:
    """The axis-aligned hulls of boxes, as boxes [n, 5] of yaw 0."""
    points = corners(boxes)
    low, high = points.min(axis=1), points.max(axis=1)
    return np.concatenate([(low + high) / 2, high - low, np.zeros((len(boxes), 1))], axis=1)


def near_pairs(a: Floats, b: Floats, of_a: Ints | None = None, of_b: Ints | None = None) -> tuple[Ints, Ints]:
    """Indices (i, j) of boxes of a and b whose circumscribed circles touch; i ascends.

    Args:
        a, b: [n, 5], [m, 5].
        of_a, of_b: [n], [m] the image that each box is from, ≥ 0; only boxes of one image make pairs. Left out, all
            are from one.
    """
    none = np.zeros(0, np.int64)
    if not len(a) or not len(b):
        return none, none
    ra, rb = 0.5 * np.hypot(a[:, 2], a[:, 3]), 0.5 * np.hypot(b[:, 2], b[:, 3])
    # images side by side on one axis, sorted: candidates of a box are a run of it
    reach = ra + rb.max() + 1e-6
    low = min(a[:, 0].min(), b[:, 0].min())
    apart = max(a[:, 0].max(), b[:, 0].max()) - low + 2 * reach.max()
    at_a = a[:, 0] - low + (0.0 if of_a is None else of_a * apart)
    at_b = b[:, 0] - low + (0.0 if of_b is None else of_b * apart)
    order = np.argsort(at_b, kind="stable")
    first = np.searchsorted(at_b[order], at_a - reach, side="left")
    count = np.searchsorted(at_b[order], at_a + reach, side="right") - first
    i = np.repeat(np.arange(len(a)), count)
    run = np.arange(len(i)) - np.repeat(np.cumsum(count) - count, count)
    j = order[np.repeat(first, count) + run]
    dx, dy = a[i, 0] - b[j, 0], a[i, 1] - b[j, 1]
    touch = dx * dx + dy * dy <= (ra[i] + rb[j]) ** 2
    return i[touch], j[touch]


def overlapping(
    a: Floats, b: Floats, of_a: Ints | None = None, of_b: Ints | None = None, kind: Kind = "rotated"
) -> tuple[Ints, Ints, Floats]:
    """Pairs (i, j) of one image that may overlap, and their IoU; arguments as for `near_pairs`."""
    if kind == "axis-aligned":
        a, b = hulls(a), hulls(b)
    i, j = near_pairs(a, b, of_a, of_b)
    return i, j, iou_pairs(a[i], b[j])


def close_people(
    a_m: Floats, kind_a: NDArray[np.integer], b_m: Floats, kind_b: NDArray[np.integer], of_a: Ints, of_b: Ints
) -> tuple[Ints, Ints, Floats]:
    """Pairs (i, j) of people of one image within `NEAR_M`, and 1 less their distance over that: 1 where they coincide.

    Args:
        a_m, kind_a, of_a: [n, 2] places, [n] classes and [n] images of all boxes; likewise b.
    """
    a, b = np.flatnonzero(kind_a == PERSON), np.flatnonzero(kind_b == PERSON)
    i, j = near_pairs(_discs(a_m[a]), _discs(b_m[b]), of_a[a], of_b[b])
    i, j = a[i], b[j]
    return i, j, 1.0 - np.hypot(*(a_m[i] - b_m[j]).T.astype(np.float64)) / NEAR_M


def _discs(xy_m: Floats) -> Floats:
    """Boxes [n, 5] whose circumscribed circles touch where they are `NEAR_M` apart."""
    out = np.zeros((len(xy_m), 5))
    out[:, :2], out[:, 2] = xy_m, NEAR_M
    return out
