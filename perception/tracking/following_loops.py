"""The compiled loop over a drone's tracks (`sortie.perception.tracking.following`); it rounds as numpy does."""

from __future__ import annotations

from functools import partial
from math import inf

from sortie.scenarios.compiled import compiled

# constants of the file itself: kept machine code does not see that another file has changed; the last two are variances of a
# cue's place and velocity along each axis
PERSON, COAST_S, GATE = 2, 2.0, 9.21
ACCELERATION_DENSITY, CUE_VARIANCE_M2, CUE_SPEED_VARIANCE = 0.5, 1.0, 1.0


@partial(compiled, allocates=False)
def agree(kind, confirmed, t_s, seen_s, xy_m, velocity_mps, covariance, cue, now_s, near, cost):
    """How well each of a drone's tracks [n] agrees with a cue.

    Args:
        kind, confirmed, t_s, seen_s, xy_m, velocity_mps, covariance: the columns of `sortie.perception.motion.Tracks`.
        cue: where the target is believed to be at `now_s`, and its velocity: x, y, vx, vy.
        now_s: now.
        near: [n] gets whether the track may be a target's and its place agrees.
        cost: [n] gets the squared Mahalanobis distance in place and velocity; infinite for a track that may be no target's.
    """
    for k in range(len(kind)):
        near[k], cost[k] = False, inf
        if kind[k] == PERSON or not confirmed[k] or not now_s - seen_s[k] <= COAST_S:
            continue
        dt = now_s - t_s[k]
        square, noise = dt * dt, ACCELERATION_DENSITY * abs(dt)
        pp, pv, vv = covariance[k]
        pp, pv, vv = (
            pp + 2.0 * dt * pv + square * vv + noise * square / 3.0 + CUE_VARIANCE_M2,
            pv + dt * vv + noise * dt / 2.0,
            vv + noise + CUE_SPEED_VARIANCE,
        )
        x, y = xy_m[k, 0] + dt * velocity_mps[k, 0] - cue[0], xy_m[k, 1] + dt * velocity_mps[k, 1] - cue[1]
        vx, vy = velocity_mps[k, 0] - cue[2], velocity_mps[k, 1] - cue[3]
        near[k] = x * x + y * y < GATE * pp
        both = vv * (x * x + y * y) - 2.0 * pv * (x * vx + y * vy) + pp * (vx * vx + vy * vy)
        cost[k] = both / (pp * vv - pv * pv)
