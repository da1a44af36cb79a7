"""Descriptors as probes of a link: which of a peer's latest ones arrived, and what that says where no payload goes.

Every drone publishes at a known period, so a receiver can count the descriptors that it missed. They probe the way from the
peer to this drone; `sortie.scenarios.link_state` says what that tells of the way back.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sortie.fleet.peers import PeerTable, loops
from sortie.scenarios.link_state import probed_mbps


def window_of(periods: float) -> int:
    """How many descriptors of a peer are looked back on: a peer counts as silent once so many in a row are missed as detach it."""
    return max(1, round(periods))


class Probes:
    """The latest descriptors of each peer, as heard and missed by the drone of one row of a table."""

    def __init__(self, table: PeerTable, row: int, period_s: float) -> None:
        """Args: `period_s` is the time between two descriptors of a peer."""
        self._heard_s, self._bits = table.heard_s[row], table.bits[row]
        self._period_s, self._window = period_s, table.window
        self._mbps = np.array([probed_mbps(arrived / table.window) for arrived in range(table.window + 1)])
        self._fill = loops().fill

    def fill(self, peers: NDArray[np.int64], goodput_mbps: Sequence[float], now_s: float) -> tuple[float, ...]:
        """The goodputs of a drone's descriptor, Mb/s: measured ones stay, and probes stand for the others.

        A descriptor that is less than half a period overdue is not missed yet. Peers never heard stay 0.

        Args:
            peers: [K], the drones that the goodputs are to.
            goodput_mbps: [K], as measured with payloads; 0 without a measurement.
            now_s: the time, s.
        """
        known = np.fromiter(goodput_mbps, np.float64, len(goodput_mbps))
        self._fill(now_s, self._period_s, self._window, peers, self._heard_s, self._bits, self._mbps, known)
        return tuple(known.tolist())
