"""Fixed policies for comparisons: every peer, the best, worst or random k peers, and silence.

`rho` is the paper's budget: what one drone sends, summed over its links, as a fraction of full sharing.
k peers share it evenly, so policies with different k send the same bytes (up to a full map per link).
"""

from __future__ import annotations

import random
from collections.abc import Sequence

from sortie.policies.catalogue.prior.full import RATE_HZ
from sortie.policies.contract import Directive, FleetView, Representation, nothing
from sortie.policies.geometry import peers_by_overlap

RESHUFFLE_S = 10
"""How often random-k draws new peers: longer than usual dwell times, so that links can be upgraded."""


def _share_with(view: FleetView, chosen: Sequence[int], rho: float, why: str) -> list[Directive]:
    per_link = min(1.0, rho * len(view.peers) / len(chosen)) if chosen else 0.0
    return [
        Directive(view.ego, p, Representation.FEATURES, per_link, None, RATE_HZ, reason=why)
        if p in chosen
        else nothing(view.ego, p, f"fixed: not {why.removeprefix('fixed: ')}")
        for p in view.peers
    ]


def everyone(view: FleetView, *, rho: float = 1.0) -> list[Directive]:
    """Features to every peer (all-4 at N = 5), whatever the context."""
    return _share_with(view, view.peers, rho, "fixed: every peer")


def best_k(view: FleetView, *, k: int = 2, rho: float = 1.0) -> list[Directive]:
    """Features to the k peers whose footprints overlap most with the ego's."""
    return _share_with(view, peers_by_overlap(view)[:k], rho, f"fixed: {k} most overlapping")


def worst_k(view: FleetView, *, k: int = 2, rho: float = 1.0) -> list[Directive]:
    """Features to the k peers whose footprints overlap least with the ego's."""
    return _share_with(view, peers_by_overlap(view)[::-1][:k], rho, f"fixed: {k} least overlapping")


def random_k(view: FleetView, *, k: int = 2, rho: float = 1.0, salt: int = 0) -> list[Directive]:
    """Features to k peers drawn anew every `RESHUFFLE_S`; a pure function of the ego's stamp, id and the salt."""
    me = view.me
    epoch = 0 if me is None else me.stamp_ns // (RESHUFFLE_S * 1_000_000_000)
    draw = random.Random(f"{salt}/{view.ego}/{epoch}")  # noqa: S311 - a lottery, not a secret
    peers = list(view.peers)
    return _share_with(view, draw.sample(peers, min(k, len(peers))), rho, f"fixed: {k} random")


def silence(view: FleetView) -> list[Directive]:
    """Nothing to anyone: five single drones."""
    return [nothing(view.ego, p, "fixed: silence") for p in view.peers]
