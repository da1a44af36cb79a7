"""Overlap of footprints, from descriptor fields alone, for several policies."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from math import hypot
from operator import is_
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    ids = np.fromiter(known, np.int64, len(known))
    noted, circles = _latest
    if all(map(is_, map(noted.get, known), known.values())):
        at = ids
    else:
        numbers: list[float] = []
        for d in known.values():
            numbers += (*d.position_m[:2], d.footprint_radius_m)
        at, circles = np.arange(len(ids)), np.fromiter(numbers, np.float64, len(numbers)).reshape(-1, 3)
    places = places_loop()(of, ids, at, circles)
    places.sort()
    places += of
    places %= AGENT_IDS
    ranked: list[int] = places.tolist()
    return ranked


_latest: tuple[Mapping[int, Descriptor], NDArray[np.float64]] = {}, np.zeros((0, 3))


def note_circles(descriptors: Mapping[int, Descriptor], circles: NDArray[np.float64]) -> None:
    """Give the footprints of descriptors that are about to be ranked as an array, which takes longer to make of them than to rank.

    Args:
        descriptors: they and the array must not change any more. Views of some of them rank by the array too.
        circles: [ids, 3], x, y and radius, m.
    """
    global _latest
    _latest = descriptors, circles


@cache
def places_loop() -> Any:
    """The compiled loop, imported and made ready at its first use: before a flight, for decisions may have little time."""
    from sortie.policies.overlap_loops import places

    one = np.zeros(1, np.int64)
    places(0, one, one, np.zeros((1, 3)))
    return places
