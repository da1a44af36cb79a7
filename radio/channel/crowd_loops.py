"""Compiled loops over the pairs of a large fleet, frame by frame; each rounds as numpy does."""

from __future__ import annotations

from functools import partial

import numpy as np

from sortie.scenarios.compiled import compiled, part

loop = partial(compiled, allocates=False)

# constants of the file itself: kept machine code does not see that another file has changed
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1, _MIX_2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_30, _27, _31, _48 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(48)


@part
def _mix(z):
    """As `sortie.radio.channel.draws.mix`."""
    z = z * _GOLDEN
    z = (z ^ (z >> _30)) * _MIX_1
    z = (z ^ (z >> _27)) * _MIX_2
    return z ^ (z >> _31)


@loop
def distances(positions_m, low, high, range_m, apart_m, near):
    """Distances [frames, P] of the pairs `low`, `high` [P]; sets `near` [P] where it is at most `range_m` in any frame."""
    for t in range(positions_m.shape[0]):
        for k in range(len(low)):
            a, b = low[k], high[k]
            x = positions_m[t, a, 0] - positions_m[t, b, 0]
            y = positions_m[t, a, 1] - positions_m[t, b, 1]
            z = positions_m[t, a, 2] - positions_m[t, b, 2]
            apart_m[t, k] = np.sqrt(x * x + y * y + z * z)
            near[k] |= apart_m[t, k] <= range_m


@loop
def shadowing(keys, first_frame, normals, sigma_db, innovation_db, keep, before_db, shadow_db):
    """A Gauss–Markov process for each pair (`sortie.radio.channel.shadowing.gauss_markov`), in single precision.

    Args:
        keys: [P]; a pair's normal number in a frame is a hash of its key and the frame.
        first_frame: number of the first frame.
        normals: [65,536], the table of the numbers.
        sigma_db, innovation_db, keep: standard deviation, that of the innovations, and correlation from frame to frame.
        before_db: [P], the value before; NaN begins anew.
        shadow_db: [frames, P], is filled.
    """
    for t in range(shadow_db.shape[0]):
        counter = _mix(np.uint64(first_frame + t))
        for k in range(len(keys)):
            z = normals[_mix(keys[k] + counter) >> _48]
            before = before_db[k] if t == 0 else shadow_db[t - 1, k]
            shadow_db[t, k] = sigma_db * z if np.isnan(before) else innovation_db * z + keep * before
