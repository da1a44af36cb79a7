"""Routes over several hops: each pair's way through the fleet that takes least airtime.

A link costs the time that a payload bit takes on it, so a route costs the sum over its hops: what it takes from the
one channel that all share. Two fast hops beat one slow link, and a direct link wins every tie. Routes go by what
senders know of their links, the SNR of the frame before; that every drone knows of every link is taken for granted,
as a link-state protocol would have it, and its own bytes are not counted.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def cheapest(cost: ArrayLike, max_hops: int) -> tuple[list[FloatArray], list[IntArray]]:
    """Cheapest routes of at most 1 … max_hops hops (Bellman & Ford's recursion for all pairs).

    Args:
        cost: [N, N], sender by receiver, > 0: of a link; inf or NaN where there is none.
        max_hops: ≥ 1.

    Returns:
        Two lists over the allowed hops: the cost of the best route, and the drone that it goes to next (the target
        itself where the direct link is as good, or where there is no route). [N, N] each; the diagonal means nothing.

    Raises:
        ValueError: if `cost` is not square or max_hops is below 1.
    """
    direct = np.asarray(cost, dtype=float)
    if direct.ndim != 2 or direct.shape[0] != direct.shape[1]:
        raise ValueError(f"cost has shape {direct.shape}, must be square")
    if max_hops < 1:
        raise ValueError(f"max_hops is {max_hops}, must be at least 1")
    direct = np.where(np.isnan(direct), np.inf, direct)
    n = len(direct)
    np.fill_diagonal(direct, np.inf)
    costs, following = [direct], [np.tile(np.arange(n), (n, 1))]
    for _ in range(1, max_hops):
        through = direct[:, :, None] + costs[-1][None, :, :]  # [sender, next, target]
        via = through.argmin(axis=1)
        best = np.take_along_axis(through, via[:, None, :], axis=1)[:, 0]
        better = best < costs[-1]
        costs.append(np.where(better, best, costs[-1]))
        following.append(np.where(better, via, following[-1]))
    return costs, following


class Routes:
    """The fleet's routes in one frame, worked out at their first use."""

    def __init__(self, max_hops: int) -> None:
        self.max_hops = max_hops
        self._cost: FloatArray = np.zeros((0, 0))
        self._next: list[list[list[int]]] | None = None

    def renew(self, mbps: FloatArray) -> None:
        """A new frame: [N, N] payload rate of each link alone on the channel, 0 where there is none."""
        with np.errstate(divide="ignore", invalid="ignore"):
            self._cost = np.where(mbps > 0.0, 1.0 / mbps, np.inf)
        self._next = None

    def next_hop(self, sender: int, target: int, hops_left: int) -> int:
        """Where a payload goes next; the target itself where nothing is better."""
        if self._next is None:
            self._next = [table.tolist() for table in cheapest(self._cost, self.max_hops)[1]]
        return self._next[max(1, hops_left) - 1][sender][target]

    def path(self, sender: int, target: int) -> list[int]:
        """The drones from sender to target, both included."""
        route, left = [sender], self.max_hops
        while route[-1] != target:
            route.append(self.next_hop(route[-1], target, left))
            left -= 1
        return route
