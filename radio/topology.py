"""How a fleet hangs together over its usable links: who is connected, who is cut off, where the bottleneck is."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Connectivity(NamedTuple):
    """A fleet's links in one look."""

    connected: bool
    """Whether every drone reaches every other, over several hops if need be."""
    cut: tuple[int, ...]
    """Drones outside the largest group whose members all reach one another (of equals, that with the lowest id), ascending."""
    bottleneck: tuple[int, int, float] | None
    """Sender, receiver and quality of the link that limits the worst-off pair that is connected; None without links."""


def linked_drones(quality: ArrayLike, threshold: float) -> list[int]:
    """Drones with at least one usable link, in or out, ascending; arguments as for `connectivity`."""
    usable = np.asarray(quality, dtype=float) >= threshold
    usable |= usable.T
    np.fill_diagonal(usable, False)
    linked: list[int] = np.flatnonzero(usable.any(axis=0)).tolist()
    return linked


def widths(quality: ArrayLike) -> NDArray[np.float64]:
    """How good the weakest link of the widest route between each pair is (Floyd's recursion with min and max).

    Args:
        quality: [N, N], sender by receiver; NaN is no link.

    Returns:
        [N, N]; −inf where there is no route, and on the diagonal.
    """
    wide = np.array(quality, dtype=float)
    wide[np.isnan(wide)] = -np.inf
    np.fill_diagonal(wide, -np.inf)
    for via in range(len(wide)):
        np.maximum(wide, np.minimum(wide[:, via, None], wide[None, via, :]), out=wide)
    np.fill_diagonal(wide, -np.inf)
    return wide


def connectivity(quality: ArrayLike, threshold: float) -> Connectivity:
    """How a fleet hangs together.

    Args:
        quality: [N, N], sender by receiver: goodput in Mb/s or SNR in dB; the diagonal and NaN are no links.
        threshold: the least quality of a usable link, in the unit of `quality`.

    Raises:
        ValueError: if `quality` is not square.

    Example, three drones in a row, and a fourth that nobody hears:

    >>> connectivity([[0, 9, 1, 0], [9, 0, 6, 0], [1, 6, 0, 0], [0, 0, 0, 0]], threshold=5.0)
    Connectivity(connected=False, cut=(3,), bottleneck=(1, 2, 6.0))
    """
    usable = np.array(quality, dtype=float)
    if usable.ndim != 2 or usable.shape[0] != usable.shape[1]:
        raise ValueError(f"quality has shape {usable.shape}, must be square")
    usable[~(usable >= threshold)] = np.nan
    np.fill_diagonal(usable, np.nan)
    width = widths(usable)
    has_route = np.isfinite(width)
    bottleneck = None
    if has_route.any():
        limit = width[has_route].min()
        i, j = (int(at[0]) for at in np.nonzero(usable == limit))
        bottleneck = (i, j, float(limit))
    np.fill_diagonal(has_route, True)
    group = has_route & has_route.T  # a drone's row: who reaches it and is reached by it
    largest = group[np.argmax(group.sum(axis=1))] if len(group) else group.any(axis=1)
    return Connectivity(bool(has_route.all()), tuple(np.flatnonzero(~largest).tolist()), bottleneck)
