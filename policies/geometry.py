"""Overlap of footprints, from descriptor fields alone, for several policies."""

from __future__ import annotations

from math import hypot

from sortie.policies.contract import Descriptor, FleetView
from sortie.scenarios.disc import disc_overlap, rank_by_overlap


def footprint_overlap(a: Descriptor, b: Descriptor) -> float:
    """The share of drone a's nadir footprint that drone b's covers, 0 … 1."""
    (ax, ay, _), (bx, by, _) = a.position_m, b.position_m
    return disc_overlap(hypot(ax - bx, ay - by), a.footprint_radius_m, b.footprint_radius_m)


def peers_by_overlap(view: FleetView, receiver: int | None = None) -> list[int]:
    """The other drones in the view by footprint overlap with one drone, largest first (`rank_by_overlap`).

    Args:
        view: the fleet's latest descriptors.
        receiver: the drone whose peers are ranked; None is the ego.
    """
    of = view.ego if receiver is None else receiver
    me = view.descriptors.get(of)
    if me is None:
        return []
    radius_m, (x_m, y_m, _) = me.footprint_radius_m, me.position_m
    overlap = {}
    for p, peer in view.descriptors.items():  # written out: a policy spends most of its time here
        if p != of:
            px_m, py_m, _ = peer.position_m
            away_m, other_m = hypot(x_m - px_m, y_m - py_m), peer.footprint_radius_m
            overlap[p] = disc_overlap(away_m, radius_m, other_m) if away_m < radius_m + other_m else 0.0
    return rank_by_overlap(of, overlap)
