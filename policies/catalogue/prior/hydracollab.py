"""HydraCollab-style: scene confidence switches a link between intermediate and late fusion.

Only its abstract is public: features where both ends are confident, detections where one is. Here a drone is confident
of the cells that it reports as seen well. A threshold decides whether both ends agree. The region is what both see, for
features, or what only the sender sees, for detections.
"""

from __future__ import annotations

from sortie.policies.catalogue.attached import among_attached
from sortie.policies.catalogue.coverage_cells import centre_cell, disc_around, seen_well
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.contract import Directive, FleetView, Representation, boxes_across_networks

AGREEMENT = 0.3
"""Cells of both over cells of either."""


@among_attached
@boxes_across_networks
def hydracollab(view: FleetView, *, rho: float = 1.0, threshold: float = AGREEMENT) -> list[Directive]:
    """HydraCollab-style: features of what both ends see well where they agree, otherwise detections of what one sees."""
    me = view.me
    if me is None:
        return []
    mine = seen_well(me)
    directives = []
    for peer in view.peers:
        theirs = seen_well(view.descriptors[peer])
        both, joint = mine & theirs, mine | theirs
        agreement = len(both) / len(joint) if joint else 0.0
        if both and agreement >= threshold:
            why = f"both confident, {agreement:.2f}"
            directives.append(full_sharing(view.ego, peer, rho, why)._replace(roi=disc_around(both)))
        else:
            why = f"one confident, {agreement:.2f}"
            region = disc_around((mine - theirs) or centre_cell(me))
            late = full_sharing(view.ego, peer, 0.0, why)
            directives.append(late._replace(representation=Representation.DETECTIONS, roi=region))
    return directives
