"""Overlap of footprints, from descriptor fields alone, for several policies."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from math import hypot
from operator import is_
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sortie.policies.contract import Descriptor, FleetView
from sortie.scenarios.disc import disc_overlap


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
    return ranking(view, of) if of in view.descriptors else []


def _by_footprints(view: FleetView, of: int) -> list[int]:
    known = view.descriptors
    whole, noted, at, circles = _latest
    if known is whole:
        ids = at
    else:
        at = ids = np.fromiter(known, np.int64, len(known))
        if not all(map(is_, map(noted.get, known), known.values())):
            numbers: list[float] = []
            for d in known.values():
                numbers += (*d.position_m[:2], d.footprint_radius_m)
            at, circles = np.arange(len(ids)), np.fromiter(numbers, np.float64, len(numbers)).reshape(-1, 3)
    ranked: list[int] = rank_loop()(of, ids, at, circles).tolist()
    return ranked


ranking: Callable[[FleetView, int], list[int]] = _by_footprints
"""Ranks the peers of a drone in the view; a proof searches every order in place of positions."""

_Noted = tuple[Mapping[int, Descriptor] | None, Mapping[int, Descriptor], NDArray[np.int64], NDArray[np.float64]]
_latest: _Noted = None, {}, np.zeros(0, np.int64), np.zeros((0, 3))


def note_circles(
    descriptors: dict[int, Descriptor], ids: NDArray[np.int64], circles: NDArray[np.float64]
) -> Mapping[int, Descriptor]:
    """Give the footprints of descriptors that are about to be ranked as an array, which takes longer to make of them than to rank.

    Args:
        descriptors: they and the arrays must not change any more. Views of some of them rank by the array too.
        ids: theirs, in order.
        circles: [ids, 3], x, y and radius, m.

    Returns:
        The descriptors as the view is to have them, to be read only.
    """
    global _latest
    shown = MappingProxyType(descriptors)
    _latest = shown, descriptors, ids, circles
    return shown


@cache
def rank_loop() -> Any:
    """The compiled loop, imported and made ready at its first use: before a flight, for decisions may have little time."""
    from sortie.policies.overlap_loops import ranked

    one = np.zeros(1, np.int64)
    ranked(0, one, one, np.zeros((1, 3)))
    return ranked
