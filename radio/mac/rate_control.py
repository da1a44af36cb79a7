"""A sender that knows no SNR: rate control from what was acknowledged, after Minstrel.

For every ordered link and MCS it keeps an exponentially weighted success rate. Nine frames in ten go out at the best
MCS so far; the tenth looks around, at the other MCS in turn, in a random order. Once an interval what was sent is
weighed in, and the best is the highest rate × success rate, where success above 0.9 counts as 0.9 (so that a fast rate
with some loss beats a slow one with none) and below 0.1 as none. (D. Smithies and F. Fietkau's Minstrel in Linux's
mac80211; intervals and weights as there.) The frames of an interval are drawn from a binomial with their true PER.

Left out: the chain of slower rates that a frame falls back on within its retries, so that a rate that is suddenly too
high costs whole samples here; and the air that looking around costs (probes count as frames at the best rate).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan, nan

import numpy as np

from sortie.scenarios.streams import stream

INTERVAL_S = 0.1
KEEP = 0.75
PROBE_SHARE = 0.1
_HIGH, _LOW = 0.9, 0.1


class _LinkHistory:
    """What is known of one ordered link."""

    __slots__ = ("best", "credit", "frames", "losses", "order", "probed", "rng", "success", "until_s")

    def __init__(self, rates: int, rng: np.random.Generator, now_s: float) -> None:
        self.rng = rng
        self.order: list[int] = rng.permutation(rates).tolist()
        self.probed = 0
        self.credit = 0.0
        self.best = 0
        self.success = [nan] * rates
        self.frames = [0.0] * rates  # of this interval
        self.losses = [0.0] * rates  # expected among them
        self.until_s = now_s + INTERVAL_S


class Minstrel:
    """Rate control of every ordered link.

    Args:
        rates_mbps: by MCS, rising.
        seed, replication: as in `sortie.scenarios.streams.stream`; each ordered link has a stream of its own.
    """

    def __init__(self, rates_mbps: Sequence[float], seed: int, replication: int) -> None:
        self._rates = tuple(rates_mbps)
        self._key = (seed, replication)
        self._links: dict[tuple[int, int], _LinkHistory] = {}

    def mcs(self, sender: int, receiver: int, now_s: float) -> int:
        """The MCS in use now; 0 on a link that was never used."""
        link = self._link(sender, receiver, now_s)
        if now_s >= link.until_s - 1e-9:
            self._weigh(link)
            link.until_s = now_s + INTERVAL_S
        return link.best

    def sent(
        self, sender: int, receiver: int, now_s: float, mcs: int, frames: float, per_by_mcs: Sequence[float]
    ) -> None:
        """Count frames that were sent.

        Args:
            sender, receiver: on which link.
            now_s: when.
            mcs: at which MCS, probes apart.
            frames: how many, parts of one included.
            per_by_mcs: probability of losing one at each MCS, in the channel as it was.
        """
        link = self._link(sender, receiver, now_s)
        link.frames[mcs] += frames
        link.losses[mcs] += frames * per_by_mcs[mcs]
        others = len(self._rates) - 1
        link.credit += PROBE_SHARE * frames
        probes = int(link.credit)
        link.credit -= probes
        each, more = divmod(probes, others) if others else (0, 0)
        for k in range(others if each else more):
            at = link.order[link.probed]
            if at == mcs:
                link.probed = (link.probed + 1) % len(link.order)
                at = link.order[link.probed]
            link.probed = (link.probed + 1) % len(link.order)
            count = each + (k < more)
            link.frames[at] += count
            link.losses[at] += count * per_by_mcs[at]

    def _link(self, sender: int, receiver: int, now_s: float) -> _LinkHistory:
        link = self._links.get((sender, receiver))
        if link is None:
            rng = stream(*self._key, (sender, receiver), "rate control")
            link = self._links[sender, receiver] = _LinkHistory(len(self._rates), rng, now_s)
        return link

    def _weigh(self, link: _LinkHistory) -> None:
        best, best_mbps = 0, 0.0
        for m, rate in enumerate(self._rates):
            frames = link.frames[m]
            if frames > 0.0:
                count = max(1, round(frames))
                through = 1.0 - link.rng.binomial(count, min(1.0, link.losses[m] / frames)) / count
                before = link.success[m]
                link.success[m] = through if isnan(before) else KEEP * before + (1.0 - KEEP) * through
                link.frames[m] = link.losses[m] = 0.0
            success = link.success[m]
            if success >= _LOW and rate * min(success, _HIGH) > best_mbps:  # never for NaN
                best, best_mbps = m, rate * min(success, _HIGH)
        link.best = best
