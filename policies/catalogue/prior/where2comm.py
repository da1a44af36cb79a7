"""Where2comm (Hu et al., NeurIPS 2022): send the cells that matter, by confidence.

Its confidence maps stand in the descriptors as coverage grids: what a drone sees well is where it is confident. In
the first round a sender goes by its own confidence alone; in a later one by what the receiver asked for as well,
which lacks confidence there (C_i ⊙ (1 − C_j)), and each such round costs the receiver's request map first. A
directive's region is a disc: the smallest about the bounding box of the chosen coverage cells; which feature cells go
from inside it under a budget, `perception.cells_by` decides by the detector's own confidence.
"""

from __future__ import annotations

from collections.abc import Mapping

from sortie.policies.catalogue.coverage_cells import centre_cell, disc_around, seen_well
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.contract import FEATURE_CELLS, Directive, FleetView

REQUEST_MAP_BYTES = FEATURE_CELLS * 2
"""R = 1 − C as one float16 a feature cell (`sortie.perception.network.fusion.traffic`)."""


def where2comm(view: FleetView, *, rho: float = 1.0, rounds: int = 1) -> list[Directive]:
    """Where2comm: features of where the ego is confident, from round 2 on of what the peer lacks there; to every peer."""
    me = view.me
    if me is None:
        return []
    confident = seen_well(me)
    directives = []
    for peer in view.peers:
        asked = confident if rounds < 2 else confident - seen_well(view.descriptors[peer])
        # topology is not its to decide: a link on which nothing is asked for carries one coverage cell
        region = disc_around(asked or centre_cell(me))
        why = f"Where2comm: {len(asked)} cells " + ("confident" if rounds < 2 else "asked for")
        directives.append(full_sharing(view.ego, peer, rho, why)._replace(roi=region))
    return directives


def request_bytes(params: Mapping[str, object]) -> int:
    """Request maps of a link and frame: one a round after the first."""
    rounds = params.get("rounds", 1)
    return max(0, int(rounds) - 1) * REQUEST_MAP_BYTES if isinstance(rounds, int) else 0
