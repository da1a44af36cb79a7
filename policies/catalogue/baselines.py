"""Fixed policies for comparisons. They choose the same way in every context.

There are two experiments, and each has its own names:

- `all-4`, `best-2`, `worst-2`, `random-2`: each *receiver* has k senders. This is the paper's condition, and the
  evaluation of recorded frames (`sortie.perception.evaluation`) means the same by these names. The budget is the number
  of cells that one ego receives.
- `best-2-receivers`, `worst-2-receivers`, `random-2-receivers`: each *sender* has k receivers. The budget is the number
  of cells that one drone sends. Drones at the edge of the formation then receive little or nothing.

A budget is a share of full sharing: N − 1 whole maps in a fleet of N drones. k links share it evenly, up to a whole map
each, so policies with different k carry the same bytes.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Collection, Sequence
from math import floor

from sortie.policies.catalogue.attached import among_attached
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.contract import FEATURE_CELLS, Directive, FleetView, boxes_across_networks, nothing, nothing_to_all
from sortie.policies.geometry import peers_by_overlap

RESHUFFLE_S = 10
"""How often random-k draws new peers: longer than usual dwell times, so that links can be upgraded."""


# --- each receiver has k senders -------------------------------------------------------------------


@among_attached
@boxes_across_networks
def everyone(view: FleetView, *, received_budget: float = 1.0) -> list[Directive]:
    """Features to every peer (all-4 at N = 5), whatever the context.

    Args:
        view: the fleet's latest descriptors.
        received_budget: cells that each ego receives, as a share of full sharing.
    """
    if view.me is None:
        return []
    # the cells left over go to the lowest ids, which costs no ranking of every receiver's senders
    place, maps = sorted(view.descriptors).index(view.ego), view.full_sharing_maps
    return [
        full_sharing(view.ego, p, _rho(received_budget, maps, place - (p < view.ego), maps), "fixed: every peer")
        for p in view.peers
    ]


@among_attached
@boxes_across_networks
def best_k(view: FleetView, *, k: int = 2, received_budget: float = 1.0) -> list[Directive]:
    """Each receiver gets features from the k peers that cover most of its footprint; the budget is as for `all-4`."""
    return _serve(
        view, k, received_budget, f"the {k} that cover most of the receiver's footprint", lambda _, by: by[:k]
    )


@among_attached
@boxes_across_networks
def worst_k(view: FleetView, *, k: int = 2, received_budget: float = 1.0) -> list[Directive]:
    """Each receiver gets features from the k peers that cover least of its footprint; the budget is as for `all-4`."""
    what = f"the {k} that cover least of the receiver's footprint"
    return _serve(view, k, received_budget, what, lambda _, by: by[max(0, len(by) - k) :])


@among_attached
@boxes_across_networks
def random_k(view: FleetView, *, k: int = 2, received_budget: float = 1.0, salt: int = 0) -> list[Directive]:
    """Each receiver gets features from k peers drawn anew every ten seconds; the budget is as for `all-4`.

    The draw is a pure function of the receiver's id, its stamp and the salt, so all senders draw alike.
    """

    def draw(receiver: int, by_overlap: list[int]) -> list[int]:
        drawn = _draw(view, salt, receiver, by_overlap, k)
        return [i for i in by_overlap if i in drawn]

    return _serve(view, k, received_budget, f"{k} drawn at random", draw)


def _serve(
    view: FleetView, k: int, received_budget: float, what: str, choose: Callable[[int, list[int]], Sequence[int]]
) -> list[Directive]:
    """The ego's part in serving every receiver.

    Args:
        k: how many senders serve a receiver in a fleet that hears everybody.
        received_budget: cells that each ego receives, as a share of full sharing.
        what: which senders serve, as text for the reason.
        choose: from a receiver and all its possible senders, those that cover most first, to those that serve it.
    """
    directives, maps = [], view.full_sharing_maps
    for peer in view.peers:
        senders = choose(peer, peers_by_overlap(view, peer))
        if view.ego in senders:
            rho = _rho(received_budget, maps, senders.index(view.ego), min(k, maps))
            directives.append(full_sharing(view.ego, peer, rho, f"fixed: {what}"))
        else:
            directives.append(nothing(view.ego, peer, f"fixed: not among {what}"))
    return directives


def _rho(received_budget: float, maps: int, place: int, k: int) -> float:
    """The share of its map that one of k senders sends: whole cells, those left over one each to the first senders.

    It depends on the roster alone, so that senders who hear different drones send the same share.
    """
    each, spare = divmod(floor(received_budget * maps * FEATURE_CELLS + 1e-9), k)
    return min(1.0, (each + (place < spare)) / FEATURE_CELLS)


# --- each sender has k receivers -------------------------------------------------------------------


@among_attached
@boxes_across_networks
def best_k_receivers(view: FleetView, *, k: int = 2, sent_budget: float = 1.0) -> list[Directive]:
    """Each drone sends features to the k peers that cover most of its own footprint.

    Args:
        view: the fleet's latest descriptors.
        k: how many receivers.
        sent_budget: cells that a drone sends over all its links, as a share of full sharing.
    """
    return _send_to(view, peers_by_overlap(view)[:k], sent_budget, f"the {k} that cover most of the sender's footprint")


@among_attached
@boxes_across_networks
def worst_k_receivers(view: FleetView, *, k: int = 2, sent_budget: float = 1.0) -> list[Directive]:
    """Each drone sends features to the k peers that cover least of its own footprint; as `best-2-receivers`."""
    return _send_to(
        view, peers_by_overlap(view)[::-1][:k], sent_budget, f"the {k} that cover least of the sender's footprint"
    )


@among_attached
@boxes_across_networks
def random_k_receivers(view: FleetView, *, k: int = 2, sent_budget: float = 1.0, salt: int = 0) -> list[Directive]:
    """Each drone sends features to k peers drawn anew every ten seconds; as `best-2-receivers`."""
    return _send_to(view, _draw(view, salt, view.ego, view.peers, k), sent_budget, f"{k} drawn at random")


def _send_to(view: FleetView, chosen: Collection[int], sent_budget: float, what: str) -> list[Directive]:
    rho = min(1.0, sent_budget * view.full_sharing_maps / len(chosen)) if chosen else 0.0
    return [
        full_sharing(view.ego, p, rho, f"fixed: {what}")
        if p in chosen
        else nothing(view.ego, p, f"fixed: not among {what}")
        for p in view.peers
    ]


def _draw(view: FleetView, salt: int, whose: int, among: Sequence[int], k: int) -> list[int]:
    """k of some drones, a pure function of the salt and of the id and the stamp of the drone that they are drawn for."""
    d = view.descriptors.get(whose)
    epoch = 0 if d is None else d.stamp_ns // (RESHUFFLE_S * 1_000_000_000)
    draw = random.Random(f"{salt}/{whose}/{epoch}")  # noqa: S311 - a lottery, not a secret
    return draw.sample(sorted(among), min(k, len(among)))


@among_attached
def silence(view: FleetView) -> list[Directive]:
    """Nothing to anyone: five single drones."""
    return list(nothing_to_all(view.ego, view.peers, "fixed: silence"))
