"""When2com-style (Liu et al., CVPR 2020): attention decides whether to communicate and with whom.

A query of 32 floats goes to every peer, and each answers with its score. Links with an attention above a threshold are
kept. The attention includes the drone itself; if it dominates, nobody sends. Coverage grids replace learned keys and
queries (`matching`). The handshake has the method's bytes.
"""

from __future__ import annotations

from math import exp

from sortie.policies.catalogue.attached import among_attached
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.catalogue.prior.matching import scores_for
from sortie.policies.contract import Directive, FleetView, boxes_across_networks, nothing
from sortie.scenarios.plain_sum import plain_sum

KEPT_ABOVE = 0.2
"""A link with more attention than this is kept; the method's value in tests."""
SHARPNESS = 4.0
"""The factor of the scores (0 … 1) in the softmax. A drone's score for itself is 0."""
MATCH_BYTES = 32 * 4 + 4
"""Bytes that each drone sends to each peer first: its own query of 32 floats, and its score for the peer's query."""


@among_attached
@boxes_across_networks
def when2com(
    view: FleetView, *, rho: float = 1.0, threshold: float = KEPT_ABOVE, sharpness: float = SHARPNESS
) -> list[Directive]:
    """When2com-style: full maps to the peers whose attention on the ego, against all others and themselves, is high enough."""
    if view.me is None:
        return []
    directives = []
    for peer in view.peers:
        scores = scores_for(view, peer)
        mass = 1.0 + plain_sum(exp(sharpness * s) for s in scores.values())
        attention = exp(sharpness * scores[view.ego]) / mass
        why = f"attention {attention:.2f} " + (">" if attention > threshold else "≤") + f" {threshold:g}"
        kept = full_sharing(view.ego, peer, rho, why) if attention > threshold else nothing(view.ego, peer, why)
        directives.append(kept)
    return directives
