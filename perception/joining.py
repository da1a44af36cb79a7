"""The boxes of several drones as one list: by rotated suppression, as is usual, or averaged. Free of torch.

Suppression keeps the best of the boxes that overlap, and all that stand alone: one drone's error of place stays, and
everybody's false alarms add up. The average puts a car where all who see it put it, weighted by how sure they are, and
scores it by what all who looked there say, those who found nothing included (weighted boxes fusion: R. Solovyev, W. Wang,
T. Gabruseva, Image and Vision Computing 107, 2021).
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
OWN_SAY = 2.0
"""The ego's say where others' maps are in its own answer, against 1 of a drone that looked alone. Of 1, 2, 3 and 5, looked at
on the calibration's held-out scenes: 1 and 2 lie within 0.01 of AP of one another, 5 up to 0.05 below."""
SURE = 0.2
"""In late fusion peers send boxes with a score above this."""
Rule = Literal["nms", "average"]
Pose = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Told:
    """What one drone says: its boxes, and where it has looked."""

    boxes: Boxes
    say: float
    """Its weight against the others'."""
    pose: Pose
    """x, y, yaw of its square when it looked, ENU."""
    roi: Disc | None = None
    """Where its boxes were asked for; it says nothing of what lies outside."""
    cut: bool = False
    """Weaker boxes were left out: of what it does not mention it says nothing."""


def told(share: Share, alone: Boxes) -> Told:
    """What a share of boxes says, given what its sender found alone, best first."""
    boxes, cut = alone.inside(share.roi), False
    if share.representation == "tracks":
        cut = len(boxes) > budget.MAX_TRACKS
        boxes = boxes.take(np.arange(min(len(boxes), budget.MAX_TRACKS)))
    return Told(boxes, share.weight, share.capture.est_pose, share.roi, cut)


def sendable(boxes: Boxes) -> Boxes:
    """What of a drone's boxes late fusion sends."""
    return boxes.take(boxes.score > SURE)


class Heard(NamedTuple):
    """What an ego has to join."""

    pose: Pose
    """Its own, by its belief."""
    own: Boxes
    """What it found, best first."""
    fused: bool
    """Whether the maps of others are in that."""
    others: Sequence[Told]


def joined(pose: Pose, own: Boxes, fused: bool, others: Sequence[Told], rule: Rule) -> Boxes:
    """`joined_many` of one ego."""
    return joined_many([Heard(pose, own, fused, others)], rule)[0]


def joined_many(egos: Sequence[Heard], rule: Rule) -> list[Boxes]:
    """Each ego's boxes and the others', in the world, best first, inside the ego's square: what lies outside is not asked of it.

    Args:
        egos: who joins what; one that heard nothing keeps its own as they are.
        rule: `nms`: of boxes that overlap by more than `NMS_IOU` the best stays, and a drone's say only counts as zero or not.
            `average`: those boxes' mean place, size and heading, by say times score, at the mean score of all who looked there.
    """
    out = [ego.own for ego in egos]
    asked = [k for k, ego in enumerate(egos) if ego.others]
    if not asked:
        return out
    told_to = [
        [Told(e.own, OWN_SAY if e.fused else 1.0, e.pose), *(o for o in e.others if o.say > 0.0)]
        for e in (egos[k] for k in asked)
    ]
    every = [t for several in told_to for t in several]
    boxes = Boxes.join([t.boxes for t in every])
    teller = np.repeat(np.arange(len(every)), [len(t.boxes) for t in every])
    first = np.cumsum([0, *map(len, told_to)])  # of each ego's tellers
    ego = np.repeat(np.arange(len(asked)), np.diff(first))[teller]
    here = in_square(boxes.xy_m, np.array([egos[k].pose for k in asked])[ego][:, None])[:, 0]
    boxes, teller, ego = boxes.take(here), teller[here], ego[here]
    rank = boxes.score if rule == "nms" else boxes.score * np.array([t.say for t in every])[teller]
    order = best_first(rank, ego)
    boxes, teller, ego = boxes.take(order), teller[order], ego[order]
    i, j, iou = rivals(boxes.table(), ego)
    i, j = i[iou > NMS_IOU], j[iou > NMS_IOU]
    kept = standing(len(ego), i, j)
    ends = np.searchsorted(ego, np.arange(len(asked) + 1))
    if rule == "nms":
        boxes, ends = boxes.take(kept), np.concatenate([[0], np.cumsum(kept)])[ends]
        for k, a, b in zip(asked, ends, ends[1:], strict=False):
            out[k] = boxes.take(slice(a, b))
        return out
    # a box that goes belongs to the best of those that stay and overlap it
    group = np.where(kept, np.arange(len(ego)), len(ego))
    over = kept[i] & ~kept[j]
    np.minimum.at(group, j[over], i[over])
    group = (np.cumsum(kept) - 1)[group]
    for n, (k, a, b) in enumerate(zip(asked, ends, ends[1:], strict=False)):
        some = slice(a, b)
        if a < b:
            out[k] = _averaged(boxes.take(some), teller[some] - first[n], group[some] - group[a], told_to[n])
        else:
            out[k] = Boxes.empty()
    return out


def _averaged(boxes: Boxes, of: NDArray[np.intp], group: NDArray[np.intp], all_told: Sequence[Told]) -> Boxes:
    """One box a group; `of` [n] who told a box."""
    count = int(group.max()) + 1
    say = np.array([t.say for t in all_told])
    weight = np.maximum(boxes.score, 1e-6).astype(np.float64) * say[of]
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
    said = np.zeros((count, len(all_told)))
    np.maximum.at(said, (group, of), boxes.score)
    heard = np.where(_looked(all_told, xy) | (said > 0.0), say, 0.0)
    score = (heard * said).sum(axis=1) / heard.sum(axis=1)
    order = np.argsort(-score, kind="stable")
    return Boxes(xy, size, yaw, score).single().take(order)


def _looked(all_told: Sequence[Told], xy_m: NDArray[np.floating]) -> NDArray[np.bool_]:
    """[n, told]: whether it says something of a place not to mention it."""
    looked = in_square(xy_m, [t.pose for t in all_told])
    for k, t in enumerate(all_told):
        if t.cut:
            looked[:, k] = False
        elif t.roi is not None:
            x, y, radius = t.roi
            looked[:, k] &= (xy_m[:, 0] - x) ** 2 + (xy_m[:, 1] - y) ** 2 <= radius**2
    return looked
