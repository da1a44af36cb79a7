"""Full sharing: full maps to every peer, every frame, fused at weight 1. It is what prior methods do by default."""

from __future__ import annotations

from sortie.policies.contract import Directive, Representation

RATE_HZ = 10.0
"""One payload for every frame."""


def full_sharing(source: int, destination: int, rho: float, reason: str) -> Directive:
    """One link of full sharing, thinned to `rho` of its cells."""
    return Directive(source, destination, Representation.FEATURES, rho, None, RATE_HZ, reason=reason)
