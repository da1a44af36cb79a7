"""DiscoNet-style (Li et al., NeurIPS 2021): full maps to every peer; its edge network weights agents cell by cell."""

from __future__ import annotations

from sortie.policies.catalogue.attached import among_attached
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.contract import Directive, FleetView, boxes_across_networks


@among_attached
@boxes_across_networks
def disconet(view: FleetView, *, rho: float = 1.0) -> list[Directive]:
    """DiscoNet-style: full maps to every peer, no context read; weights come from its edge network (fusion disconet)."""
    return [full_sharing(view.ego, p, rho, "everyone, weights in the network") for p in view.peers]
