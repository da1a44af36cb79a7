"""A sender that knows no SNR: rate control from what was acknowledged, after Minstrel.

For every ordered link and MCS it keeps an exponentially weighted success rate. Nine exchanges in ten go out at the best
MCS so far; the tenth looks around, at the other MCS in turn. Once an interval what was acknowledged is weighed in,
and the best is the highest rate × success rate, where success above 0.9 counts as 0.9 (so that a fast rate with some
loss beats a slow one with none) and below 0.1 as none. (D. Smithies and F. Fietkau's Minstrel in Linux's mac80211;
intervals and weights as there.) A frame that a collision lost counts as lost, as it does for a real sender.

`Air` updates the statistics only at the beginning of its frames. If a frame is longer than an interval, they are updated
once a frame.

Left out: the chain of slower rates that a frame falls back on within its retries, so that a rate that is suddenly too
high costs whole samples here.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan, nan

INTERVAL_S = 0.1
KEEP = 0.75
_HIGH, _LOW = 0.9, 0.1


class _LinkHistory:
    """What is known of one ordered link."""

    __slots__ = ("acked", "best", "sent", "success", "until_s")

    def __init__(self, rates: int, now_s: float) -> None:
        self.best = 0
        self.success = [nan] * rates
        self.sent = [0] * rates  # of this interval
        self.acked = [0] * rates
        self.until_s = now_s + INTERVAL_S


class Minstrel:
    """Rate control of every ordered link.

    Args:
        rates_mbps: by MCS, rising.
    """

    def __init__(self, rates_mbps: Sequence[float]) -> None:
        self._rates = tuple(rates_mbps)
        self._links: dict[tuple[int, int], _LinkHistory] = {}

    def mcs(self, sender: int, receiver: int, now_s: float) -> int:
        """The MCS in use now; 0 on a link that was never used."""
        link = self._link(sender, receiver, now_s)
        if now_s >= link.until_s - 1e-9:
            self._weigh(link)
            link.until_s = now_s + INTERVAL_S
        return link.best

    def sent(self, sender: int, receiver: int, now_s: float, counts: Sequence[Sequence[int]]) -> None:
        """Count frames that were sent: for each MCS how many, and how many of them were acknowledged."""
        link = self._link(sender, receiver, now_s)
        for mcs, (sent, acked) in enumerate(counts):
            link.sent[mcs] += sent
            link.acked[mcs] += acked

    def _link(self, sender: int, receiver: int, now_s: float) -> _LinkHistory:
        link = self._links.get((sender, receiver))
        if link is None:
            link = self._links[sender, receiver] = _LinkHistory(len(self._rates), now_s)
        return link

    def _weigh(self, link: _LinkHistory) -> None:
        best, best_mbps = 0, 0.0
        for m, rate in enumerate(self._rates):
            if link.sent[m]:
                through = link.acked[m] / link.sent[m]
                before = link.success[m]
                link.success[m] = through if isnan(before) else KEEP * before + (1.0 - KEEP) * through
                link.sent[m] = link.acked[m] = 0
            success = link.success[m]
            if success >= _LOW and rate * min(success, _HIGH) > best_mbps:  # never for NaN
                best, best_mbps = m, rate * min(success, _HIGH)
        link.best = best
