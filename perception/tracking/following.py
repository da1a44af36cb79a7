"""What a drone's own tracks say of other things: how late boxes move, and whether a target is where it is said to be.

Free of torch.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sortie.perception.classes import PERSON
from sortie.perception.lateness import movement
from sortie.perception.motion import ACCELERATION_DENSITY, Floats, Tracks, grown
from sortie.perception.tracking.association import GATE
from sortie.perception.tracking.tracker import COAST_S, PLACE_VARIANCE_M2
from sortie.perception.types import Boxes

CUE_VARIANCE_M2, CUE_SPEED_VARIANCE = 1.0**2, 1.0**2
"""Of a cue's place and velocity along each axis."""
AGREE = 13.28
"""Squared Mahalanobis distance of place and velocity within which a track begins to be the target: 99 % (χ², four
degrees)."""

Cue = tuple[float, float, float, float]
"""Where a target is believed to be, and its velocity: x, y, vx, vy, ENU."""


def boxes_of(tracks: Tracks) -> Boxes:
    """Tracks as boxes, each at its own time."""
    return Boxes(tracks.xy_m, tracks.size_m, tracks.yaw_rad, tracks.score, kind=tracks.kind).single()


def motion_of(tracks: Tracks, age_s: float) -> tuple[Floats, Floats]:
    """Velocity [n, 2] with which tracks move on, and their variance of position [n] when they are older by `age_s`.

    A track whose speed is not significant stands: it moves by nothing, and its position gets no less certain. One that
    moves is as certain as a fresh box was when it was last seen.
    """
    return _going_on(tracks, age_s + tracks.t_s - tracks.seen_s)


def motion_of_boxes(boxes: Boxes, t_s: float, age_s: float, tracks: Tracks) -> tuple[Floats, Floats]:
    """The same of boxes detected at `t_s`, by the nearest confirmed track of their class of the drone that received them.

    Near is by Mahalanobis distance, within `GATE`, at the time of the box. NaN where there is no track.
    """
    dt = t_s - tracks.t_s
    spread = grown(tracks.covariance, dt)[:, 0] + PLACE_VARIANCE_M2[tracks.kind]
    off_x, off_y = (boxes.xy_m[:, k, None] - (tracks.xy_m[:, k] + dt * tracks.velocity_mps[:, k]) for k in (0, 1))
    its = tracks.confirmed & (tracks.kind == boxes.kind[:, None])
    cost = np.where(its, (off_x * off_x + off_y * off_y) / spread, np.inf)
    if not cost.size:
        return np.full((len(boxes), 2), np.nan), np.full(len(boxes), np.nan)
    best = cost.argmin(axis=1)
    near = cost[np.arange(len(boxes)), best] < GATE
    velocity, variance = _going_on(tracks, np.full(len(tracks), age_s))
    return np.where(near[:, None], velocity[best], np.nan), np.where(near, variance[best], np.nan)


def _going_on(tracks: Tracks, late_s: Floats) -> tuple[Floats, Floats]:
    """Velocity [n, 2], and the variance of position [n] of what was certain for the last time `late_s` ago."""
    moves = tracks.moves
    spread = tracks.covariance[:, 2] * late_s**2 + ACCELERATION_DENSITY * late_s**3 / 3.0
    fresh_m2 = movement(tracks.kind).sigma0_m2
    return np.where(moves[:, None], tracks.velocity_mps, 0.0), fresh_m2 + np.where(moves, spread, 0.0)


def followed(tracks: Tracks, cues: Mapping[int, Cue], before: Mapping[int, int], t_s: float) -> dict[int, int]:
    """Which targets a drone follows: by target, the id of the confirmed track that is it.

    A track becomes a target's when its place and velocity agree with the cue, one track to each target at most. It stays
    the target's while it lives, had a box within `COAST_S`, and its place agrees.

    Args:
        tracks: all tracks of the drone.
        cues: where each target is believed to be at `t_s`.
        before: what was followed until now, as returned.
        t_s: now.
    """
    its = np.flatnonzero((tracks.kind != PERSON) & tracks.confirmed & (t_s - tracks.seen_s <= COAST_S))
    ids, velocity_mps, dt = tracks.id[its].tolist(), tracks.velocity_mps[its], t_s - tracks.t_s[its]
    xy_m, row = tracks.xy_m[its] + dt[:, None] * velocity_mps, {track: k for k, track in enumerate(ids)}
    spread = grown(tracks.covariance[its], dt) + np.array((CUE_VARIANCE_M2, 0.0, CUE_SPEED_VARIANCE))
    out: dict[int, int] = {}
    for target, track in before.items():
        k = row.get(track)
        if target in cues and k is not None:
            x_m, y_m = (xy_m[k] - cues[target][:2]).tolist()
            if x_m * x_m + y_m * y_m < GATE * spread[k, 0]:
                out[target] = track
    for target in sorted(cues.keys() - out.keys()):
        cost = _disagreement(xy_m, velocity_mps, spread, cues[target])
        cost[[row[track] for track in out.values()]] = np.inf
        best = int(cost.argmin()) if len(cost) else -1
        if best >= 0 and cost[best] < AGREE:
            out[target] = ids[best]
    return out


def _disagreement(xy_m: Floats, velocity_mps: Floats, spread: Floats, cue: Cue) -> Floats:
    """Squared Mahalanobis distance [n] in place and velocity; `spread` [n, 3] is the covariance of the difference."""
    off, faster = xy_m - cue[:2], velocity_mps - cue[2:]
    pp, pv, vv = spread.T
    cost = vv * (off * off).sum(axis=1) - 2.0 * pv * (off * faster).sum(axis=1) + pp * (faster * faster).sum(axis=1)
    return np.asarray(cost / (pp * vv - pv * pv))
