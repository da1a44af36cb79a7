"""What a drone's own tracks say of other things: how late boxes move, and whether a target is where it is said to be.

Free of torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from sortie.perception.lateness import movement
from sortie.perception.motion import ACCELERATION_DENSITY, Floats, Tracks, grown
from sortie.perception.tracking.association import GATE
from sortie.perception.tracking.tracker import PLACE_VARIANCE_M2
from sortie.perception.types import Boxes

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
    n, ids = len(tracks), tracks.id.tolist()
    if not n:
        return {}
    row, near, cost = {track: k for k, track in enumerate(ids)}, {}, {}
    for target, cue in cues.items():
        near[target], cost[target] = np.empty(n, np.bool_), np.empty(n)
        agree_loop()(
            tracks.kind,
            tracks.confirmed,
            tracks.t_s,
            tracks.seen_s,
            tracks.xy_m,
            tracks.velocity_mps,
            tracks.covariance,
            cue,
            t_s,
            near[target],
            cost[target],
        )
    out = {
        target: track
        for target, track in before.items()
        if target in cues and track in row and near[target][row[track]]
    }
    for target in sorted(cues.keys() - out.keys()):
        cost[target][[row[track] for track in out.values()]] = np.inf
        best = int(cost[target].argmin())
        if cost[target][best] < AGREE:
            out[target] = ids[best]
    return out


@cache
def agree_loop() -> Any:
    """The compiled loop, imported and made ready at its first use: before a flight, whose drones may be real ones."""
    from sortie.perception.tracking.following_loops import agree

    none = Tracks.empty()
    agree(
        none.kind,
        none.confirmed,
        none.t_s,
        none.seen_s,
        none.xy_m,
        none.velocity_mps,
        none.covariance,
        (0.0, 0.0, 0.0, 0.0),
        0.0,
        none.confirmed,
        none.t_s,
    )
    return agree
