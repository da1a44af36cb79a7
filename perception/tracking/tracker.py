"""One step of many drones' trackers: predict, assign, correct, begin, confirm, lose. Free of torch.

A track begins as *tentative* with a box that belongs to no other track. It is *confirmed* after `CONFIRM_HITS` boxes in at
most `CONFIRM_LOOKS` looks; a tentative track that cannot reach that any more ends. A confirmed track without a box
*coasts*: it goes on by its velocity. It is *lost* after `COAST_S` without a box, or once its score is below `LEAST_SCORE`.
Ids are not used again. Boxes of a class belong to tracks of that class alone.

The constants were tried on towns 7, 8 and 9 of `track_target` with the surrogate, by HOTA at 2 and 10 looks a second.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sortie.perception.classes import TargetClass
from sortie.perception.motion import Floats, Ints, Tracks, predicted
from sortie.perception.tracking.association import assigned
from sortie.perception.types import Boxes

BOX_VARIANCE_M2 = 0.8**2
"""Variance of a box's place along each axis. It is larger than that of a box alone (`lateness.SIGMA0_M`), because a car's
boxes in a row lean to one side."""
SPEED_VARIANCE = 6.0**2
"""Variance of each component of an unseen car's velocity, m²/s²."""
PLACE_VARIANCE_M2 = np.array([BOX_VARIANCE_M2, BOX_VARIANCE_M2, 1.0**2])
"""By class. A person's is that of the thermal camera's places, whose errors are independent from look to look."""
FIRST_SPEED_VARIANCE = np.array([SPEED_VARIANCE, SPEED_VARIANCE, 1.5**2])
"""By class."""
BEGIN_SCORE = 0.3
"""Boxes below this score begin no track."""
CONFIRM_HITS, CONFIRM_LOOKS = 3, 4
COAST_S = 2.0
LEAST_SCORE = 0.15
SMOOTHING = 0.2
"""Weight of the newest box in size, heading and score, once a track has had more than its inverse."""


def step(tracks: Tracks, boxes: Boxes, owner: Ints, looks_s: Floats, next_id: Ints) -> tuple[Tracks, Ints, Ints]:
    """Take in one look of some drones.

    Args:
        tracks: all drones' tracks; those of drones that do not look stay as they are.
        boxes: what was detected, of all drones that look.
        owner: [boxes] the drone that detected it.
        looks_s: [drones] when each drone looked; NaN if it does not look now.
        next_id: [drones] the number of each drone's next track.

    Returns:
        The tracks, the `next_id` after that, and the id [boxes] of each box's track (tentative or not), −1 for none.
    """
    now_s = looks_s[tracks.owner]
    looking = ~np.isnan(now_s)
    resting, tracks = (Tracks.empty(), tracks) if looking.all() else (tracks.take(~looking), tracks.take(looking))
    ahead = predicted(tracks, now_s[looking])
    place = boxes.xy_m.astype(np.float64)
    mine, theirs = (k + len(TargetClass) * of for k, of in ((ahead.kind, ahead.owner), (boxes.kind, owner)))
    i, j = assigned(ahead.xy_m, ahead.covariance[:, 0] + PLACE_VARIANCE_M2[ahead.kind], mine, place, theirs)
    of_box = np.full(len(boxes), -1, np.int64)
    of_box[j] = ahead.id[i]
    kept = _survivors(_corrected(ahead, boxes, i, j))
    new = np.flatnonzero((of_box < 0) & (boxes.score >= BEGIN_SCORE))
    if not len(new):
        return Tracks.join(resting, kept), next_id, of_box
    begun, after = _begun(boxes.take(new), owner[new], looks_s, next_id)
    of_box[new] = begun.id
    return Tracks.join(resting, kept, begun), after, of_box


def _corrected(ahead: Tracks, boxes: Boxes, i: Ints, j: Ints) -> Tracks:
    """Predicted tracks after a look in which tracks `i` got boxes `j`: the Kalman update, and the smoothing of the rest."""
    xy, velocity, covariance = ahead.xy_m.copy(), ahead.velocity_mps.copy(), ahead.covariance.copy()
    pp, pv, vv = covariance[i].T
    of_box = PLACE_VARIANCE_M2[ahead.kind[i]]
    total = pp + of_box
    off = boxes.xy_m[j] - xy[i]
    xy[i] += (pp / total)[:, None] * off
    velocity[i] += (pv / total)[:, None] * off
    covariance[i] = np.stack([pp * of_box / total, pv * of_box / total, vv - pv * pv / total], axis=1)
    hits, looks, seen_s = ahead.hits.copy(), ahead.looks + 1, ahead.seen_s.copy()
    hits[i] += 1
    seen_s[i] = ahead.t_s[i]
    weight = np.maximum(1.0 / hits[i], SMOOTHING)
    size, yaw, score = ahead.size_m.copy(), ahead.yaw_rad.copy(), np.zeros(len(ahead))
    size[i] += weight[:, None] * (boxes.size_m[j] - size[i])
    turn = boxes.yaw_rad[j] - yaw[i]
    yaw[i] += weight * (turn - np.pi * np.round(turn / np.pi))  # front and back look alike
    score[i] = boxes.score[j]
    score = ahead.score + np.maximum(1.0 / looks, SMOOTHING) * (score - ahead.score)
    confirmed = ahead.confirmed | ((hits >= CONFIRM_HITS) & (looks <= CONFIRM_LOOKS))
    return replace(
        ahead,
        xy_m=xy,
        velocity_mps=velocity,
        covariance=covariance,
        size_m=size,
        yaw_rad=yaw,
        score=score,
        hits=hits,
        looks=looks,
        seen_s=seen_s,
        confirmed=confirmed,
    )


def _survivors(tracks: Tracks) -> Tracks:
    """Without tracks that are lost, and tentative ones that cannot be confirmed any more."""
    missed = tracks.looks - tracks.hits
    lives = (tracks.t_s - tracks.seen_s <= COAST_S + 1e-9) & (tracks.score >= LEAST_SCORE)
    stays = np.where(tracks.confirmed, lives, missed <= CONFIRM_LOOKS - CONFIRM_HITS)
    return tracks if stays.all() else tracks.take(stays)


def _begun(boxes: Boxes, owner: Ints, looks_s: Floats, next_id: Ints) -> tuple[Tracks, Ints]:
    """A tentative track of each box, and the next ids."""
    n = len(boxes)
    count = np.bincount(owner, minlength=len(next_id))
    order = np.argsort(owner, kind="stable")
    rank = np.empty(n, np.int64)
    rank[order] = np.arange(n) - (np.cumsum(count) - count)[owner[order]]
    one = np.ones(n, np.int64)
    table = np.column_stack([PLACE_VARIANCE_M2[boxes.kind], np.zeros(n), FIRST_SPEED_VARIANCE[boxes.kind]])
    at = looks_s[owner]
    xy, size, yaw, score = (v.astype(np.float64) for v in (boxes.xy_m, boxes.size_m, boxes.yaw_rad, boxes.score))
    tentative = np.zeros(n, bool)
    begun = Tracks(
        owner,
        next_id[owner] + rank,
        at,
        xy,
        np.zeros((n, 2)),
        table,
        size,
        yaw,
        score,
        one,
        one,
        at,
        tentative,
        boxes.kind,
    )
    return begun, next_id + count
