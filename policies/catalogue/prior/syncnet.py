"""SyncNet-style (Lei et al., ECCV 2022): the delay of a peer's features decides their weight.

The method predicts a late peer's present features by a recurrent network. Here late maps are moved by the known ego
motion instead (`perception.motion_compensation`). Their weight falls with the delay that follows from the link's goodput.
Only weights are decided. Everything else is as in full sharing.
"""

from __future__ import annotations

from math import exp

from sortie.policies.catalogue.attached import among_attached
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.catalogue.worked import NO_GOODPUT
from sortie.policies.contract import FEATURE_MAP_MEGABITS, Directive, FleetView, boxes_across_networks

TRUSTED_FOR_S = 0.5
"""The delay at which a map's weight is 1/e."""
STEPS = 4
"""Weights are multiples of a quarter, so that noise of the goodput changes no directive. They are at least a quarter."""


@among_attached
@boxes_across_networks
def syncnet(view: FleetView, *, rho: float = 1.0, trusted_for_s: float = TRUSTED_FOR_S) -> list[Directive]:
    """SyncNet-style: full maps to every peer, weighted by the delay that follows from the link's goodput."""
    me = view.me
    if me is None:
        return []
    directives = []
    for peer in view.peers:
        weight, why = 1 / STEPS, NO_GOODPUT.get(me.link_state(peer), "")
        if not why:
            delay_s = rho * FEATURE_MAP_MEGABITS / me.goodput_to(peer)
            weight = max(1, round(STEPS * exp(-delay_s / trusted_for_s))) / STEPS
            why = f"{delay_s:.1g} s late"
        directives.append(full_sharing(view.ego, peer, rho, why)._replace(fusion_weight=weight))
    return directives
