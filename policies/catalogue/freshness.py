"""The weight of a link's payloads by the age of the peer's descriptor."""

from __future__ import annotations

from sortie.policies.contract import DETACHED_AFTER_PERIODS

FRESH_PERIODS = 3.0
"""The plane's first threshold: degraded after three periods."""
AGEING = 0.5
"""The weight between the thresholds. It is one step and no slope, so that each frame of age does not change the directive."""


def freshness(age_s: float, period_s: float) -> float:
    """1 up to three periods of age, a half up to ten, then 0. It only compares, so that proofs can follow it.

    It says how far the sender can rely on what it knows of the receiver. It is one factor of a fusion weight. The receiver
    adds its trust in the sender (`sortie.fleet.trust`) and what the payload's own age leaves (`sortie.perception.lateness`).
    """
    if age_s <= FRESH_PERIODS * period_s:
        return 1.0
    return AGEING if age_s <= DETACHED_AFTER_PERIODS * period_s else 0.0
