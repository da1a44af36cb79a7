"""Overlap of footprints, from descriptor fields alone, for several policies."""

from __future__ import annotations

from functools import cache
from itertools import chain
from math import hypot
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
    ids, each = list(known), known.values()
    position_m = np.fromiter(chain.from_iterable([d.position_m for d in each]), np.float64)
    radius_m = np.array([d.footprint_radius_m for d in each], np.float64)
    places = places_loop()(ids.index(of), np.array(ids), position_m, radius_m)
    places.sort()
    ranked: list[int] = ((of + places) % AGENT_IDS).tolist()
    return ranked


@cache
def places_loop() -> Any:
    """The compiled loop, imported and made ready at its first use: before a flight, for decisions may have little time."""
    from sortie.policies.overlap_loops import places

    places(0, np.zeros(1, np.int64), np.zeros(3), np.zeros(1))
    return places
