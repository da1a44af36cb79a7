"""Who can hear whom: the list of links that are worth working out.

Small fleets have every link, in a square; in larger ones a link is listed while its ends are within earshot.
Values of links are kept as vectors [L], the links of one sender side by side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Links:
    """Directed links by sender, then receiver."""

    n: int
    sender: IntArray
    receiver: IntArray
    """[L] each; a square list holds every drone with itself too, whose values mean nothing."""
    begin: list[int]
    """[N + 1]: the links of drone i are begin[i] … begin[i + 1] − 1."""
    is_square: bool
    back: IntArray
    """[L]: where the link of the other direction stands."""

    def square(self, values: FloatArray, elsewhere: float) -> FloatArray:
        """[L] → [N, N], sender by receiver, NaN on the diagonal, `elsewhere` where no link is listed."""
        out: FloatArray
        if self.is_square:
            out = values.reshape(self.n, self.n).copy()
        else:
            out = np.full((self.n, self.n), elsewhere)
            out[self.sender, self.receiver] = values
        np.fill_diagonal(out, np.nan)
        return out


def all_links(n: int) -> Links:
    """Every drone with every drone."""
    ids = np.arange(n)
    sender, receiver = np.repeat(ids, n), np.tile(ids, n)
    return Links(n, sender, receiver, [i * n for i in range(n + 1)], True, receiver * n + sender)


def links_in_range(positions_m: FloatArray, range_m: float) -> Links:
    """Links whose ends come within `range_m` in some frame of [frames, N, 3] positions; grows with N × neighbours."""
    from scipy.spatial import cKDTree

    n = positions_m.shape[1]
    middle = positions_m[len(positions_m) // 2]
    astray_m = float(np.sqrt(((positions_m - middle) ** 2).sum(axis=-1).max()))
    pairs = cKDTree(middle).query_pairs(range_m + 2.0 * astray_m, output_type="ndarray").astype(np.int64)
    apart = positions_m[:, pairs[:, 0]] - positions_m[:, pairs[:, 1]]
    pairs = pairs[((apart**2).sum(axis=-1) <= range_m**2).any(axis=0)]
    sender = np.concatenate([pairs[:, 0], pairs[:, 1]])
    receiver = np.concatenate([pairs[:, 1], pairs[:, 0]])
    order = np.lexsort((receiver, sender))
    sender, receiver = sender[order], receiver[order]
    back = np.searchsorted(sender * n + receiver, receiver * n + sender)
    return Links(n, sender, receiver, np.searchsorted(sender, np.arange(n + 1)).tolist(), False, back)
