"""Overlap of footprints, from descriptor fields alone, for several policies."""

from __future__ import annotations

from math import acos, copysign, hypot, pi, sqrt

from sortie.policies.contract import AGENT_IDS, Descriptor, FleetView

OVERLAP_STEP = 0.1
"""Overlaps are ranked in steps of a tenth, so that a metre of pose jitter does not reorder the peers."""


def circle_overlap(distance_m: float, radius_a_m: float, radius_b_m: float) -> float:
    """Area shared by two discs over the area of the smaller one, 0 … 1.

    Source: the lens formula (Weisstein, "Circle-Circle Intersection").
    """
    small, large = radius_a_m, radius_b_m
    if small > large:
        small, large = large, small
    if small <= 0 or distance_m >= small + large:
        return 0.0
    if distance_m <= large - small:
        return 1.0
    d2, r2, s2 = distance_m * distance_m, small * small, large * large
    a, b = (d2 + r2 - s2) / (2 * distance_m * small), (d2 + s2 - r2) / (2 * distance_m * large)
    # Rounding can push the cosines past ±1 when the circles barely touch.
    a, b = a if -1.0 < a < 1.0 else copysign(1.0, a), b if b < 1.0 else 1.0
    # A sector less its triangle, of each circle; the triangles have the same height.
    share = (r2 * acos(a) + s2 * acos(b) - distance_m * small * sqrt(1.0 - a * a)) / (pi * r2)
    return 0.0 if share < 0.0 else share if share < 1.0 else 1.0


def footprint_overlap(a: Descriptor, b: Descriptor) -> float:
    """Overlap of two drones' nadir footprints, 0 … 1, of the smaller footprint."""
    (ax, ay, _), (bx, by, _) = a.position_m, b.position_m
    return circle_overlap(hypot(ax - bx, ay - by), a.footprint_radius_m, b.footprint_radius_m)


def peers_by_overlap(view: FleetView) -> list[int]:
    """Peers in order of footprint overlap with the ego, largest first, in steps of `OVERLAP_STEP`.

    Ties are broken by id, beginning after the ego, so that drones in one place do not all choose the same peers.
    """
    me = view.me
    if me is None:
        return []
    ego, radius_m, (x_m, y_m, _) = view.ego, me.footprint_radius_m, me.position_m
    ranked = []
    for p, peer in view.descriptors.items():  # written out: a policy spends most of its time here
        if p != ego:
            px_m, py_m, _ = peer.position_m
            overlap = circle_overlap(hypot(x_m - px_m, y_m - py_m), radius_m, peer.footprint_radius_m)
            ranked.append((-round(overlap / OVERLAP_STEP), (p - ego) % AGENT_IDS, p))
    ranked.sort()
    return [p for _, _, p in ranked]
