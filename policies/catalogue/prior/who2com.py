"""Who2com-style (Liu et al., ICRA 2020): every drone is served by exactly one other, the one that adds most to it.

The handshake is When2com's (a request, a score from each, a choice). The choice leaves the drone itself out, so one
drone always sends.
"""

from __future__ import annotations

from sortie.policies.catalogue.attached import among_attached
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.catalogue.prior.matching import scores_for
from sortie.policies.contract import AGENT_IDS, Directive, FleetView, boxes_across_networks, nothing


@among_attached
@boxes_across_networks
def who2com(view: FleetView, *, rho: float = 1.0) -> list[Directive]:
    """Who2com-style: full maps to the peers for which the ego is the best of all drones; ties are broken by id."""
    if view.me is None:
        return []
    directives = []
    for peer in view.peers:
        scores = scores_for(view, peer)
        best = max(scores, key=lambda i: (scores[i], -((i - peer) % AGENT_IDS)))
        if best == view.ego:
            directives.append(full_sharing(view.ego, peer, rho, f"best for {peer}, {scores[best]:.2f}"))
        else:
            directives.append(nothing(view.ego, peer, f"drone {best} is better for {peer}"))
    return directives
