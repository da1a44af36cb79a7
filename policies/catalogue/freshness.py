"""The weight of a link's payloads by the age of the peer's descriptor."""

from __future__ import annotations

FRESH_PERIODS = 3.0
"""The plane's first threshold: degraded after three periods."""
AGEING = 0.5
"""The weight of a peer that is degraded and still attached. It is one step and no slope, so that each frame of age does not change the directive."""


def freshness(age_s: float, period_s: float) -> float:
    """1 up to three periods of age, then a half. It only compares, so that proofs can follow it.

    It is for attached peers; detached ones are sent nothing (`sortie.policies.catalogue.attached`).

    It says how far the sender can rely on what it knows of the receiver. It is one factor of a fusion weight. The receiver
    adds its trust in the sender (`sortie.fleet.trust`) and what the payload's own age leaves (`sortie.perception.lateness`).
    """
    return 1.0 if age_s <= FRESH_PERIODS * period_s else AGEING
