"""Key against query, for methods that match drones by what they see: coverage grids stand in for learned vectors."""

from __future__ import annotations

from sortie.policies.catalogue.coverage_cells import new_share, seen_well
from sortie.policies.contract import FleetView


def scores_for(view: FleetView, receiver: int) -> dict[int, float]:
    """How far each other drone answers a receiver, 0 … 1: the share of what it sees well that the receiver does not."""
    known = seen_well(view.descriptors[receiver])
    return {i: new_share(seen_well(d), known) for i, d in sorted(view.descriptors.items()) if i != receiver}
