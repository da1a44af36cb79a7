"""Matching of keys with queries, for methods that choose peers by what they see; coverage grids replace learned vectors."""

from __future__ import annotations

from sortie.policies.catalogue.coverage_cells import new_share, seen_well
from sortie.policies.contract import FleetView


def scores_for(view: FleetView, receiver: int) -> dict[int, float]:
    """For each other drone, the share of what it sees well that the receiver does not see well, 0 … 1."""
    known = seen_well(view.descriptors[receiver])
    return {i: new_share(seen_well(d), known) for i, d in sorted(view.descriptors.items()) if i != receiver}
