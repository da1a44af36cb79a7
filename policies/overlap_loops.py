"""The compiled loop over a drone's peers (`sortie.policies.geometry`); it rounds as Python does."""

from __future__ import annotations

from math import acos, copysign, pi, sqrt

import numpy as np

from sortie.scenarios.compiled import compiled, part

# constants of the file itself: kept machine code does not see that another file has changed
_AGENT_IDS, _STEP = 1 << 16, 0.1


@part
def _overlap(distance_m, a_m, b_m):
    """`sortie.scenarios.disc.disc_overlap`."""
    if a_m <= 0 or b_m <= 0 or distance_m >= a_m + b_m:
        return 0.0
    if distance_m <= abs(a_m - b_m):
        return 1.0 if a_m <= b_m else (b_m / a_m) ** 2
    d2, a2, b2 = distance_m * distance_m, a_m * a_m, b_m * b_m
    cos_a, cos_b = (d2 + a2 - b2) / (2 * distance_m * a_m), (d2 + b2 - a2) / (2 * distance_m * b_m)
    cos_a = cos_a if -1.0 < cos_a < 1.0 else copysign(1.0, cos_a)
    cos_b = cos_b if -1.0 < cos_b < 1.0 else copysign(1.0, cos_b)
    share = (a2 * acos(cos_a) + b2 * acos(cos_b) - distance_m * a_m * sqrt(1.0 - cos_a * cos_a)) / (pi * a2)
    return 0.0 if share < 0.0 else share if share < 1.0 else 1.0


@compiled
def ranked(of, ids, at, circles):
    """All ids but one as `sortie.scenarios.disc.rank_by_overlap` ranks them.

    Args:
        of: the id whose peers are ranked.
        ids: [N], it among them.
        at: [N], the row of each in the next array.
        circles: [..., 3], the footprints: x, y and radius, m.
    """
    me = 0
    while ids[me] != of:
        me += 1
    x_m, y_m, radius_m = circles[at[me]]
    found = np.empty(len(ids) - 1, np.int64)
    count = 0
    for k in range(len(ids)):
        if k != me:
            its = circles[at[k]]
            overlap = _overlap(np.hypot(x_m - its[0], y_m - its[1]), radius_m, its[2])
            found[count] = (ids[k] - of) % _AGENT_IDS - _AGENT_IDS * int(np.rint(overlap / _STEP))
            count += 1
    found.sort()
    for k in range(count):
        found[k] = (found[k] + of) % _AGENT_IDS
    return found
