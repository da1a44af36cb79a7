"""When drones heard each other, in arrays: a row for each receiver, a column for each sender.

A broadcast reaches many drones at once, and each of them looks at all its peers in every frame. Both are one compiled loop
over these arrays (`sortie.fleet.peer_loops`). Pages of the arrays that no drone has written to take no memory.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

FEWEST_COLUMNS = 256
"""Other drones may have any id of a byte, whatever the scenario's fleet."""


@cache
def loops() -> Any:
    """The compiled loops, imported and made ready at their first use: before a flight, whose drones may be real ones."""
    from sortie.fleet import peer_loops

    none, ids, flags = np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.uint8)
    bits, square = np.zeros((0, 1), np.uint64), np.zeros((0, 0))
    peer_loops.hear(
        ids,
        0,
        none,
        0,
        0.0,
        (0.0, 0.0, 0.0),
        0.0,
        True,
        np.uint64(0),
        1.0,
        1.0,
        1,
        square.astype(np.uint64),
        square,
        square,
        square[..., None],
        square.astype(np.uint8),
        bits[None],
    )
    peer_loops.fill(0.0, 1.0, 1, ids, none, bits, none, none)
    peer_loops.ages(0.0, 0.0, ids, none, none, none)
    peer_loops.near(ids, square, 0.0, 0.0, 0.0)
    peer_loops.overdue(0, 0.0, 1.0, 1.0, 1.0, 1.0, ids, none, none, flags, flags, flags, ids)
    return peer_loops


class PeerTable:
    """What some receivers know about the arrival of every sender's descriptors.

    Args:
        receivers: how many; each has a row.
        first: the drone of the first row; the others follow by id.
        window: how many descriptors of a peer are looked back on.
    """

    def __init__(self, receivers: int, window: int, first: int = 0) -> None:
        self.first, self.window = first, window
        shape = (receivers, max(FEWEST_COLUMNS, first + receivers))
        self.heard_s = np.zeros(shape)
        """When the latest descriptor arrived."""
        self.stamps_s = np.zeros(shape)
        """Its stamp, by the sender's clock."""
        self.ahead_s = np.zeros(shape)
        """How far the receiver's clock is ahead of the sender's, as far as that shows."""
        self.circles = np.zeros((*shape, 3))
        """The footprint that it claims: x, y and radius, m."""
        self.watched = np.zeros(shape, np.uint8)
        """Whether the sender's clock showed an offset lately, so that each of its lags counts (`sortie.fleet.clock`)."""
        self.bits = np.zeros((*shape, -(-window // loops().WORD)), np.uint64)
        """The latest descriptors as bits, the latest in the lowest: 1 arrived, 0 missed."""
        self.busy, self.at_rest, self.blamed = (np.zeros(shape, np.uint8) for _ in range(3))
        """Of the link from the receiver to the sender: whether an upgrade waits or its age was too high; whether it carries
        nothing and nothing is asked of it; whether a wrong clock is to blame for its age."""
        self._counters: dict[int, NDArray[np.uint64]] = {}

    @property
    def pair_bytes(self) -> float:
        """What a receiver's memory of a sender takes, with one key."""
        arrays = [a for a in vars(self).values() if isinstance(a, np.ndarray)]
        return sum(a.nbytes for a in (*arrays, self.counters(0))) / self.heard_s.size

    def counters(self, key_id: int) -> NDArray[np.uint64]:
        """The highest counter taken with a key, 0 for none."""
        if key_id not in self._counters:
            self._counters[key_id] = np.zeros(self.heard_s.shape, np.uint64)
        return self._counters[key_id]
