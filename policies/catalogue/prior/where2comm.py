"""Where2comm-style (Hu et al., NeurIPS 2022): send the cells that matter, by confidence.

Coverage grids replace its confidence maps: a drone is confident where it sees well. In the first round a sender uses
its own confidence alone. In later rounds it also uses the receiver's request, the cells where the receiver lacks
confidence (C_i ⊙ (1 − C_j)). Each such round costs the bytes of the receiver's request map. A directive's region is a
disc: the smallest around the bounding box of the chosen coverage cells. Under a budget, the feature cells
inside it are chosen by the detector's own confidence.
"""

from __future__ import annotations

from collections.abc import Mapping

from sortie.policies.catalogue.attached import among_attached
from sortie.policies.catalogue.coverage_cells import centre_cell, disc_around, seen_well
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.contract import FEATURE_CELLS, Directive, FleetView, boxes_across_networks

REQUEST_MAP_BYTES = FEATURE_CELLS * 2
"""R = 1 − C as one float16 a feature cell (`sortie.perception.network.fusion.traffic`)."""


@among_attached
@boxes_across_networks
def where2comm(view: FleetView, *, rho: float = 1.0, rounds: int = 1) -> list[Directive]:
    """Where2comm-style: features of where the ego is confident, from round 2 on of what the peer lacks there; to every peer."""
    me = view.me
    if me is None:
        return []
    confident = seen_well(me)
    directives = []
    for peer in view.peers:
        wanted = confident if rounds < 2 else confident - seen_well(view.descriptors[peer])
        # the method does not decide topology: a link without wanted cells carries one coverage cell
        region = disc_around(wanted or centre_cell(me))
        why = f"{len(wanted)} cells " + ("confident" if rounds < 2 else "asked for")
        directives.append(full_sharing(view.ego, peer, rho, why)._replace(roi=region))
    return directives


def request_bytes(params: Mapping[str, object]) -> int:
    """Bytes of request maps for a link and frame: one for each round after the first."""
    rounds = params.get("rounds", 1)
    return max(0, int(rounds) - 1) * REQUEST_MAP_BYTES if isinstance(rounds, int) else 0
