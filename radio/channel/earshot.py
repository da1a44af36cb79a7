"""Who can hear whom: the list of links to work out.

Small fleets have every link, in a square; in larger ones a link is listed while its ends are within earshot.
Values of links are kept as vectors [L].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating[Any]]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class LinkList:
    """Directed links, in some order."""

    n: int
    sender: IntArray
    receiver: IntArray
    """[L] each; a square list holds every drone with itself too, whose values mean nothing."""
    by_sender: IntArray
    """[L]: their order by sender, then receiver."""
    begin: list[int]
    """[N + 1]: in that order, the links of drone i are begin[i] … begin[i + 1] − 1."""
    is_square: bool

    def square(self, values: FloatArray, elsewhere: float) -> NDArray[np.float64]:
        """[L] → [N, N], sender by receiver, NaN on the diagonal, `elsewhere` where no link is listed."""
        if self.is_square:
            out = values.reshape(self.n, self.n).astype(np.float64)
        else:
            out = np.full((self.n, self.n), elsewhere)
            out[self.sender, self.receiver] = values
        np.fill_diagonal(out, np.nan)
        return out


def all_links(n: int) -> LinkList:
    """Every drone with every drone."""
    ids = np.arange(n)
    return LinkList(n, np.repeat(ids, n), np.tile(ids, n), np.arange(n * n), [i * n for i in range(n + 1)], True)


def near_pairs(
    positions_m: FloatArray, range_m: float, always: Sequence[tuple[int, int]] = ()
) -> tuple[IntArray, IntArray, FloatArray]:
    """Pairs whose ends come within `range_m` in some frame; the work grows with N × neighbours.

    Args:
        positions_m: [frames, N, 3].
        range_m: ≥ 0.
        always: pairs that are listed however far apart they are, lower id first.

    Returns:
        Lower ids [P], higher ids [P], and distances [frames, P], in the type of `positions_m`; pairs by higher, then
        lower id.
    """
    from scipy.spatial import cKDTree

    n = positions_m.shape[1]
    middle = positions_m[len(positions_m) // 2]
    astray_m = float(np.sqrt(((positions_m - middle) ** 2).sum(axis=-1).max()))
    pairs = cKDTree(middle).query_pairs(range_m + 2.0 * astray_m, output_type="ndarray")
    kept = np.array([high * n + low for low, high in always], pairs.dtype)
    codes = np.union1d(pairs.max(axis=1) * n + pairs.min(axis=1), kept)
    high, low = np.divmod(codes, n)
    apart = np.zeros((len(positions_m), len(codes)), positions_m.dtype)
    for axis in range(3):  # mode="clip" spares a copy and a check: ids are in range
        along = np.ascontiguousarray(positions_m[:, :, axis])
        step = np.take(along, low, axis=1, mode="clip")
        step -= np.take(along, high, axis=1, mode="clip")
        step *= step
        apart += step
    np.sqrt(apart, out=apart)
    near = (apart <= range_m).any(axis=0)
    if len(kept):
        near |= np.isin(codes, kept)
    if near.all():
        return low, high, apart
    return low[near], high[near], apart[:, near]


def both_ways(n: int, low: IntArray, high: IntArray) -> LinkList:
    """The links of some pairs: all those from the lower id, then all those from the higher one."""
    sender, receiver = np.concatenate([low, high]), np.concatenate([high, low])
    order = np.argsort(sender * n + receiver)
    begin = np.searchsorted(sender[order], np.arange(n + 1)).tolist()
    return LinkList(n, sender, receiver, order, begin, False)
