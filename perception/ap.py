"""Boxes on the ground and how good they are: rotated overlap, suppression, average precision and its uncertainty.

AP here is AP@0.5 by rotated bird's-eye IoU: detections of all frames sorted by score together, each matched
greedily to the best *remaining* ground truth of its frame, area under the all-point interpolated curve.
Equal scores form one point of the curve, so neither frame order nor box order among ties matters to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.types import Boxes
from scenarios.streams import stream

Floats = NDArray[np.float64]


def corners(boxes: Floats) -> Floats:
    """Corners [n, 4, 2], anticlockwise, of boxes [n, 5] (x, y, length, width, yaw)."""
    c, s = np.cos(boxes[:, 4]), np.sin(boxes[:, 4])
    u = boxes[:, 2, None] * np.array([0.5, -0.5, -0.5, 0.5])
    v = boxes[:, 3, None] * np.array([0.5, 0.5, -0.5, -0.5])
    return np.stack(
        [boxes[:, 0, None] + c[:, None] * u - s[:, None] * v, boxes[:, 1, None] + s[:, None] * u + c[:, None] * v],
        axis=-1,
    )


def iou_pairs(a: Floats, b: Floats) -> Floats:
    """Rotated IoU [n] of boxes a[i] with b[i], both [n, 5].

    The overlap's corners are the corners of either inside the other and the crossings of their edges;
    sorted by angle about their mean they are a convex polygon, whose area is the shoelace sum.
    """
    n = len(a)
    if n == 0:
        return np.zeros(0)
    middle = a[:, None, :2]  # work near the origin, for precision
    pa, pb = corners(a) - middle, corners(b) - middle
    ea, eb = np.roll(pa, -1, axis=1) - pa, np.roll(pb, -1, axis=1) - pb

    def within(p: Floats, q: Floats, e: Floats) -> NDArray[np.bool_]:
        d = p[:, :, None, :] - q[:, None, :, :]
        side = e[:, None, :, 0] * d[..., 1] - e[:, None, :, 1] * d[..., 0]
        return np.asarray((side >= -1e-9).all(axis=2))

    d = pb[:, None, :, :] - pa[:, :, None, :]
    cross = ea[:, :, None, 0] * eb[:, None, :, 1] - ea[:, :, None, 1] * eb[:, None, :, 0]
    safe = np.where(np.abs(cross) < 1e-12, 1.0, cross)
    t = (d[..., 0] * eb[:, None, :, 1] - d[..., 1] * eb[:, None, :, 0]) / safe
    u = (d[..., 0] * ea[:, :, None, 1] - d[..., 1] * ea[:, :, None, 0]) / safe
    hit = (np.abs(cross) >= 1e-12) & (t >= 0) & (t <= 1) & (u >= 0) & (u <= 1)
    met = pa[:, :, None, :] + t[..., None] * ea[:, :, None, :]

    points = np.concatenate([pa, pb, met.reshape(n, 16, 2)], axis=1)
    use = np.concatenate([within(pa, pb, eb), within(pb, pa, ea), hit.reshape(n, 16)], axis=1)
    count = use.sum(axis=1)
    centre = (points * use[..., None]).sum(axis=1) / np.maximum(count, 1)[:, None]
    rel = points - centre[:, None, :]
    angle = np.where(use, np.arctan2(rel[..., 1], rel[..., 0]), np.inf)
    order = np.argsort(angle, axis=1)
    rel = np.take_along_axis(rel, order[..., None], axis=1)
    kept = np.take_along_axis(use, order, axis=1)
    rel = np.where(kept[..., None], rel, rel[:, :1, :])  # unused points fold onto the first
    nxt = np.roll(rel, -1, axis=1)
    overlap = 0.5 * np.abs((rel[..., 0] * nxt[..., 1] - rel[..., 1] * nxt[..., 0]).sum(axis=1))
    overlap = np.where(count >= 3, overlap, 0.0)
    union = a[:, 2] * a[:, 3] + b[:, 2] * b[:, 3] - overlap
    return np.asarray(np.clip(overlap / np.maximum(union, 1e-12), 0.0, 1.0))


def near_pairs(a: Floats, b: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices (i, j) of boxes of a and b whose circumscribed circles touch."""
    ra, rb = 0.5 * np.hypot(a[:, 2], a[:, 3]), 0.5 * np.hypot(b[:, 2], b[:, 3])
    dx, dy = a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1]
    i, j = np.nonzero(dx * dx + dy * dy <= (ra[:, None] + rb[None, :]) ** 2)
    return i, j


def suppress(boxes: Boxes, iou: float) -> Boxes:
    """Rotated non-maximum suppression: best first, a box that overlaps a kept one by more than `iou` goes."""
    boxes = boxes.take(np.argsort(-boxes.score, kind="stable"))
    table = boxes.table()
    i, j = near_pairs(table, table)
    i, j = i[i < j], j[i < j]
    clash = iou_pairs(table[i], table[j]) > iou
    rivals: dict[int, list[int]] = {}
    for first, second in zip(i[clash].tolist(), j[clash].tolist(), strict=True):
        rivals.setdefault(first, []).append(second)
    keep = np.ones(len(boxes), bool)
    for k in sorted(rivals):
        if keep[k]:
            keep[rivals[k]] = False
    return boxes.take(keep)


@dataclass(frozen=True, slots=True)
class Matched:
    """One frame's detections after matching: `score` [n], `hit` [n] bool, and how many cars there were."""

    score: Floats
    hit: NDArray[np.bool_]
    truths: int

    def at(self, tau: float) -> Matched:
        """The same without the detections below `tau`: they took nothing from those above."""
        keep = self.score >= tau
        return Matched(self.score[keep], self.hit[keep], self.truths)


def match(found: Boxes, truth: Boxes, disc: tuple[float, float, float] | None = None, iou: float = 0.5) -> Matched:
    """Match one frame's detections to its ground truth, best score first, each to the best remaining truth.

    With a `disc` (x, y, radius) only detections and truths centred in it count.
    """
    found, truth = found.inside(disc), truth.inside(disc)
    found = found.take(np.argsort(-found.score, kind="stable"))
    a, b = found.table(), truth.table()
    i, j = near_pairs(a, b)
    value = iou_pairs(a[i], b[j])
    good = value >= iou
    options: dict[int, list[tuple[float, int]]] = {}
    for row, column, v in zip(i[good].tolist(), j[good].tolist(), value[good].tolist(), strict=True):
        options.setdefault(row, []).append((-v, column))
    taken: set[int] = set()
    hit = np.zeros(len(found), bool)
    for row in sorted(options):
        for _, column in sorted(options[row]):
            if column not in taken:
                taken.add(column)
                hit[row] = True
                break
    return Matched(found.score.astype(np.float64), hit, len(truth))


def average_precision(frames: Sequence[Matched]) -> float:
    """AP over the frames; NaN when there was nothing to find."""
    return float(_weighted_ap(frames, np.ones((1, len(frames))))[0])


def _weighted_ap(frames: Sequence[Matched], weights: Floats) -> Floats:
    """AP [b] with frame f counted weights[b, f] times."""
    sizes = [len(f.score) for f in frames]
    owner = np.repeat(np.arange(len(frames)), sizes)
    score = np.concatenate([f.score for f in frames]) if frames else np.zeros(0)
    hit = np.concatenate([f.hit for f in frames]) if frames else np.zeros(0, bool)
    truths = weights @ np.array([f.truths for f in frames], dtype=np.float64)
    order = np.argsort(-score, kind="stable")
    score, owner, hit = score[order], owner[order], hit[order]
    ends = np.flatnonzero(np.append(score[1:] != score[:-1], True)) if len(score) else np.zeros(0, int)
    out = np.full(len(weights), np.nan)
    for b, total in enumerate(truths):
        if total <= 0:
            continue
        w = weights[b, owner]
        seen, right = np.cumsum(w)[ends], np.cumsum(w * hit)[ends]
        precision = right / np.maximum(seen, 1e-12)
        envelope = np.maximum.accumulate(precision[::-1])[::-1]
        out[b] = np.sum(np.diff(right, prepend=0.0) * envelope) / total
    return out


@dataclass(frozen=True, slots=True)
class Difference:
    """AP of b minus AP of a, with its paired 95 % interval; `ap_a` and `ap_b` are on all frames."""

    ap_a: float
    ap_b: float
    delta: float
    low: float
    high: float


def compare(
    a: Sequence[Matched], b: Sequence[Matched], groups: Sequence[int] | None = None, draws: int = 1000, seed: int = 0
) -> Difference:
    """Paired percentile bootstrap of AP(b) − AP(a) over frames, or over groups of frames that stand or fall together.

    Args:
        a, b: the same frames, in the same order, under two conditions.
        groups: [frames] a label each (a scene, a fleet-frame); left out, every frame is its own.
        draws, seed: number of resamples and the key of their stream.
    """
    if len(a) != len(b):
        raise ValueError(f"a has {len(a)} frames and b has {len(b)}, must be the same")
    label = np.unique(np.arange(len(a)) if groups is None else np.asarray(groups), return_inverse=True)[1]
    n = int(label.max()) + 1 if len(label) else 0
    rng = stream(seed, 0, (), "ap.bootstrap")
    weights = rng.multinomial(n, np.full(n, 1.0 / n), size=draws)[:, label].astype(np.float64)
    gain = _weighted_ap(b, weights) - _weighted_ap(a, weights)
    low, high = np.nanpercentile(gain, [2.5, 97.5])
    ap_a, ap_b = average_precision(a), average_precision(b)
    return Difference(ap_a, ap_b, ap_b - ap_a, float(low), float(high))
