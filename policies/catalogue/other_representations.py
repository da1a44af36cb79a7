"""Fixed policies that share by other representations than features and detections, for comparisons."""

from __future__ import annotations

from sortie.policies.catalogue.attached import among_attached
from sortie.policies.catalogue.baselines import everyone
from sortie.policies.catalogue.prior.full import RATE_HZ
from sortie.policies.contract import Directive, FleetView, Representation, boxes_across_networks


@among_attached
@boxes_across_networks
def codes(view: FleetView, *, received_budget: float = 0.25) -> list[Directive]:
    """Codes to every peer, of the cells that `all-4` would send as features.

    Args:
        view: the fleet's latest descriptors.
        received_budget: cells that each ego receives, as a share of full sharing; as codes they have far fewer bytes.
    """
    return [
        d._replace(representation=Representation.CODES, reason="fixed: every peer, as codes")
        for d in everyone(view, received_budget=received_budget)
    ]


@among_attached
def uncertain_boxes(view: FleetView) -> list[Directive]:
    """Boxes with the covariances of their places to every peer, whatever the context."""
    return [
        Directive(view.ego, p, Representation.UNCERTAIN_BOXES, rate_hz=RATE_HZ, reason="fixed: boxes with covariances")
        for p in view.peers
    ]
