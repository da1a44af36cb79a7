"""What n backlogged senders lose to one another: Bianchi's model of the 802.11 backoff.

Each sender transmits in a slot with probability τ, and collides with probability p = 1 − (1 − τ)^{n−1};
τ follows from p by the backoff chain with m doublings of a window of W slots:
τ = 2 / (1 + W + p W Σ_{i<m} (2p)^i). The two are solved once for each n. (G. Bianchi, IEEE JSAC 18(3), 2000.)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

from scipy.optimize import brentq

from sortie.scenarios.plain_sum import plain_sum

SLOT_S = 9e-6
SIFS_S = 16e-6
DIFS_S = 34e-6
CW_MIN = 15
CW_MAX = 1023


@dataclass(frozen=True, slots=True)
class Contention:
    """What one successful exchange costs beside itself, with n senders always backlogged."""

    senders: int
    transmit_probability: float
    """τ, per slot and sender."""
    collision_probability: float
    """p, of a transmission."""
    idle_s: float
    """Mean time of empty slots per success."""
    collisions: float
    """Mean number of collisions on the channel per success; each costs the collided frame and a DIFS."""

    @property
    def sends_per_success(self) -> float:
        """How often a sender transmits for each success of its own, ≥ 1."""
        return 1.0 / (1.0 - self.collision_probability)


@lru_cache(maxsize=1024)
def contention(senders: int) -> Contention:
    """Solve Bianchi's fixed point for `senders` ≥ 1."""
    if senders < 1:
        raise ValueError(f"senders is {senders}, must be at least 1")
    window = CW_MIN + 1
    doublings = ((CW_MAX + 1) // window).bit_length() - 1

    def tau(p: float) -> float:
        return 2.0 / (1.0 + window + p * window * plain_sum((2.0 * p) ** i for i in range(doublings)))

    def excess(p: float) -> float:
        return p - (1.0 - (1.0 - tau(p)) ** (senders - 1))

    p = 0.0 if senders == 1 else float(brentq(excess, 0.0, 1.0 - 1e-12, xtol=1e-14))
    t = tau(p)
    some = 1.0 - (1.0 - t) ** senders
    one = senders * t * (1.0 - t) ** (senders - 1)
    return Contention(senders, t, p, SLOT_S * (1.0 - some) / one, (some - one) / one)


def saturation_mbps(
    senders: int, payload_bits: float, ppdu_s: float, ack_s: float, *, goes_on_at_once: bool = False
) -> float:
    """Bianchi's throughput of all `senders` together, always backlogged, in Mb/s.

    Args:
        senders: ≥ 1.
        payload_bits: of one frame or A-MPDU.
        ppdu_s, ack_s: time of it and of its answer.
        goes_on_at_once: whoever has succeeded draws a backoff of 0 once in `CW_MIN` + 1 times and then sends again
            unopposed (ns-3's reference for 802.11a counts this, that for 802.11ax does not; stations in flight do so).
    """
    among = contention(senders)
    in_a_row = 1.0 / (1.0 - 1.0 / (CW_MIN + 1)) if goes_on_at_once else 1.0
    success_s = (ppdu_s + SIFS_S + ack_s + DIFS_S) * in_a_row + SLOT_S
    return in_a_row * payload_bits * 1e-6 / (success_s + among.idle_s + among.collisions * (ppdu_s + DIFS_S))
