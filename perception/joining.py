"""Join the boxes of several drones into one list: by rotated suppression, as is usual, or by averaging. Free of torch.

Suppression keeps the best of the boxes that overlap, and every box that stands alone. One drone's localisation error
stays, and the false positives of all drones add up. Averaging puts a car at the mean of all boxes for it, weighted by
score. Its score is the mean over all drones that looked there, also those that saw nothing (weighted boxes fusion: R.
Solovyev, W. Wang, T. Gabruseva, Image and Vision Computing 107, 2021).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sortie.perception import budget
from sortie.perception.geometry import in_square
from sortie.perception.metrics.ap import best_first, rivals, standing
from sortie.perception.types import Boxes, Share
from sortie.scenarios.disc import Disc

NMS_IOU = 0.15
"""Boxes that overlap by more are of one car."""
OWN_WEIGHT = 2.0
"""Weight of an ego's boxes that come from fused maps; a drone that looked alone weighs 1. Of 1, 2, 3 and 5, tried on the
calibration's held-out scenes, 1 and 2 lie within 0.01 of AP of each other and 5 up to 0.05 below."""
LATE_MIN_SCORE = 0.2
"""In late fusion peers send boxes with a score above this."""
Rule = Literal["nms", "average"]
Pose = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class SourceBoxes:
    """The boxes of one drone, and where it looked for them."""

    boxes: Boxes
    weight: float
    """Its weight against the others'."""
    pose: Pose
    """x, y, yaw of its square when it looked, ENU."""
    roi: Disc | None = None
    """Where its boxes were requested; outside it a missing box means nothing."""
    truncated: bool = False
    """Weaker boxes were left out, so a missing box means nothing anywhere."""


def source_of(share: Share, alone: Boxes) -> SourceBoxes:
    """The boxes in a share, given the sender's own boxes `alone`, best first."""
    boxes, truncated = alone.inside(share.roi), False
    if share.representation == "tracks":
        truncated = len(boxes) > budget.MAX_TRACKS
        boxes = boxes.take(np.arange(min(len(boxes), budget.MAX_TRACKS)))
    return SourceBoxes(boxes, share.weight, share.capture.est_pose, share.roi, truncated)


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


def joined(pose: Pose, own: Boxes, fused: bool, others: Sequence[SourceBoxes], rule: Rule) -> Boxes:
    """`joined_many` for one ego."""
    return joined_many([EgoSources(pose, own, fused, others)], rule)[0]


def joined_many(egos: Sequence[EgoSources], rule: Rule) -> list[Boxes]:
    """Each ego's boxes joined with its peers', in the world, best first; boxes outside the ego's square are dropped.

    Args:
        egos: one without peers' boxes keeps its own as they are.
        rule: `nms`: of boxes that overlap by more than `NMS_IOU` the best stays; a weight only counts as zero or not.
            `average`: the mean place, size and heading of those boxes, by weight times score. The score is the mean over
            all drones that looked there.
    """
    out = [ego.own for ego in egos]
    receivers = [k for k, ego in enumerate(egos) if ego.others]
    if not receivers:
        return out
    sources_of = [
        [SourceBoxes(e.own, OWN_WEIGHT if e.fused else 1.0, e.pose), *(o for o in e.others if o.weight > 0.0)]
        for e in (egos[k] for k in receivers)
    ]
    every = [s for sources in sources_of for s in sources]
    boxes = Boxes.join([s.boxes for s in every])
    source = np.repeat(np.arange(len(every)), [len(s.boxes) for s in every])
    first = np.cumsum([0, *map(len, sources_of)])  # of each ego's sources
    ego = np.repeat(np.arange(len(receivers)), np.diff(first))[source]
    here = in_square(boxes.xy_m, np.array([egos[k].pose for k in receivers])[ego][:, None])[:, 0]
    boxes, source, ego = boxes.take(here), source[here], ego[here]
    rank = boxes.score if rule == "nms" else boxes.score * np.array([s.weight for s in every])[source]
    order = best_first(rank, ego)
    boxes, source, ego = boxes.take(order), source[order], ego[order]
    i, j, iou = rivals(boxes.table(), ego)
    i, j = i[iou > NMS_IOU], j[iou > NMS_IOU]
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
            out[k] = _averaged(boxes.take(some), source[some] - first[n], group[some] - group[a], sources_of[n])
        else:
            out[k] = Boxes.empty()
    return out


def _averaged(boxes: Boxes, source: NDArray[np.intp], group: NDArray[np.intp], sources: Sequence[SourceBoxes]) -> Boxes:
    """One box per group; `source` [n] is the index of each box's drone in `sources`."""
    count = int(group.max()) + 1
    weights = np.array([s.weight for s in sources])
    weight = np.maximum(boxes.score, 1e-6).astype(np.float64) * weights[source]
    total = np.bincount(group, weight, count)

    def mean(values: NDArray[np.floating]) -> NDArray[np.float64]:
        return np.bincount(group, weight * values, count) / total

    xy = np.stack([mean(v) for v in boxes.xy_m.T], axis=1)
    size = np.stack([mean(v) for v in boxes.size_m.T], axis=1)
    # front and back look alike: headings are averaged as axes, and point where the best box does
    twice = 2.0 * boxes.yaw_rad.astype(np.float64)
    yaw = np.arctan2(mean(np.sin(twice)), mean(np.cos(twice))) / 2.0
    first = np.unique(group, return_index=True)[1]
    yaw = np.where(np.cos(yaw - boxes.yaw_rad[first]) < 0.0, yaw + np.pi, yaw)
    best = np.zeros((count, len(sources)))
    np.maximum.at(best, (group, source), boxes.score)
    counted = np.where(_looked(sources, xy) | (best > 0.0), weights, 0.0)
    score = (counted * best).sum(axis=1) / counted.sum(axis=1)
    order = np.argsort(-score, kind="stable")
    return Boxes(xy, size, yaw, score).single().take(order)


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
