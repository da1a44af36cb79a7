"""Fixed-rate compression: one fidelity, chosen before take-off."""

from __future__ import annotations

from sortie.policies.catalogue.attached import among_attached
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.contract import Directive, FleetView, boxes_across_networks


@among_attached
@boxes_across_networks
def fixed_compression(view: FleetView, *, rho: float = 0.05) -> list[Directive]:
    """Fixed compression: the same fraction of every map to every peer, no context read."""
    return [full_sharing(view.ego, p, rho, f"fixed compression: {rho:.3g} of the cells") for p in view.peers]
