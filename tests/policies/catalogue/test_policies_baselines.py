"""Fixed policies: who serves whom, that all senders agree about it, and that a budget is spent to the cell."""

from __future__ import annotations

import math
from collections import Counter
from itertools import combinations, product
from typing import Any

import pytest
from policies_examples import by_peer, changed, fleet_of, without

from sortie.perception.budget import cells_in
from sortie.policies.catalogue import adaptive, baselines
from sortie.policies.contract import FEATURE_CELLS, FleetView, Representation
from sortie.policies.geometry import peers_by_overlap
from sortie.policies.registry import POLICIES

FEATURES = Representation.FEATURES
PAIRS = set(combinations(range(1, 5), 2))
BY_RECEIVER = (baselines.everyone, baselines.best_k, baselines.worst_k, baselines.random_k)
BY_SENDER = (baselines.best_k_receivers, baselines.worst_k_receivers, baselines.random_k_receivers)


def receivers(name: str, sender: int = 0, **params: object) -> list[int]:
    """To whom a drone of a line sends; drone 0 is at one end."""
    view = fleet_of(5)._replace(ego=sender)
    return [d.destination for d in POLICIES[name](view, **params) if d.representation != Representation.NONE]


def senders(name: str, receiver: int, **params: object) -> set[int]:
    return {i for i in range(5) if i != receiver and receiver in receivers(name, i, **params)}


def received_cells(policy: Any, view: FleetView, **params: object) -> Counter[int]:
    """How many cells each drone gets from all others together."""
    cells = Counter[int]()
    for ego in view.descriptors:
        for d in policy(view._replace(ego=ego), **params):
            cells[d.destination] += cells_in(d.rho) if d.representation == FEATURES else 0
    return cells


def test_the_receiver_chooses_its_senders() -> None:
    """Each receiver of a line has the two nearest, or the two farthest, senders."""
    assert [senders("best-2", r) for r in range(5)] == [{1, 2}, {0, 2}, {1, 3}, {2, 4}, {2, 3}]
    assert [senders("worst-2", r) for r in (0, 4)] == [{3, 4}, {0, 1}]
    assert [senders("all-4", r) for r in range(5)] == [set(range(5)) - {r} for r in range(5)]
    assert {tuple(sorted(senders("random-2", 0, salt=s))) for s in range(40)} == PAIRS


def test_the_sender_chooses_its_receivers() -> None:
    assert receivers("best-2-receivers") == [1, 2]
    assert receivers("worst-2-receivers") == [3, 4]
    assert receivers("silence") == []
    assert {tuple(receivers("random-2-receivers", salt=s)) for s in range(40)} == PAIRS


def test_every_receiver_gets_the_budget_to_the_cell_and_no_link_more_than_a_map() -> None:
    """Matched bytes over all senders together, also where the budget cannot be shared evenly, of 1 cell and of all."""
    view, cells_of_all = fleet_of(5), 4 * FEATURE_CELLS
    for policy, cells in product(BY_RECEIVER, (1, 2, 3, 5, 7, 327, 4096, 4099, cells_of_all)):
        most = cells_of_all if policy is baselines.everyone else 2 * FEATURE_CELLS
        budget = min(1.0, (cells + 0.5) / cells_of_all)
        found = received_cells(policy, view, received_budget=budget)
        assert found == dict.fromkeys(range(5), min(cells, most)), policy.__name__


def test_every_sender_spends_its_whole_budget_up_to_a_map_a_link() -> None:
    for policy, budget in product(BY_SENDER, (0.02, 0.05, 0.1, 0.25, 1.0)):
        directives = policy(fleet_of(5), sent_budget=budget)
        spent = math.fsum(d.rho for d in directives if d.representation == FEATURES)
        assert spent == pytest.approx(min(budget * 4, 2)), policy.__name__


@pytest.mark.parametrize("heard", [1, 2, 4])
def test_a_budget_is_of_the_fleet_whoever_was_heard(heard: int) -> None:
    """In a fleet of five with some unknown: links that there are get what they would get, up to a whole map."""
    view = without(fleet_of(5), *range(heard + 1, 5))
    assert view.full_sharing_maps == 4
    for d in baselines.everyone(view, received_budget=0.1):
        assert d.rho == pytest.approx(0.1, abs=1 / FEATURE_CELLS)
    for policy in BY_SENDER:
        sending = [d.rho for d in policy(view, k=2, sent_budget=0.1) if d.rho]
        assert sending == pytest.approx([0.4 / min(2, heard)] * min(2, heard))
    fast = changed(view, peer_goodput_mbps=(4000.0,) * 4)
    sending = [d.rho for d in adaptive.spend(fast, adaptive.MAPS, 0.1, "x")]
    assert sending == pytest.approx([0.4 / heard] * heard)


def test_senders_who_hear_different_drones_send_the_same_share() -> None:
    whole = fleet_of(5)._replace(ego=1)
    for policy, rho in ((baselines.everyone, 0.125), (baselines.best_k, 0.25)):
        for view in (whole, without(whole, 2, 3, 4)):
            assert by_peer(policy(view, received_budget=0.125))[0].rho == rho


def test_more_senders_than_there_are_leave_nothing_of_the_budget_over() -> None:
    """Each receiver gets it from those that there are."""
    for policy, (drones, k) in product(BY_RECEIVER[1:], ((2, 1), (2, 2), (2, 5), (3, 3), (5, 4), (5, 7))):
        found = received_cells(policy, fleet_of(drones), k=k, received_budget=0.4)
        assert found == dict.fromkeys(range(drones), math.floor(0.4 * (drones - 1) * FEATURE_CELLS))


def test_k_senders_serve_each_receiver_and_all_agree_who() -> None:
    """Though their clocks, and so their own stamps, differ."""
    view = fleet_of(5)
    for i in range(5):
        view = changed(view, i, stamp_ns=(3 + 20 * i) * 1_000_000_000)
    for policy, k in product(BY_RECEIVER[1:], (0, 1, 2, 3)):
        served = Counter(dict.fromkeys(range(5), 0))
        for ego in range(5):
            served.update(d.destination for d in policy(view._replace(ego=ego), k=k) if d.representation == FEATURES)
        assert served == dict.fromkeys(range(5), k), policy.__name__


@pytest.mark.parametrize("k", [0, 1, 3, 4, 7])
def test_a_drone_sends_to_k_receivers_and_the_worst_are_the_last_of_its_order(k: int) -> None:
    view = fleet_of(5)
    sent = {policy: [d.destination for d in policy(view, k=k) if d.representation == FEATURES] for policy in BY_SENDER}
    assert {len(to) for to in sent.values()} == {min(k, 4)}
    assert sorted(sent[baselines.worst_k_receivers]) == sorted(peers_by_overlap(view)[4 - min(k, 4) :])


def test_random_senders_differ_by_receiver_epoch_and_salt() -> None:
    """All senders draw alike, and apart for each receiver, each ten seconds and each salt."""
    view = changed(fleet_of(5), position_m=(0.0, 0.0, 60.0))

    def draw(receiver: int, at_s: float, salt: int = 0) -> tuple[int, ...]:
        now = changed(view, stamp_ns=round(at_s * 1e9))
        others = [i for i in range(5) if i != receiver]
        return tuple(
            i for i in others if by_peer(baselines.random_k(now._replace(ego=i), k=2, salt=salt))[receiver].rho
        )

    assert len({draw(0, 0.5 * half) for half in range(20)}) == 1
    epochs = [draw(0, 10.0 * e) for e in range(30)]
    salted = [draw(0, 10.0 * e, salt=1) for e in range(30)]
    assert len(set(epochs)) == len(set(salted)) == 6  # every pair of four comes up
    same = [sum(a == b for a, b in zip(epochs, salted, strict=True))]
    for r in range(1, 5):  # those of another receiver: by distance in the round of ids, and by place among its peers
        drawn = [draw(r, 10.0 * e) for e in range(30)]
        distance = [tuple(sorted((i - r) % 5 for i in two)) for two in drawn]
        place = [tuple(i + 1 if i < r else i for i in two) for two in drawn]
        same += [sum(a == b for a, b in zip(epochs, other, strict=True)) for other in (distance, place)]
    assert max(same) < 15
    at = [changed(view, stamp_ns=e * 10**10) for e in range(30)]
    assert len({tuple(d.destination for d in baselines.random_k_receivers(v) if d.rho) for v in at}) == 6
