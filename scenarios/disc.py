"""A disc on the ground, the share of one disc that another covers, and the order of peers by that share."""

from __future__ import annotations

from collections.abc import Mapping
from math import acos, copysign, pi, sqrt
from typing import NamedTuple

AGENT_IDS = 1 << 16
"""How many drone ids there are: an id is two bytes."""
LISTED_IDS = 200
"""In fleets up to this size a descriptor lists goodput by id; in larger ones to the members of its roster."""
LISTED_MEMBERS = 128
"""So many members a roster may have in a larger fleet: their ids and goodputs fit into a descriptor, with 86 B to spare
for its other sequences and fields."""
OVERLAP_STEP = 0.1
"""Overlaps are ranked in steps of a tenth, so that a metre of pose jitter does not reorder the peers."""


class Disc(NamedTuple):
    """A disc on the ground, ENU, metres. It is a mission's region, or the region of interest of a link."""

    x_m: float
    y_m: float
    radius_m: float


def disc_overlap(distance_m: float, radius_m: float, other_radius_m: float) -> float:
    """The share of a disc that another disc covers, 0 … 1; 0 for a disc without area.

    Source: the lens formula (Weisstein, "Circle-Circle Intersection").

    Args:
        distance_m: between the centres.
        radius_m: of the disc whose area the share is of.
        other_radius_m: of the other disc.

    Example:
        >>> disc_overlap(0.0, 40.0, 20.0), disc_overlap(0.0, 20.0, 40.0)
        (0.25, 1.0)
    """
    a_m, b_m = radius_m, other_radius_m
    if a_m <= 0 or b_m <= 0 or distance_m >= a_m + b_m:
        return 0.0
    if distance_m <= abs(a_m - b_m):
        return 1.0 if a_m <= b_m else (b_m / a_m) ** 2
    d2, a2, b2 = distance_m * distance_m, a_m * a_m, b_m * b_m
    cos_a, cos_b = (d2 + a2 - b2) / (2 * distance_m * a_m), (d2 + b2 - a2) / (2 * distance_m * b_m)
    # Rounding can push the cosines past ±1 when the circles barely touch.
    cos_a = cos_a if -1.0 < cos_a < 1.0 else copysign(1.0, cos_a)
    cos_b = cos_b if -1.0 < cos_b < 1.0 else copysign(1.0, cos_b)
    # A sector less its triangle, of each circle; the triangles have the same height.
    share = (a2 * acos(cos_a) + b2 * acos(cos_b) - distance_m * a_m * sqrt(1.0 - cos_a * cos_a)) / (pi * a2)
    return 0.0 if share < 0.0 else share if share < 1.0 else 1.0


def rank_by_overlap(ego: int, overlap: Mapping[int, float]) -> list[int]:
    """Peers by the overlap of their footprint with the ego's, largest first, in steps of `OVERLAP_STEP`.

    Ties are broken by id, beginning after the ego, so that drones in one place do not all choose the same peers.
    Policies in flight and the evaluation of recorded frames both rank peers by this function.

    Args:
        ego: the id of the drone that receives, 0 … 65,535.
        overlap: by peer, the share of the ego's footprint that the peer's footprint covers, 0 … 1.
    """
    # the step and the way round in one number, from which the id can be read again; most peers of a large fleet have 0
    places = [(p - ego) % AGENT_IDS - AGENT_IDS * (round(o / OVERLAP_STEP) if o else 0) for p, o in overlap.items()]
    return [(ego + place) % AGENT_IDS for place in sorted(places)]
