"""Join the boxes of several drones into one list: by rotated suppression, as is usual, or by averaging. Free of torch.

Suppression keeps the best of the boxes that overlap, and every box that stands alone. One drone's localisation error
stays, and the false positives of all drones add up. Averaging puts a car at the mean of all boxes for it, weighted by
score. Its score is the mean over all drones that looked there, also those that saw nothing (weighted boxes fusion: R.
Solovyev, W. Wang, T. Gabruseva, Image and Vision Computing 107, 2021).

Boxes with uncertainty are joined by covariance intersection, whichever rule is chosen (`sortie.perception.intersection`):
a car's place follows from the places and covariances of its boxes, all else as in averaging. A covariance grows with the
age of its box, by what cars may have moved.

Boxes of one class are joined, never those of two. Boxes of people are one person's where they lie within `NEAR_M` and come
from different drones.

Weight and age count under both rules. A peer's score is multiplied by its weight, and by the chance that a box of its age
still covers its car (`sortie.perception.lateness`). In a mean, a place counts by the inverse of its variance as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sortie.perception import budget
from sortie.perception.classes import PERSON
from sortie.perception.errors import InputError
from sortie.perception.geometry import in_square
from sortie.perception.intersection import intersect, inverse
from sortie.perception.lateness import (
    movement,
    moving_m2,
    own_age_s,
    reach_of,
    stands,
    still_right,
    still_right_of,
    variance_m2,
    within,
)
from sortie.perception.metrics.ap import ranks, rivals, standing
from sortie.perception.metrics.overlap import close_people
from sortie.perception.tracking.following import boxes_of, motion_of, motion_of_boxes
from sortie.perception.types import Boxes, Capture, Share
from sortie.perception.uncertainty import BoxErrors
from sortie.scenarios.disc import Disc

NMS_IOU = 0.15
"""Boxes that overlap by more are of one car."""
OWN_WEIGHT = 2.0
"""Weight of an ego's boxes that come from fused maps; a drone that looked alone weighs 1. Of 1, 2, 3 and 5, tried on the
calibration's held-out scenes, 1 and 2 lie within 0.01 of AP of each other and 5 up to 0.05 below. Suppression does not use it."""
LATE_MIN_SCORE = 0.2
"""In late fusion peers send boxes with a score above this."""
Rule = Literal["nms", "average"]
Pose = tuple[float, float, float]
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SourceBoxes:
    """The boxes of one drone, and where it looked for them."""

    boxes: Boxes
    """Places as they were at the capture."""
    weight: float
    """Its weight against the others': the directive's fusion weight × the receiver's trust."""
    pose: Pose
    """x, y, yaw of its square when it looked, ENU."""
    roi: Disc | None = None
    """Where its boxes were requested; outside it a missing box means nothing."""
    truncated: bool = False
    """Weaker boxes were left out, so a missing box means nothing anywhere."""
    age_s: float = 0.0
    """From the capture to the fusion."""
    velocity_mps: NDArray[np.floating] | None = None
    """[n, 2] velocity of each box, ENU: it is moved by velocity × age before it is joined. NaN or None: it stays."""
    variance_m2: NDArray[np.floating] | None = None
    """[n] variance of each place along each axis at the fusion, after that move. NaN or None: by the age."""
    covariance_m2: NDArray[np.floating] | None = None
    """[n, 3] covariance of each place at the capture, as it was sent: east, east–north, north. None: boxes without one."""


def source_of(share: Share, alone: Boxes | None, errors: BoxErrors | None = None) -> SourceBoxes:
    """The boxes in a share, and how they move: tracks by their own velocity, boxes by that of the receiver's tracks of them.

    Args:
        alone: the sender's own boxes, best first; None where the share brings its own (`Share.is_detected`).
        errors: how uncertain the detector's boxes are; those of a share that brings its own boxes go first.

    Raises:
        InputError: boxes with uncertainty from a detector of which nobody knows how uncertain they are.
    """
    where = share.weight, share.capture.est_pose, share.roi
    tracks, age_s = share.tracks, share.age_s
    if alone is None:
        alone = share.boxes
    if alone is None:
        assert tracks is not None  # noqa: S101 (what `is_detected` says)
        cut = share.cut or len(tracks) >= budget.MAX_TRACKS
        return SourceBoxes(boxes_of(tracks), *where, cut, age_s, *motion_of(tracks, age_s))
    boxes, truncated = alone.inside(share.roi), False
    if share.representation == "tracks":
        truncated = len(boxes) > budget.MAX_TRACKS
        boxes = boxes.take(np.arange(min(len(boxes), budget.MAX_TRACKS)))
    velocity, variance = (None, None) if tracks is None else motion_of_boxes(boxes, share.capture.t_s, age_s, tracks)
    covariance = None
    if share.representation == "uncertain_boxes":
        errors = share.errors or errors
        if errors is None:
            raise InputError("this detector does not tell how uncertain its boxes are: let policies send detections")
        covariance = errors.covariances_m2(boxes.xy_m, boxes.score, share.capture.est_pose)
    return SourceBoxes(boxes, *where, truncated, age_s, velocity, variance, covariance)


def sendable(boxes: Boxes) -> Boxes:
    """Those of a drone's boxes that it sends in late fusion."""
    return boxes.take(boxes.score > LATE_MIN_SCORE)


class EgoSources(NamedTuple):
    """The boxes that one ego joins."""

    pose: Pose
    """The ego's own, as it believes."""
    own: Boxes
    """Its own boxes, best first."""
    fused: bool
    """Whether peers' maps were fused into those."""
    others: Sequence[SourceBoxes]
    age_s: float = 0.0
    """From its own capture to the fusion; of a drone without a look, the age of the freshest map that was fused for it."""
    looked: bool = True
    """False: a drone without a look of its own. Its silence means nothing."""
    errors: BoxErrors | None = None
    """How uncertain its own boxes are, where it joins them with covariances."""

    @classmethod
    def of(
        cls,
        ego: Capture,
        shares: Sequence[Share],
        own: Boxes,
        fused: bool,
        others: Sequence[SourceBoxes],
    ) -> EgoSources:
        """For a detector's job; `others` are the boxes of shares that are not fused as maps, and of maps on other grids."""
        maps_s = [s.age_s for s in shares if s.is_map and s.weight > 0.0]
        age_s = own_age_s(ego, shares) if ego.looked else min(maps_s, default=0.0)
        return cls(ego.est_pose, own, fused, others, age_s, ego.looked or fused)

    def sources(self) -> list[SourceBoxes]:
        """Its own boxes, if it has any, and those of the peers that count."""
        weight = OWN_WEIGHT if self.fused else 1.0
        known = None if self.errors is None else self.errors.covariances_m2(self.own.xy_m, self.own.score, self.pose)
        own = [SourceBoxes(self.own, weight, self.pose, age_s=self.age_s, covariance_m2=known)] if self.looked else []
        return own + [o for o in self.others if o.weight > 0.0]

    @property
    def freshest_s(self) -> float:
        """What ages are compared with: the youngest look at hand; 0 for a drone that has none of its own."""
        return min([self.age_s, *(o.age_s for o in self.others if o.weight > 0.0)]) if self.looked else 0.0


def joined(pose: Pose, own: Boxes, fused: bool, others: Sequence[SourceBoxes], rule: Rule) -> Boxes:
    """`joined_many` for one ego."""
    return joined_many([EgoSources(pose, own, fused, others)], rule)[0]


def joined_many(egos: Sequence[EgoSources], rule: Rule) -> list[Boxes]:
    """Each ego's boxes joined with its peers', in the world, best first; boxes outside the ego's square are dropped.

    Args:
        egos: one without peers' boxes keeps its own as they are.
        rule: `nms`: of boxes that overlap by more than `NMS_IOU` the best stays, after scores are multiplied by weight and
            by what their age leaves of them. `average`: the mean place, size and heading of those boxes, by weight, score
            and precision. The score is the mean over all drones that looked there, and no more than weight and age leave.
    """
    exact = [any(s.covariance_m2 is not None for s in ego.others) for ego in egos]
    if not any(exact):
        return _joined_many(egos, rule)
    out = [Boxes.empty()] * len(egos)
    for which, its_rule in ((False, rule), (True, "average")):
        at = [k for k, is_exact in enumerate(exact) if is_exact == which]
        several = _joined_many([egos[k] for k in at], its_rule, exact=which)
        for k, boxes in zip(at, several, strict=True):
            out[k] = boxes
    return out


def _joined_many(egos: Sequence[EgoSources], rule: Rule, *, exact: bool = False) -> list[Boxes]:
    """`joined_many` of egos all of which join by covariances (`exact`), or none."""
    out = [ego.own for ego in egos]
    receivers = [k for k, ego in enumerate(egos) if ego.others]
    if not receivers:
        return out
    sources_of = [egos[k].sources() for k in receivers]
    every = [s for sources in sources_of for s in sources]
    if not every:
        return out
    counts = [len(s.boxes) for s in every]
    boxes = Boxes.join([boxes_at_fusion(s) for s in every])
    source = np.repeat(np.arange(len(every)), counts)
    first = np.cumsum([0, *map(len, sources_of)])  # of each ego's sources
    ego_of = np.repeat(np.arange(len(receivers)), np.diff(first))  # of each source
    freshest_s = np.array([egos[k].freshest_s for k in receivers])[ego_of]
    known = np.concatenate([_given(s.variance_m2, len(s.boxes)) for s in every])
    ego = ego_of[source]
    here = in_square(boxes.xy_m, np.array([egos[k].pose for k in receivers])[ego][:, None])[:, 0]
    boxes, source, ego, known = boxes.take(here), source[here], ego[here], known[here]
    left = _left(boxes, np.array([s.age_s for s in every])[source], freshest_s[source], known)
    covariance = np.concatenate([_covariances(s) for s in every])[here] if exact else None
    weight = np.array([s.weight for s in every])[source]
    if rule == "nms":
        score = (boxes.score * (np.minimum(weight, 1.0) * left)).astype(np.float32)
        boxes = replace(boxes, score=score)
        order = np.lexsort((-score, ego))
    else:
        score = boxes.score * weight * left
        order = np.lexsort((-score, ego))
    boxes, source, ego, left, known = boxes.take(order), source[order], ego[order], left[order], known[order]
    covariance = None if covariance is None else covariance[order]
    i, j = _of_one_thing(boxes, score[order], source, ego)
    kept = standing(len(ego), i, j)
    ends = np.searchsorted(ego, np.arange(len(receivers) + 1))
    if rule == "nms":
        boxes, ends = boxes.take(kept), np.concatenate([[0], np.cumsum(kept)])[ends]
        for k, a, b in zip(receivers, ends, ends[1:], strict=False):
            out[k] = boxes.take(slice(a, b))
        return out
    # a box that is dropped belongs to the best of those that stay and overlap it
    group = np.where(kept, np.arange(len(ego)), len(ego))
    over = kept[i] & ~kept[j]
    np.minimum.at(group, j[over], i[over])
    group = (np.cumsum(kept) - 1)[group]
    for n, (k, a, b) in enumerate(zip(receivers, ends, ends[1:], strict=False)):
        some = slice(a, b)
        if a < b:
            information, shared = None, 1.0
            if covariance is not None:
                information = weight[order][some, None] * inverse(covariance[some])
                fitted = egos[k].errors
                shared = 1.0 if fitted is None else fitted.common
            members = _Members(
                group[some] - group[a], source[some] - first[n], left[some], known[some], information, shared
            )
            out[k] = _averaged(boxes.take(some), members, sources_of[n], float(freshest_s[first[n]]))
        else:
            out[k] = Boxes.empty()
    return out


def _of_one_thing(
    boxes: Boxes, score: NDArray[np.floating], source: NDArray[np.intp], ego: NDArray[np.intp]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Pairs (i, j) of one ego's boxes of one class that are taken to be of one thing, i the better one by `score`."""
    table = boxes.table()
    rank = ranks(table, score, ego)
    i, j, iou = rivals(table, rank, ego)
    i, j = i[iou > NMS_IOU], j[iou > NMS_IOU]
    kind = boxes.kind
    if not kind.any():
        return i, j
    same = (kind[i] == kind[j]) & (kind[i] != PERSON)
    a, b, _ = close_people(boxes.xy_m, kind, boxes.xy_m, kind, ego, ego)
    near = (rank[a] < rank[b]) & (source[a] != source[b])
    return np.concatenate([i[same], a[near]]), np.concatenate([j[same], b[near]])


def boxes_at_fusion(source: SourceBoxes) -> Boxes:
    """The boxes of a source where they are at the fusion, as far as their velocities are known."""
    boxes, velocity = source.boxes, source.velocity_mps
    if velocity is None:
        return boxes
    xy = boxes.xy_m + np.nan_to_num(velocity) * source.age_s
    return replace(boxes, xy_m=xy.astype(np.float32))


def _given(values: NDArray[np.floating] | None, count: int) -> Floats:
    return np.full(count, np.nan) if values is None else np.asarray(values, np.float64)


def _covariances(source: SourceBoxes) -> Floats:
    """[n, 3] the covariance of each place of a source at the fusion.

    What was sent grows by what may have moved since. Boxes without a covariance have the usual one of their class.
    """
    boxes = source.boxes
    of = movement(boxes.kind)
    known = _given(source.variance_m2, len(boxes))
    now = np.where(np.isnan(known), variance_m2(source.age_s, of), known)
    if source.covariance_m2 is None:
        return np.stack([now, np.zeros_like(now), now], axis=1)
    grown = np.maximum(now - of.sigma0_m2, 0.0)
    sent = np.asarray(source.covariance_m2, np.float64)
    return np.asarray(sent + np.stack([grown, np.zeros_like(grown), grown], axis=1))


def _left(boxes: Boxes, age_s: Floats, freshest_s: Floats, known_m2: Floats) -> Floats:
    """What lateness leaves of each box's score, [n]: 1 for the freshest.

    Args:
        known_m2: [n] the variance of a place where it is known, else NaN.
    """
    reach, of = reach_of(boxes), movement(boxes.kind)
    chance = np.where(np.isnan(known_m2), still_right(reach, age_s, of), still_right_of(reach, known_m2, of))
    return np.asarray(np.minimum(chance / still_right(reach, freshest_s, of), 1.0))


class _Members(NamedTuple):
    """For each box of one ego, [n]."""

    group: NDArray[np.intp]
    """Boxes of one car have one number, from 0 on without gaps."""
    source: NDArray[np.intp]
    """Its source's index."""
    left: Floats
    """What lateness leaves of its score."""
    known_m2: Floats
    """The variance of its place where it is known, else NaN."""
    information: Floats | None = None
    """[n, 3] inverse covariance of its place, times its source's weight; None joins places by score and age."""
    common: float = 1.0
    """The share of a variance that several sources may have in common."""

    def precisions(self, boxes: Boxes, age_s: Floats, freshest_s: float) -> tuple[Floats, Floats]:
        """What each place counts in a mean, and each score in a vote, [n] each.

        A late box close to the freshest of its car tells that the car stands, and then it counts in full.
        """
        anchor = np.lexsort((-boxes.score, age_s, self.group))
        anchor = anchor[np.unique(self.group[anchor], return_index=True)[1]][self.group]
        off_m = np.hypot(*(boxes.xy_m - boxes.xy_m[anchor]).T.astype(np.float64))
        of, reach = movement(boxes.kind), reach_of(boxes)
        still = stands(off_m, age_s - age_s[anchor], of)
        fresh_m2, late_m2 = moving_m2(freshest_s, of), moving_m2(age_s, of)
        precise = still + (1.0 - still) * np.minimum(fresh_m2 / late_m2, 1.0)
        left = still + (1.0 - still) * np.minimum(within(reach, late_m2) / within(reach, fresh_m2), 1.0)
        is_anchor = anchor == np.arange(len(anchor))
        given = ~np.isnan(self.known_m2)
        precise = np.where(given, np.minimum(variance_m2(freshest_s, of) / self.known_m2, 1.0), precise)
        return precise, np.where(given | is_anchor, self.left, left)


def _averaged(boxes: Boxes, of: _Members, sources: Sequence[SourceBoxes], freshest_s: float) -> Boxes:
    """One box per group."""
    group, source = of.group, of.source
    count = int(group.max()) + 1
    weights, ages_s = np.array([s.weight for s in sources]), np.array([s.age_s for s in sources])
    precise, left = of.precisions(boxes, ages_s[source], freshest_s)
    weight = np.maximum(boxes.score, 1e-6).astype(np.float64) * weights[source] * precise
    total = np.bincount(group, weight, count)

    def mean(values: NDArray[np.floating]) -> NDArray[np.float64]:
        return np.bincount(group, weight * values, count) / total

    if of.information is None:
        xy = np.stack([mean(v) for v in boxes.xy_m.T], axis=1)
    else:
        centre = boxes.xy_m[0].astype(np.float64)  # relative to one of them: places are far from the origin
        xy = intersect(boxes.xy_m - centre, of.information, group, of.common).xy_m + centre
    size = np.stack([mean(v) for v in boxes.size_m.T], axis=1)
    # front and back look alike: headings are averaged as axes, and point where the best box does
    twice = 2.0 * boxes.yaw_rad.astype(np.float64)
    yaw = np.arctan2(mean(np.sin(twice)), mean(np.cos(twice))) / 2.0
    first = np.unique(group, return_index=True)[1]
    yaw = np.where(np.cos(yaw - boxes.yaw_rad[first]) < 0.0, yaw + np.pi, yaw)
    joined = Boxes(xy, size, yaw, np.zeros(count), kind=boxes.kind[first])
    best, votes = np.zeros((2, count, len(sources)))
    np.maximum.at(best, (group, source), boxes.score)
    np.maximum.at(votes, (group, source), left)
    # that a late drone saw nothing says as little as its boxes do
    reach, moves = reach_of(joined)[:, None], movement(joined.kind[:, None])
    silent = np.minimum(still_right(reach, ages_s, moves) / still_right(reach, freshest_s, moves), 1.0)
    votes = weights * np.where(best > 0.0, votes, np.where(_looked(sources, xy), silent, 0.0))
    # less than one whole vote is not made up to one: a single late box has the score that its age leaves
    score = (votes * best).sum(axis=1) / np.maximum(votes.sum(axis=1), 1.0)
    order = np.argsort(-score, kind="stable")
    return replace(joined, score=score).single().take(order)


def _looked(sources: Sequence[SourceBoxes], xy_m: NDArray[np.floating]) -> NDArray[np.bool_]:
    """[n, sources] bool: whether a drone without a box at a place has looked there and seen nothing."""
    looked = in_square(xy_m, [s.pose for s in sources])
    for k, s in enumerate(sources):
        if s.truncated:
            looked[:, k] = False
        elif s.roi is not None:
            x, y, radius = s.roi
            looked[:, k] &= (xy_m[:, 0] - x) ** 2 + (xy_m[:, 1] - y) ** 2 <= radius**2
    return looked
