"""What one drone keeps and believes: payloads that came, claims of its peers, and what each claim answers for."""

from __future__ import annotations

from itertools import product
from typing import Any

import pytest
from agent_rig import RULES, capture, descriptor, memory, payload
from fleet_examples import DESCRIPTOR

from sortie.fleet.chart import Chart
from sortie.fleet.clock import WINDOW
from sortie.fleet.gate import Payload
from sortie.fleet.memory import PeerMemory, Received
from sortie.fleet.plane import DroneStatus, Equipment
from sortie.policies.contract import FleetView, Representation

FULL_GRID = b"\xff" * 64
"""More than any camera sees: a doubt in itself."""
POOR_GRID = b"\x55" * 64
"""No doubt in itself."""


def came(rung: Representation, t_s: float, t_done_s: float, size: int = 20_000, **of: Any) -> Received:
    return Received(capture(1, t_s), payload(size, rung)._replace(**of), t_done_s, t_s)


# --- payloads that came -----------------------------------------------------------------------------------


def test_the_newest_capture_is_held_whenever_it_came() -> None:
    """Of two payloads of one capture the later is held; on the ground none."""
    mine = memory()
    new, old = (came(Representation.FEATURES, t, done) for t, done in ((0.5, 0.6), (0.4, 0.7)))
    mine.receive(new)
    mine.receive(old)
    assert mine.held[1] is new
    same = came(Representation.DETECTIONS, 0.5, 0.8)
    mine.receive(same)
    assert mine.held[1] is same
    mine.status.airborne = False
    mine.receive(came(Representation.FEATURES, 0.9, 1.0))
    assert mine.held[1] is same


def test_every_byte_and_every_map_that_came_is_work() -> None:
    mine = memory()
    rungs = (Representation.FEATURES, Representation.CODES, Representation.RAW, Representation.TRACKS)
    for k, rung in enumerate(rungs):
        mine.receive(came(rung, 0.1 * k, 0.1 * k + 0.05, 100))
    assert (mine.status.work.maps, mine.status.work.payload_bytes) == (3, 400)


def test_how_long_a_payload_took_leaves_out_its_sender_s_compute_delay() -> None:
    """Its own, not the receiver's."""
    mine = memory(makes={0: Equipment(0.3), 1: Equipment(0.08), 2: Equipment(0.0)})
    for peer in (1, 2):
        mine.receive(Received(capture(peer, 1.0), payload(), 1.1, 1.0))
    took = {peer: mine._arrivals[peer][0].took_s for peer in (1, 2)}
    assert took == pytest.approx({1: 0.02, 2: 0.1})


def test_maps_of_another_network_and_codes_of_another_codebook_cannot_be_fused() -> None:
    """Without a network no map can; boxes always can."""
    here, there, none = DroneStatus(feature_space="own", codebook="0" * 14), DroneStatus(), DroneStatus(looks=False)
    rungs = (Representation.FEATURES, Representation.CODES, Representation.RAW, Representation.UNCERTAIN_BOXES)
    own = {r: payload(rung=r)._replace(feature_space="own", codebook="0" * 14) for r in rungs}
    foreign = {r: payload(rung=r) for r in rungs}

    def fused(status: DroneStatus, sent: dict[Representation, Payload]) -> list[Representation]:
        mine = PeerMemory(0, RULES, status)
        usable = [r for r, its in sent.items() if mine.can_fuse(its)]
        for its in sent.values():
            mine.receive(Received(capture(1, 0.0), its, 0.1, 0.0))
        assert mine.held[1].payload is sent[usable[-1]]
        return usable

    assert fused(here, own) == list(rungs)
    assert fused(here, foreign) == [Representation.RAW, Representation.UNCERTAIN_BOXES]
    assert fused(there, own) == [Representation.RAW, Representation.UNCERTAIN_BOXES]
    assert fused(none, foreign) == [Representation.UNCERTAIN_BOXES]
    mine = PeerMemory(0, RULES, here)
    assert not mine.can_fuse(own[Representation.CODES]._replace(codebook=""))
    assert not mine.can_fuse(own[Representation.CODES]._replace(feature_space=""))
    assert mine.can_fuse(own[Representation.FEATURES]._replace(codebook="")), "a codebook says nothing of features"


# --- what is believed -------------------------------------------------------------------------------------


def test_doubted_peers_are_left_out_of_what_is_believed_and_read_without_their_claims() -> None:
    mine = memory()
    for i in range(3):
        mine.hold(descriptor(i), 0.0)
    mine._doubted = frozenset({2})
    assert [d.agent_id for d in mine.believed()] == [1]
    view = mine.view(0.0)
    assert view.descriptors[2].battery_soc == 0.0
    assert view.descriptors[1].battery_soc == DESCRIPTOR.battery_soc
    assert mine.peers == [1, 2]


def test_what_a_view_calls_detached_is_in_periods_of_a_descriptor() -> None:
    mine = memory(publish_every=4)
    mine.hold(descriptor(0, 0.0), 0.0)
    mine.hold(descriptor(1, 0.0), 0.0)
    views_at = {t_s: mine.view(t_s) for t_s in (3.9, 4.1)}
    assert isinstance(views_at[3.9], FleetView)
    assert [1 in view.members for view in views_at.values()] == [True, False]


def test_what_was_told_is_known_although_a_peer_knew_it_first() -> None:
    """The peer may be out of hearing by the next look."""
    grid, chart = b"\xaa" * 64, Chart()
    claim = descriptor(1, position_m=(0.0, 0.0, 60.0), coverage_grid=grid)
    at = (-8, -8)
    assert chart.mark(grid, *at, lambda: [claim], False) == (grid, False)
    assert chart.mark(grid, *at, lambda: [], False)[1]  # it was not told yet
    assert chart.mark(grid, *at, lambda: [claim], True) == (grid, False)
    assert chart.mark(grid, *at, lambda: [], True) == (grid, False)


# --- what a claim answers for -----------------------------------------------------------------------------


def strikes(mine: PeerMemory, peer: int = 1) -> int:
    standing = mine._standings.get(peer)
    return 0 if standing is None else standing.strikes


def test_a_claim_is_judged_once() -> None:
    """Also one that is still fresh at the next judgement, because its sender publishes seldom."""
    for every in (1, 10):
        mine = memory(publish_every=every)
        mine.hold(descriptor(0, 10.0), 10.0)
        mine.hold(descriptor(1, 10.0, coverage_grid=FULL_GRID), 10.0)
        for now_s, struck in ((10.05, 1), (11.05, 1), (12.05, 2)):
            if now_s > 12.0:
                mine.hold(descriptor(1, 11.9, coverage_grid=FULL_GRID), 11.9)
            mine.judge(now_s)
            assert strikes(mine) == struck


def test_a_claim_that_is_no_longer_fresh_is_not_judged() -> None:
    """Its drone may be gone: who left does not fall into doubt for its last word. Fresh is three of its periods."""
    for every, judged in ((1, 0), (3, 1)):
        mine = memory(publish_every=every)
        mine.hold(descriptor(0, 10.0), 10.0)
        mine.hold(descriptor(1, 9.9), 9.9)
        mine.judge(10.05)
        before = strikes(mine)
        mine.hold(descriptor(1, 10.5, coverage_grid=FULL_GRID), 10.5)
        mine.judge(11.05)
        assert strikes(mine) == before + judged


def test_a_payload_that_came_in_part_says_nothing_of_what_its_link_carries() -> None:
    """How much of it came is not known to the byte. A whole one that came fast makes a weak link a lie."""
    for missing, doubted in (((), True), ((90, 91), False)):
        mine = memory()
        mine.hold(descriptor(0, 10.0), 10.0)
        for t_s in (9.4, 9.6, 9.8):
            mine.receive(Received(capture(1, t_s), payload(200_000), t_s + 0.05, t_s, missing, 600.0))
        mine.hold(descriptor(1, 10.0, peer_goodput_mbps=(0.5,) * 4, coverage_grid=POOR_GRID), 10.0)
        mine.judge(10.05)
        assert ("goodput" in mine._standings[1].reason) == doubted


def test_who_sent_a_look_shortly_before_its_claim_looks() -> None:
    """Within half of the time for which a look stands; then a claim to see nothing cannot be so."""
    for before_s, doubted in ((0.1, True), (0.49, True), (0.51, False), (0.9, False)):
        mine, sent_s = memory(), 10.0 - before_s
        mine.hold(descriptor(0, 10.0), 10.0)
        mine.receive(Received(capture(1, sent_s - 0.04), payload(), sent_s + 0.02, sent_s - 0.04))
        mine.hold(descriptor(1, 10.0, coverage_grid=bytes(64)), 10.0)
        mine.judge(10.05)
        assert (strikes(mine) > 0) == doubted, before_s
        assert mine._standings[1].reason.startswith("coverage" if doubted else "")


def test_a_claim_is_held_against_what_came_before_it_by_one_clock() -> None:
    """Whoever's clock is off: a false goodput is found out, and a claim answers for nothing that came after it."""
    claims = ((1000.0, 9.9, True), (60.0, 9.9, False), (1000.0, 10.1, False))
    for mine_s, theirs_s, (claimed_mbps, sent_s, doubted) in product((0.0, 2.0), (0.0, 6.0, -6.0), claims):
        mine = memory()
        mine.status.clock_skew_s = mine_s
        mine.hold(descriptor(0, 10.0 + mine_s), 10.0)
        for _ in range(WINDOW):
            mine.clocks.heard(1, 0.03 + mine_s - theirs_s)
        stamp_s = sent_s - 0.04 + theirs_s
        mine.receive(Received(capture(1, sent_s - 0.04), payload(), sent_s + 0.002, stamp_s, phy_mbps=100.0))
        links = (claimed_mbps,) * 4
        mine.hold(descriptor(1, 9.95 + theirs_s, peer_goodput_mbps=links, coverage_grid=POOR_GRID), 10.0)
        mine.judge(10.2)
        assert ("goodput" in mine._standings[1].reason) == doubted, (mine_s, theirs_s, claimed_mbps, sent_s)


def test_payloads_of_a_peer_that_is_not_heard_are_kept_for_two_seconds() -> None:
    mine = memory()
    mine.hold(descriptor(0, 0.0), 0.0)
    mine.receive(Received(capture(1, 0.9), payload(), 1.0, 0.9))
    for now_s, kept in ((1.5, 1), (2.9, 1), (3.1, 0)):
        mine.judge(now_s)
        assert len(mine._arrivals[1]) == kept
