"""Average precision of boxes on the ground: suppression, matching to ground truth, and the curve. Free of torch.

AP here is AP@0.5 by rotated bird's-eye IoU: detections of all frames sorted by score together, each matched
greedily to the best *remaining* ground truth of its frame, area under the all-point interpolated curve.
Equal scores form one point of the curve, so neither frame order nor box order among ties matters to it.
The field has other conventions, and they differ by up to 20 points: `CONVENTIONS`.

Everything works on the boxes of many images at once. Suppression and matching are greedy, best score first; both are
settled in rounds that concern all images, and end as the loop over boxes would (each says why).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sortie.perception.classes import PERSON
from sortie.perception.metrics.overlap import (
    Floats,
    Ints,
    Kind,
    close_people,
    corners,
    iou_pairs,
    near_pairs,
    overlapping,
)
from sortie.perception.types import Boxes
from sortie.scenarios.disc import Disc

__all__ = [  # the overlap's two main functions are had from here too
    "CONVENTIONS", "ROTATED", "Convention", "Judged", "Matched", "area", "average_precision", "best_first",
    "corners", "hits", "iou_pairs", "judge", "match", "match_many", "suppress", "suppressed",
]  # fmt: skip

Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Convention:
    """How AP is worked out."""

    overlap: Kind = "rotated"
    """IoU of the boxes as they stand or of their axis-aligned hulls."""
    match: Literal["remaining", "first"] = "remaining"
    """A detection takes the best truth that is left, or only ever the one it overlaps most."""
    sort: Literal["all", "per-frame"] = "all"
    """The curve runs down the scores of all frames, or through one frame after the other."""
    points: Literal["all", "11"] = "all"
    """Area under the interpolated curve, or the mean of its height at recall 0, 0.1 … 1."""


CONVENTIONS = {
    "rotated": Convention(),
    "opencood": Convention(sort="per-frame"),
    "uav3d": Convention(overlap="axis-aligned", match="first", points="11"),
}
"""Ours; OpenCOOD's default, where the order of frames decides; UAV3D's, after PASCAL VOC 2007."""
ROTATED = CONVENTIONS["rotated"]
MATCH_BATCH = 64
"""Frames matched together; memory grows with it."""


@dataclass(frozen=True, slots=True)
class Matched:
    """One frame's detections after matching, best first: `score` [n], `hit` [n] bool, and how many cars there were."""

    score: Floats
    hit: Bools
    truths: int

    def at(self, tau: float) -> Matched:
        """The same without the detections below `tau`: they took nothing from those above."""
        keep = self.score >= tau
        return Matched(self.score[keep], self.hit[keep], self.truths)


def best_first(score: Floats, image: Ints) -> Ints:
    """The order in which boxes of several images are dealt with: image by image, best score first, ties as they come."""
    return np.lexsort((-score, image))


def rivals(boxes: Floats, image: Ints) -> tuple[Ints, Ints, Floats]:
    """Pairs (i, j) of boxes [n, 5] of one image that may overlap, i the better one, and their IoU; boxes best first."""
    i, j = near_pairs(boxes, boxes, image, image)
    better = i < j
    i, j = i[better], j[better]
    return i, j, iou_pairs(boxes[i], boxes[j])


def standing(count: int, i: Ints, j: Ints) -> Bools:
    """Which of so many boxes non-maximum suppression leaves, of rivals that overlap by too much: j goes where i stays.

    In every round a box without a better rival that is still open is settled, kept; its open rivals go. The loop over
    boxes would say the same of both, and the best open box of an image is always settled, so the rounds end.
    """
    keep = np.ones(count, bool)
    while len(i):
        beaten = np.zeros(count, bool)
        beaten[j] = True
        sure = ~beaten[i]
        keep[j[sure]] = False
        left = keep[i] & keep[j] & ~sure
        i, j = i[left], j[left]
    return keep


def suppressed(boxes: Floats, image: Ints, iou: float) -> Bools:
    """Which boxes [n, 5] rotated non-maximum suppression leaves, best first: one that overlaps a kept one by more goes.

    Args:
        boxes, image: in the order of `best_first`.
        iou: the limit.
    """
    i, j, value = rivals(boxes, image)
    clash = value > iou
    return standing(len(boxes), i[clash], j[clash])


def hits(count: int, i: Ints, j: Ints, value: Floats, match: Literal["remaining", "first"] = "remaining") -> Bools:
    """Which detections find a car: best first, each takes the best truth that is left.

    Args:
        count: how many detections there are, in the order of `best_first`.
        i, j, value: pairs of detection and truth that overlap enough, and their IoU; equal ones go to the lower truth.
        match: "first": a detection whose best truth is gone finds nothing.

    Every open detection asks for the best truth that has not refused it, and a truth keeps the best that asked. That
    is deferred acceptance; as all truths prefer alike, by rank, it ends where serving by rank does.
    """
    order = np.lexsort((j, -value, i))
    i, j = i[order], j[order]
    if match == "first":
        top = np.ones(len(i), bool)
        top[1:] = i[1:] != i[:-1]
        i, j = i[top], j[top]
    first = np.searchsorted(i, np.arange(count))
    last = np.searchsorted(i, np.arange(count), side="right")
    holder = np.full(int(j.max()) + 1 if len(j) else 0, count)
    asking = np.flatnonzero(first < last)
    while len(asking):
        wish = j[first[asking]]
        before = holder[wish]
        np.minimum.at(holder, wish, asking)
        lost = np.concatenate([asking, before[before < count]])
        lost = np.unique(lost[holder[j[first[lost]]] != lost])
        first[lost] += 1
        asking = lost[first[lost] < last[lost]]
    out = np.zeros(count, bool)
    out[holder[holder < count]] = True
    return out


def alike(
    found: Boxes, truth: Boxes, image: Ints, cars: Ints, iou: float, overlap: Kind = "rotated"
) -> tuple[Ints, Ints, Floats]:
    """Pairs (i, j) of one image and class that match, and how well: vehicles by their IoU, people by their distance."""
    i, j, value = overlapping(found.table(), truth.table(), image, cars, overlap)
    good = value >= iou
    if not (found.kind.any() or truth.kind.any()):
        return i[good], j[good], value[good]
    good &= (found.kind[i] == truth.kind[j]) & (found.kind[i] != PERSON)
    near = close_people(found.xy_m, found.kind, truth.xy_m, truth.kind, image, cars)
    return tuple(np.concatenate([v[good], w]) for v, w in zip((i, j, value), near, strict=True))  # type: ignore[return-value]


def suppress(boxes: Boxes, iou: float) -> Boxes:
    """Rotated non-maximum suppression of one image: best first, a box that overlaps a kept one by more than `iou` goes."""
    boxes = boxes.take(np.argsort(-boxes.score, kind="stable"))
    return boxes.take(suppressed(boxes.table(), np.zeros(len(boxes), np.int64), iou))


def match(
    found: Boxes,
    truth: Boxes,
    disc: Disc | None = None,
    iou: float = 0.5,
    convention: Convention = ROTATED,
) -> Matched:
    """Match one frame's detections to its ground truth, best score first, each to the best remaining truth.

    With a `disc` only detections and truths centred in it count. Only boxes of one class match.
    """
    found, truth = found.inside(disc), truth.inside(disc)
    found = found.take(np.argsort(-found.score, kind="stable"))
    image, cars = np.zeros(len(found), np.int64), np.zeros(len(truth), np.int64)
    i, j, value = alike(found, truth, image, cars, iou, convention.overlap)
    hit = hits(len(found), i, j, value, convention.match)
    return Matched(found.score.astype(np.float64), hit, len(truth))


def match_many(found: Sequence[Boxes], truth: Sequence[Boxes], iou: float = 0.5) -> list[Matched]:
    """As `match`, frame by frame, of many frames at once."""
    image = np.arange(len(found))
    at, cars_at = np.repeat(image, [len(b) for b in found]), np.repeat(image, [len(c) for c in truth])
    return judge(Boxes.join(found), at, Boxes.join(truth), cars_at, len(found), iou).matched()


@dataclass(frozen=True, slots=True)
class Judged:
    """Detections of many images, and which truths each overlaps enough, so that parts of them are matched for little.

    `order` [n] puts the detections in the order of `best_first`; in that order `score` [n] and `image` [n]. `cars` [m]
    is each truth's image. `i`, `j` and `value` are pairs of detection and truth, and their IoU.
    """

    images: int
    order: Ints
    score: Floats
    image: Ints
    cars: Ints
    i: Ints
    j: Ints
    value: Floats

    def matched(self, own: Bools | None = None, cars: Bools | None = None) -> list[Matched]:
        """Image by image; with masks (`own` in the order of `best_first`) as if there were those boxes alone."""
        i, j, value, score, image, of_cars = self.i, self.j, self.value, self.score, self.image, self.cars
        if own is None or cars is None:
            hit = hits(len(score), i, j, value)
        else:
            both = own[i] & cars[j]
            hit = hits(len(score), i[both], j[both], value[both])[own]
            score, image, of_cars = score[own], image[own], of_cars[cars]
        first = np.searchsorted(image, np.arange(self.images + 1)).tolist()
        truths = np.bincount(of_cars, minlength=self.images).tolist()
        return [Matched(score[a:b], hit[a:b], n) for a, b, n in zip(first[:-1], first[1:], truths, strict=True)]


def judge(found: Boxes, image: Ints, truth: Boxes, cars: Ints, images: int, iou: float = 0.5) -> Judged:
    """Detections and truths of so many images, joined; `image` and `cars` say of which each is, and ascend."""
    order = best_first(found.score, image)
    found = found.take(order)
    cuts = [0, *range(MATCH_BATCH, images, MATCH_BATCH), images]
    parts = []
    first, first_car = np.searchsorted(image, cuts).tolist(), np.searchsorted(cars, cuts).tolist()
    for a, b, c, d in zip(first[:-1], first[1:], first_car[:-1], first_car[1:], strict=True):
        i, j, value = alike(found.take(slice(a, b)), truth.take(slice(c, d)), image[a:b], cars[c:d], iou)
        parts.append((i + a, j + c, value))
    i, j, value = (np.concatenate(v) for v in zip(*parts, strict=True))
    return Judged(images, order, found.score.astype(np.float64), image, cars, i, j, value)


def average_precision(frames: Sequence[Matched], convention: Convention = ROTATED) -> float:
    """AP over the frames; NaN without ground truth. Uses the convention's `sort` and `points`."""
    truths = sum(f.truths for f in frames)
    if truths == 0:
        return float("nan")
    score = np.concatenate([f.score for f in frames])
    hit = np.concatenate([f.hit for f in frames])
    if convention.sort == "all":
        order = np.argsort(-score, kind="stable")
        score, hit = score[order], hit[order]
        del order  # a long sortie has millions of detections
        ends = np.flatnonzero(np.append(score[1:] != score[:-1], True)) if len(score) else np.zeros(0, np.int64)
    else:
        ends = np.arange(len(score))
    del score
    right = np.cumsum(hit)[ends]
    precision = right / (ends + 1.0)
    return float(area(right[None], precision[None], np.array([truths], np.float64), convention.points)[0])


def area(right: Floats, precision: Floats, truths: Floats, points: Literal["all", "11"] = "all") -> Floats:
    """AP [b] of b curves: hits so far [b, n] and precision [b, n] down the scores, truths [b] > 0.

    The curve is interpolated: at each recall the highest precision at that recall or beyond.
    """
    envelope = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
    if points == "all":
        step = np.diff(right, prepend=0.0, axis=1)
        return np.asarray((step * envelope).sum(axis=1) / truths)
    if not right.shape[1]:
        return np.zeros(len(truths))
    out = np.zeros(len(truths))
    for tenth in range(11):
        there = 10.0 * right >= tenth * truths[:, None] - 1e-6
        reached = there.any(axis=1)
        out += np.where(reached, envelope[np.arange(len(out)), there.argmax(axis=1)], 0.0) / 11
    return out
