"""SyncNet (Lei et al., ECCV 2022): how late a peer's features come decides how much they count.

It predicts a late peer's present features by a recurrent network. Here its cheap stand-in: late maps are moved by
the known ego motion (`perception.motion_compensation`), and their weight falls with the delay that the link's goodput
lets expect. Only weights are decided: who sends what to whom is as in full sharing.
"""

from __future__ import annotations

from math import exp

from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.contract import FEATURE_MAP_MEGABITS, Directive, FleetView

TRUSTED_FOR_S = 0.5
"""A delay that takes a map's weight to 1/e."""
STEPS = 4
"""Weights come in quarters and are at least one, so that goodput's noise is no new directive and no map is wasted."""


def syncnet(view: FleetView, *, rho: float = 1.0, trusted_for_s: float = TRUSTED_FOR_S) -> list[Directive]:
    """SyncNet: full maps to every peer, weighed by the delay that the link's goodput lets expect."""
    me = view.me
    if me is None:
        return []
    directives = []
    for peer in view.peers:
        goodput_mbps = me.goodput_to(peer)
        delay_s = rho * FEATURE_MAP_MEGABITS / goodput_mbps if goodput_mbps > 0 else float("inf")
        weight = max(1, round(STEPS * exp(-delay_s / trusted_for_s))) / STEPS
        why = f"SyncNet: {delay_s:.1g} s late"
        directives.append(full_sharing(view.ego, peer, rho, why)._replace(fusion_weight=weight))
    return directives
