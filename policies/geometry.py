"""Overlap of footprints, from descriptor fields alone, for several policies."""

from __future__ import annotations

from functools import cache
from math import hypot
from struct import pack
from typing import Any

import numpy as np

from sortie.policies.contract import Descriptor, FleetView
from sortie.scenarios.disc import AGENT_IDS, disc_overlap


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
    known = view.descriptors
    if of not in known:
        return []
    n, numbers = len(known), [d.footprint_radius_m for d in known.values()]
    for d in known.values():
        numbers += d.position_m
    packed = pack(f"{n}q{4 * n}d", *known, *numbers)  # takes half the time that an array of a list does
    places = places_loop()(of, np.frombuffer(packed, np.int64, n), np.frombuffer(packed, np.float64, -1, 8 * n))
    places.sort()
    places += of
    places %= AGENT_IDS
    ranked: list[int] = places.tolist()
    return ranked


@cache
def places_loop() -> Any:
    """The compiled loop, imported and made ready at its first use: before a flight, for decisions may have little time."""
    from sortie.policies.overlap_loops import places

    packed = bytes(40)  # read-only, as those in flight
    places(0, np.frombuffer(packed, np.int64, 1), np.frombuffer(packed, np.float64, 4, 8))
    return places
