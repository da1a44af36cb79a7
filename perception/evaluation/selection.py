"""Which peers share with an ego, and how a budget is divided among them and their cells. Pure; free of torch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from sortie.perception.budget import CELLS, Bools, index_bytes, payload_bytes, ranking, roi_mask
from sortie.perception.errors import InputError
from sortie.perception.evaluation.condition import Allocation, Sharing
from sortie.perception.geometry import FULL, Geometry
from sortie.scenarios.disc import Disc, disc_overlap, rank_by_overlap
from sortie.scenarios.streams import stream

FOOTPRINT_M = 60.0 * math.tan(math.radians(35.0))
"""The paper's 42 m: the radius that a 70° lens sees from 60 m."""

Floats = NDArray[np.float64]


def footprint_overlap(xy_m: Floats, radius_m: Floats) -> Floats:
    """[d, d]: the share of drone i's footprint that drone j's covers, 0 … 1, from positions [d, 2] and radii [d]."""
    at = list(zip(xy_m.tolist(), radius_m.tolist(), strict=True))
    return np.array([[disc_overlap(math.dist(p, q), r, s) for q, s in at] for p, r in at])


def choose(condition: Sharing, ego: int, overlap: Floats, key: tuple[int, ...] = (), seed: int = 0) -> tuple[int, ...]:
    """The peers that share with `ego`: all of them by ascending id, or the chosen ones, most overlapping first.

    Args:
        condition: gives the rule for `peers`.
        ego: the receiver.
        overlap: [d] the share of the ego's footprint that each drone's covers.
        key: names the frame, so that random peers are its own whatever else is evaluated.
        seed: of the random peers.

    Raises:
        InputError: more peers than there are, or all-k where the fleet has another number.
    """
    others = [i for i in range(len(overlap)) if i != ego]
    if condition.k > len(others) or (condition.rule == "all" and condition.k != len(others)):
        raise InputError(f"peers is {condition.peers!r}, must fit a fleet with {len(others)} peers")
    if condition.rule == "all":
        return tuple(others)
    ranked = rank_by_overlap(ego, {i: float(overlap[i]) for i in others})
    if condition.rule == "worst":
        ranked = ranked[len(ranked) - condition.k :]
    elif condition.rule == "random":
        drawn = stream(seed, 0, (*key, ego), "harness.random_peers").permutation(len(ranked))[: condition.k]
        ranked = [ranked[i] for i in sorted(drawn.tolist())]
    return tuple(ranked[: condition.k])


def allocate(total: int, overlap: Sequence[float], allocation: Allocation, most: int = CELLS) -> list[int]:
    """Divide `total` cells among the chosen peers: their sum is `total` unless every peer sends all it has.

    Quotas are equal or proportional to `overlap`; a peer whose quota passes `most` sends all and the rest is parted
    anew among the others (alike, where none of those overlaps). Quotas are rounded down, and the cells that are left
    over go one each by the largest fraction, and equal fractions by place in the list.
    """
    k = len(overlap)
    share = [Fraction(float(o)) if allocation == "overlap" else Fraction(1) for o in overlap]
    out = [0] * k
    open_, left = list(range(k)), total
    while open_:
        if not sum(share[i] for i in open_):
            share = [Fraction(1)] * k
        whole = sum(share[i] for i in open_)
        quota = {i: share[i] * left / whole for i in open_}
        full = [i for i in open_ if quota[i] >= most]
        if not full:
            for i in open_:
                out[i] = math.floor(quota[i])
            spare = left - sum(out[i] for i in open_)
            for i in sorted(open_, key=lambda i: (out[i] - quota[i], i))[:spare]:
                out[i] += 1
            return out
        for i in full:
            out[i] = most
            left -= most
            open_.remove(i)
    return out


def in_disc(pose: Floats, disc: Disc, geometry: Geometry = FULL) -> Bools:
    """[d, 64, 64]: the cells whose centres lie in the disc, on the grids of drones at `pose` [d, 3] (x, y, yaw)."""
    return np.stack([roi_mask(disc, x, y, yaw, geometry.cell_m) for x, y, yaw in pose.tolist()])


def sending_order(rank: NDArray[np.floating], first: Bools | None = None) -> NDArray[np.int16]:
    """[d, 64, 64]: each cell's place in its sender's order, 0 sent first; a budget of b cells sends `order < b`.

    Unlike a sortie's region of interest, which sends nothing from outside it, `first` only comes before the rest.
    """
    place = np.empty((len(rank), CELLS), np.int16)
    np.put_along_axis(place, ranking(rank, first), np.arange(CELLS, dtype=np.int16)[None], axis=1)
    return place.reshape(rank.shape)


def link_bytes(cells: Sequence[int]) -> tuple[int, int]:
    """Bytes to one ego: payload (cells × 80 × 2) and, apart, the index (512 B bitmap or 12 bits a cell, per link)."""
    return sum(payload_bytes(c) for c in cells), sum(index_bytes(c) for c in cells)
