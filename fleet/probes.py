"""Descriptors as probes of a link: which of a peer's latest ones arrived, and what that says where no payload goes.

Every drone publishes at a known period, so a receiver can count the descriptors that it missed. They probe the way from the
peer to this drone; `sortie.scenarios.link_state` says what that tells of the way back.
"""

from __future__ import annotations

from collections.abc import Sequence

from sortie.scenarios.link_state import probed_mbps


class Probes:
    """The latest descriptors of each peer, as heard and missed by one drone.

    A peer counts as silent once as many descriptors in a row are missed as detach it.
    """

    def __init__(self, period_s: float, periods: float) -> None:
        """Args: `period_s` is the time between two descriptors of a peer, `periods` how many of them are looked back on."""
        self._period_s, self._window = period_s, max(1, round(periods))
        self._mask = (1 << self._window) - 1
        self._mbps = [probed_mbps(arrived / self._window) for arrived in range(self._window + 1)]
        self._heard: dict[int, tuple[float, int]] = {}  # peer → when it was last heard; a bit a period, latest lowest

    def heard(self, peer: int, now_s: float) -> None:
        """A descriptor of this peer has arrived."""
        before = self._heard.get(peer)
        if before is None:
            self._heard[peer] = now_s, 1
            return
        since = int((now_s - before[0]) / self._period_s + 0.5)
        self._heard[peer] = now_s, (before[1] << min(since, self._window) | 1) & self._mask

    def fill(self, me: int, goodput_mbps: Sequence[float], now_s: float) -> tuple[float, ...]:
        """The goodputs of a drone's descriptor, Mb/s: measured ones stay, and probes stand for the others.

        A descriptor that is less than half a period overdue is not missed yet. Peers never heard stay 0.

        Args:
            me: the drone.
            goodput_mbps: as measured with payloads, to every other drone by ascending id; 0 without a measurement.
            now_s: the time, s.
        """
        known = list(goodput_mbps)
        mask, window, period_s = self._mask, self._window, self._period_s
        for peer, (at_s, bits) in self._heard.items():
            slot = peer - (peer > me)
            if slot < len(known) and known[slot] <= 0.0:
                missed = int((now_s - at_s) / period_s - 0.5)
                if missed > 0:
                    bits = bits << min(missed, window) & mask
                known[slot] = self._mbps[bits.bit_count()]
        return tuple(known)
