"""When2com (Liu et al., CVPR 2020): attention says whether to communicate and with whom.

A query of 32 floats goes to every peer, each answers with its score; links whose attention, self included, stays
above a threshold are kept, and where the drone itself dominates nobody sends. Learned keys and queries are stood in
for by coverage grids (`matching`); the handshake's bytes are the method's.
"""

from __future__ import annotations

from math import exp

from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.catalogue.prior.matching import scores_for
from sortie.policies.contract import Directive, FleetView, nothing

KEPT_ABOVE = 0.2
"""The attention above which a link is kept when the method is tested."""
SHARPNESS = 4.0
"""Of the softmax over scores of 0 … 1; a drone answers itself with 0."""
MATCH_BYTES = 32 * 4 + 4
"""What each drone sends to each peer first: its own query of 32 floats, and the score of the peer's."""


def when2com(
    view: FleetView, *, rho: float = 1.0, threshold: float = KEPT_ABOVE, sharpness: float = SHARPNESS
) -> list[Directive]:
    """When2com: full maps to the peers whose attention on the ego, against all others and themselves, is high enough."""
    if view.me is None:
        return []
    directives = []
    for peer in view.peers:
        scores = scores_for(view, peer)
        mass = 1.0 + sum(exp(sharpness * s) for s in scores.values())
        attention = exp(sharpness * scores[view.ego]) / mass
        why = f"When2com: attention {attention:.2f} " + (">" if attention > threshold else "≤") + f" {threshold:g}"
        kept = full_sharing(view.ego, peer, rho, why) if attention > threshold else nothing(view.ego, peer, why)
        directives.append(kept)
    return directives
