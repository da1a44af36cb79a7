"""How far a link's payloads may count by the age of what is known about its other end."""

from __future__ import annotations

FRESH_PERIODS, GONE_PERIODS = 3.0, 10.0
"""The plane's two thresholds: degraded after three periods, detached after ten."""
AGEING = 0.5
"""Weight in between. One step and no slope, so that ageing by a frame is no new directive."""


def freshness(age_s: float, period_s: float) -> float:
    """1 up to three periods of age, a half up to ten, then 0: comparisons alone, so that proofs can follow it.

    It is the freshness half of a fusion weight; the receiver's trust in the sender is the other
    (`sortie.fleet.trust`), and is applied where the payload is fused.
    """
    if age_s <= FRESH_PERIODS * period_s:
        return 1.0
    return AGEING if age_s <= GONE_PERIODS * period_s else 0.0
