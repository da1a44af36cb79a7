"""The boxes of several drones as one list: by rotated suppression, as is usual, or averaged. Free of torch.

Suppression keeps the best of the boxes that overlap, and all that stand alone: one drone's error of place stays, and
everybody's false alarms add up. The average puts a car where all who see it put it, weighted by how sure they are, and
scores it by what all who looked there say, those who found nothing included (weighted boxes fusion: R. Solovyev, W. Wang,
T. Gabruseva, Image and Vision Computing 107, 2021).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from perception import budget
from perception.ap import suppressed
from perception.geometry import in_square
from perception.overlap import overlapping
from perception.types import Boxes, Share

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
    roi: tuple[float, float, float] | None = None
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


def joined(pose: Pose, own: Boxes, fused: bool, others: Sequence[Told], rule: Rule) -> Boxes:
    """The ego's boxes and the others', in the world, best first, inside the ego's square: what lies outside is not asked of it.

    Args:
        pose: the ego's, by its own belief.
        own: what it found, with the maps of others in it or without (`fused`).
        rule: `nms`: of boxes that overlap by more than `NMS_IOU` the best stays, and a drone's say only counts as zero or not.
            `average`: those boxes' mean place, size and heading, by say times score, at the mean score of all who looked there.
    """
    if not others:
        return own
    all_told = [Told(own, OWN_SAY if fused else 1.0, pose), *(o for o in others if o.say > 0.0)]
    boxes = Boxes.join([t.boxes for t in all_told])
    of = np.repeat(np.arange(len(all_told)), [len(t.boxes) for t in all_told])
    here = in_square(boxes.xy_m, [pose])[:, 0]
    boxes, of = boxes.take(here), of[here]
    rank = boxes.score if rule == "nms" else boxes.score * np.array([t.say for t in all_told])[of]
    order = np.argsort(-rank, kind="stable")
    boxes, of = boxes.take(order), of[order]
    table, one = boxes.table(), np.zeros(len(order), np.int64)
    kept = suppressed(table, one, NMS_IOU)
    if rule == "nms" or not len(order):
        return boxes.take(kept)
    # a box that goes belongs to the best of those that stay and overlap it
    group = np.where(kept, np.arange(len(order)), len(order))
    i, j, iou = overlapping(table, table, one, one)
    over = (iou > NMS_IOU) & (i < j) & kept[i] & ~kept[j]
    np.minimum.at(group, j[over], i[over])
    return _averaged(boxes, of, (np.cumsum(kept) - 1)[group], all_told)


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
    return Boxes(*(v.astype(np.float32)[order] for v in (xy, size, yaw, score)))


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
