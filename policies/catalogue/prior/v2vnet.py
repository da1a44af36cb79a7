"""V2VNet-style (Wang et al., ECCV 2020): full maps to every peer; it only decides in its fusion network."""

from __future__ import annotations

from sortie.policies.catalogue.attached import among_attached
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.contract import Directive, FleetView, boxes_across_networks


@among_attached
@boxes_across_networks
def v2vnet(view: FleetView, *, rho: float = 1.0) -> list[Directive]:
    """V2VNet-style: full maps to every peer, no context read; weights come from message passing (fusion v2vnet)."""
    return [full_sharing(view.ego, p, rho, "everyone, weights in the network") for p in view.peers]
