"""Who can hear whom: the list of links to work out.

Small fleets have every link, in a square; in larger ones a link is listed while its ends are within earshot.
Values of links are kept as vectors [L].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating[Any]]
IntArray = NDArray[np.int64]
Float = TypeVar("Float", bound=np.floating[Any])


@dataclass(frozen=True, slots=True)
class LinkList:
    """Directed links, by sender, then receiver."""

    n: int
    sender: IntArray
    receiver: IntArray
    """[L] each; a square list holds every drone with itself too, whose values mean nothing."""
    begin: list[int]
    """[N + 1]: the links of drone i are begin[i] … begin[i + 1] − 1."""
    pair: IntArray | None
    """[L]: the pair of each link; None in a square list."""

    @property
    def is_square(self) -> bool:
        """Whether all links are listed, in a square."""
        return self.pair is None

    def of_pairs(self, values: NDArray[Float]) -> NDArray[Float]:
        """[P] → [L]: each link gets its pair's value. A square list has no pairs: its values are of links already."""
        return values if self.pair is None else values[self.pair]

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
    return LinkList(n, np.repeat(ids, n), np.tile(ids, n), [i * n for i in range(n + 1)], None)


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

    from sortie.radio.channel import crowd_loops

    n = positions_m.shape[1]
    middle = positions_m[len(positions_m) // 2]
    astray_m = float(np.sqrt(((positions_m - middle) ** 2).sum(axis=-1).max()))
    pairs = cKDTree(middle).query_pairs(range_m + 2.0 * astray_m, output_type="ndarray")
    codes = np.sort(pairs[:, 1] * n + pairs[:, 0])
    kept = np.array([high * n + low for low, high in always], codes.dtype)
    if len(kept):
        codes = np.union1d(codes, kept)
    high, low = np.divmod(codes, n)
    apart, near = np.empty((len(positions_m), len(codes)), positions_m.dtype), np.isin(codes, kept)
    crowd_loops.distances(positions_m, low, high, positions_m.dtype.type(range_m), apart, near)
    if near.all():
        return low, high, apart
    return low[near], high[near], apart[:, near]


def both_ways(n: int, low: IntArray, high: IntArray) -> LinkList:
    """The links of some pairs, in both directions."""
    sender, receiver = np.concatenate([low, high]), np.concatenate([high, low])
    order = np.argsort(sender * n + receiver)
    sender = sender[order]
    return LinkList(n, sender, receiver[order], np.searchsorted(sender, np.arange(n + 1)).tolist(), order % len(low))
