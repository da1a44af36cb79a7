"""Average precision of boxes on the ground: suppression, matching to ground truth, and the curve. Free of torch.

AP here is AP@0.5 by rotated bird's-eye IoU: detections of all frames sorted by score together, each matched
greedily to the best *remaining* ground truth of its frame, area under the all-point interpolated curve.
The field has other conventions, and they differ by up to 20 points: `CONVENTIONS`.

**Equal scores.** The order in which boxes, truths, frames and egos come never changes AP. (In the convention of OpenCOOD
the order of frames does: that is the convention.)

- Matching goes by pairs: best score first, among equal scores the greatest overlap first. No detection of a group of equal
  scores is better than another, so none chooses before the others. Without equal scores this is each detection's choice of
  the best remaining truth.
- Pairs that are equal in both go by the place and shape of their boxes (`best_pairs`). So does suppression among boxes of
  equal score (`best_first`).
- Equal scores of all frames form one point of the curve: a threshold keeps all of them or none.

Everything works on the boxes of many images at once. Suppression and matching are greedy; both are settled in rounds
that concern all images, and end as the loop over boxes or pairs would (each says why).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

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
    "CONVENTIONS",
    "ROTATED",
    "Convention",
    "Judged",
    "Matched",
    "area",
    "average_precision",
    "best_first",
    "best_pairs",
    "corners",
    "hits",
    "iou_pairs",
    "judge",
    "match",
    "match_many",
    "paired",
    "ranked",
    "ranks",
    "suppress",
    "suppressed",
]

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


def best_first(boxes: Floats, score: NDArray[Any], image: Ints) -> Ints:
    """The order in which boxes [n, 5 or more] of several images are dealt with: image by image, best score first, then by place."""
    order = np.lexsort((-score, image))
    tied = (np.diff(score[order]) == 0) & (np.diff(image[order]) == 0)
    return np.lexsort((*boxes.T[::-1], -score, image)) if tied.any() else order


def ranked(boxes: Boxes) -> Boxes:
    """Boxes of one image in the order of `best_first`, those of one place by class."""
    table = np.column_stack([boxes.table(), boxes.kind])
    return boxes.take(best_first(table, boxes.score, np.zeros(len(boxes), np.int64)))


def ranks(boxes: Floats, score: NDArray[Any], image: Ints) -> Ints:
    """The place of each box [n, 5 or more] in the order of `best_first`."""
    rank = np.empty(len(boxes), np.int64)
    rank[best_first(boxes, score, image)] = np.arange(len(boxes))
    return rank


def rivals(boxes: Floats, rank: Ints, image: Ints) -> tuple[Ints, Ints, Floats]:
    """Pairs (i, j) of boxes [n, 5] of one image that may overlap, i the better one by its `ranks`, and their IoU."""
    i, j = near_pairs(boxes, boxes, image, image)
    better = rank[i] < rank[j]
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


def suppressed(boxes: Floats, rank: Ints, image: Ints, iou: float) -> Bools:
    """Which boxes [n, 5] rotated non-maximum suppression leaves, best first: one that overlaps a kept one by more goes.

    Args:
        boxes, rank, image: of each box, its place among the `ranks`, and its image.
        iou: the limit.
    """
    i, j, value = rivals(boxes, rank, image)
    clash = value > iou
    return standing(len(boxes), i[clash], j[clash])


def best_pairs(found: Floats, score: Floats, truth: Floats, value: Floats) -> Ints:
    """The order in which pairs of detection and truth are matched: best score, then greatest overlap, then by place.

    Args:
        found, score, truth, value: of each of p pairs: its detection [p, 2 or more], its score, its truth [p, 2 or more],
            and how well they match.
    """
    order = np.lexsort((-value, -score))
    tied = (np.diff(score[order]) == 0) & (np.diff(value[order]) == 0)
    return np.lexsort((*truth.T[::-1], *found.T[::-1], -value, -score)) if tied.any() else order


def paired(i: Ints, j: Ints) -> Bools:
    """Which pairs of detection and truth are matched: one after the other, each whose two ends are both still free.

    Args:
        i, j: in the order of `best_pairs`.

    In every round, pairs that come first for their detection and for their truth are taken, and all others of these
    detections and truths go. The loop over pairs would say the same, and the first open pair is always taken, so the
    rounds end.
    """
    taken, left = np.zeros(len(i), bool), np.arange(len(i))
    while len(left):
        of_i, of_j = (np.unique(end[left], return_index=True)[1] for end in (i, j))
        now = left[np.intersect1d(of_i, of_j, assume_unique=True)]
        taken[now] = True
        left = left[~(np.isin(i[left], i[now]) | np.isin(j[left], j[now]))]
    return taken


def hits(count: int, i: Ints, j: Ints, match: Literal["remaining", "first"] = "remaining") -> Bools:
    """Which of so many detections find a truth.

    Args:
        count: how many detections there are.
        i, j: pairs of detection and truth that overlap enough, in the order of `best_pairs`.
        match: "first": a detection whose best truth is gone finds nothing.
    """
    if match == "first":
        top = np.sort(np.unique(i, return_index=True)[1])
        i, j = i[top], j[top]
    out = np.zeros(count, bool)
    out[i[paired(i, j)]] = True
    return out


def alike(
    found: Boxes, truth: Boxes, image: Ints, cars: Ints, iou: float, overlap: Kind = "rotated"
) -> tuple[Ints, Ints]:
    """Pairs (i, j) of one image and class that match, as `best_pairs`: vehicles by their IoU, people by their distance."""
    a, b = found.table(), truth.table()
    i, j, value = overlapping(a, b, image, cars, overlap)
    good = value >= iou
    if found.kind.any() or truth.kind.any():
        good &= (found.kind[i] == truth.kind[j]) & (found.kind[i] != PERSON)
        near = close_people(found.xy_m, found.kind, truth.xy_m, truth.kind, image, cars)
        i, j, value = (np.concatenate([v[good], w]) for v, w in zip((i, j, value), near, strict=True))
    else:
        i, j, value = i[good], j[good], value[good]
    order = best_pairs(a[i], found.score[i], b[j], value)
    return i[order], j[order]


def suppress(boxes: Boxes, iou: float) -> Boxes:
    """Rotated non-maximum suppression of one image: best first, a box that overlaps a kept one by more than `iou` goes."""
    boxes = boxes.take(np.argsort(-boxes.score, kind="stable"))
    table, image = boxes.table(), np.zeros(len(boxes), np.int64)
    rank = ranks(np.column_stack([table, boxes.kind]), boxes.score, image)
    return boxes.take(suppressed(table, rank, image, iou))


def match(
    found: Boxes,
    truth: Boxes,
    disc: Disc | None = None,
    iou: float = 0.5,
    convention: Convention = ROTATED,
) -> Matched:
    """Match one frame's detections to its ground truth, best score first, each to the best remaining truth.

    The result has the detections in the order of `ranked`. With a `disc` only detections and truths centred in it count. Only boxes of one class match.
    """
    found, truth = found.inside(disc), truth.inside(disc)
    found = ranked(found)
    image, cars = np.zeros(len(found), np.int64), np.zeros(len(truth), np.int64)
    hit = hits(len(found), *alike(found, truth, image, cars, iou, convention.overlap), convention.match)
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
    is each truth's image. `i` and `j` are pairs of detection and truth, in each image as `best_pairs`. `match` is the
    convention's.
    """

    images: int
    order: Ints
    score: Floats
    image: Ints
    cars: Ints
    i: Ints
    j: Ints
    match: Literal["remaining", "first"]

    def matched(self, own: Bools | None = None, cars: Bools | None = None) -> list[Matched]:
        """Image by image; with masks (`own` in the order of `best_first`) as if there were those boxes alone."""
        i, j, score, image, of_cars = self.i, self.j, self.score, self.image, self.cars
        if own is None or cars is None:
            hit = hits(len(score), i, j, self.match)
        else:
            both = own[i] & cars[j]
            hit = hits(len(score), i[both], j[both], self.match)[own]
            score, image, of_cars = score[own], image[own], of_cars[cars]
        first = np.searchsorted(image, np.arange(self.images + 1)).tolist()
        truths = np.bincount(of_cars, minlength=self.images).tolist()
        return [Matched(score[a:b], hit[a:b], n) for a, b, n in zip(first[:-1], first[1:], truths, strict=True)]


def judge(
    found: Boxes,
    image: Ints,
    truth: Boxes,
    cars: Ints,
    images: int,
    iou: float = 0.5,
    convention: Convention = ROTATED,
) -> Judged:
    """Detections and truths of so many images, joined; `image` and `cars` say of which each is, and ascend."""
    order = best_first(found.table(), found.score, image)
    found = found.take(order)
    cuts = [0, *range(MATCH_BATCH, images, MATCH_BATCH), images]
    parts = []
    first, first_car = np.searchsorted(image, cuts).tolist(), np.searchsorted(cars, cuts).tolist()
    for a, b, c, d in zip(first[:-1], first[1:], first_car[:-1], first_car[1:], strict=True):
        i, j = alike(found.take(slice(a, b)), truth.take(slice(c, d)), image[a:b], cars[c:d], iou, convention.overlap)
        parts.append((i + a, j + c))
    i, j = (np.concatenate(v) for v in zip(*parts, strict=True))
    return Judged(images, order, found.score.astype(np.float64), image, cars, i, j, convention.match)


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
