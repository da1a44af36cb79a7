"""Routes over several hops beside networkx; relays, flown and paid for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from radio_examples import CROSS_M
from radio_flights import Hover, trace

from sortie.radio import Status
from sortie.radio.relay import Routes, cheapest
from sortie.radio.settings import AirSettings

LINE_M = np.array([[0.0, 0.0, 60.0], [150.0, 0.0, 60.0], [300.0, 0.0, 60.0]])
"""Three in a row: either end is heard badly by the other, well by the middle."""
CALM = AirSettings(shadowing_sigma_db=0.0, rician_k_db=40.0)


@st.composite
def goodputs(draw: st.DrawFn) -> np.ndarray:
    """[N, N] Mb/s, some links missing."""
    n = draw(st.integers(2, 6))
    mbps = st.one_of(st.just(0.0), st.floats(0.5, 100.0))
    return np.array(draw(st.lists(mbps, min_size=n * n, max_size=n * n))).reshape(n, n)


@settings(max_examples=60, deadline=None)
@given(mbps=goodputs(), max_hops=st.integers(1, 4))
def test_routes_are_the_cheapest_of_all_paths(mbps: np.ndarray, max_hops: int) -> None:
    n = len(mbps)
    graph = nx.DiGraph()
    graph.add_nodes_from(range(n))
    graph.add_edges_from((i, j) for i in range(n) for j in range(n) if i != j and mbps[i, j] > 0)
    routes = Routes(max_hops)
    routes.renew(mbps)
    for i in range(n):
        for j in range(n):
            if i == j:
                continue
            paths = nx.all_simple_paths(graph, i, j, cutoff=max_hops)
            best = min((sum(1 / mbps[a, b] for a, b in pairwise(p)) for p in paths), default=np.inf)
            path = routes.path(i, j)
            assert path[0] == i
            assert path[-1] == j
            assert len(path) - 1 <= max_hops
            if np.isinf(best):
                assert path == [i, j]
            else:
                assert sum(1 / mbps[a, b] for a, b in pairwise(path)) == pytest.approx(best)
                assert len(path) == 2 or mbps[i, j] == 0 or best < 1 / mbps[i, j]  # over others only where it is better


def test_what_cannot_be_routed() -> None:
    with pytest.raises(ValueError, match=r"cost has shape \(2, 3\), must be square"):
        cheapest(np.ones((2, 3)), 2)
    with pytest.raises(ValueError, match="max_hops is 0, must be at least 1"):
        cheapest(np.ones((2, 2)), 0)


# --- flown ---------------------------------------------------------------------------------------------


def traced(folder: Path, **knobs) -> AirSettings:
    """0 → 1 and 1 → 2 carry 100 Mb/s, 0 → 2 carries 10."""
    return AirSettings(trace=trace(folder, "0,0,1,,,100", "0,1,2,,,100", "0,0,2,,,10"), **knobs)


def test_a_route_over_others_pays_airtime_for_each_hop(tmp_path: Path) -> None:
    alone_s = {}
    for hops in (1, 2):
        flight = Hover(traced(tmp_path, relay_max_hops=hops), LINE_M).fly(0.1)
        flight.send(0, 2, 100_000, deadline_s=1.0)
        flight.env.run(until=1.0)
        (row,) = flight.rows
        assert (row.sender, row.receiver, row.hops, row.status) == (0, 2, hops, Status.DELIVERED)
        alone_s[hops] = row.airtime_s
        sent_s = flight.air.airtime_s
        assert (sent_s[1] > 0) == (hops == 2)
        assert sent_s[0] == pytest.approx(sent_s[1], rel=0.01) or hops == 1
        assert row.wire_bytes == pytest.approx(hops * 110_000, rel=0.02)
    assert alone_s[2] == pytest.approx(2 * 100_000 * 8 / 100e6, rel=0.05)
    assert alone_s[1] == pytest.approx(100_000 * 8 / 10e6, rel=0.05)


def test_routes_know_a_traced_loss(tmp_path: Path) -> None:
    """0 → 1 loses all at a perfect SNR, 0 → 2 half; 0 → 3, by the models out of everyone's range, nothing."""
    at_m = np.array([[0.0, 0.0, 60.0], [20.0, 0.0, 60.0], [0.0, 20.0, 60.0], [2e6, 0.0, 60.0]])
    links = trace(tmp_path, "0,0,1,,1,", "0,0,2,,0.5,", "0,0,3,,0,")
    flight = Hover(AirSettings(trace=links, relay_max_hops=2, shadowing_sigma_db=0.0, retry_limit=20), at_m)
    flight.fly(3.0, lambda frame: [flight.send(0, j, 20_000) for j in (1, 2, 3)])
    mbps = flight.air.link_mbps()
    assert mbps[0, 1] == 0.0
    assert mbps[0, 2] == pytest.approx(0.5 * mbps[2, 0], rel=0.01)  # each frame goes twice
    assert mbps[0, 3] > 0.0
    assert {(r.receiver, r.hops, r.status) for r in flight.rows} == {
        (1, 2, Status.DELIVERED),
        (2, 1, Status.DELIVERED),
        (3, 1, Status.DELIVERED),
    }


def test_a_lost_relay_is_left(tmp_path: Path) -> None:
    flight = Hover(traced(tmp_path, relay_max_hops=2), LINE_M)

    def tick(frame: int) -> None:
        flight.send(0, 2, 20_000)
        if frame == 10:
            flight.air.silence(1)

    flight.fly(3.0, tick)
    assert [r.hops for r in flight.rows if r.t_sent_s < 0.95] == [2] * 10
    assert {(r.hops, r.status) for r in flight.rows if r.t_sent_s > 1.15} == {(1, Status.DELIVERED)}


def test_a_relayed_sample_takes_at_most_the_hops_that_a_route_may_have(tmp_path: Path) -> None:
    """Each relay has only the hops that are left, and then goes straight to the target."""
    n = 5
    mbps = {1: 60.0, 2: 6.0, 3: 3.0, 4: 2.0}
    rows = [f"0,{i},{j},,,{mbps[abs(i - j)]}" for i in range(n) for j in range(n) if i != j]
    flight = Hover(
        AirSettings(trace=trace(tmp_path, *rows), relay_max_hops=2), np.array([[20.0 * i, 0, 60] for i in range(n)])
    )
    flight.fly(2.0, lambda k: flight.send(0, 4, 8000, deadline_s=0.9) if k % 4 == 0 else None)
    assert flight.rows
    assert {r.hops for r in flight.rows} <= {1, 2}


def test_what_dies_in_a_relay_s_queue_was_served_on_its_first_hop(tmp_path: Path) -> None:
    """1 is busy for 160 ms with a payload of its own; one that expires in the queue of its own sender starts never."""
    flight = Hover(traced(tmp_path, relay_max_hops=2), LINE_M).fly(0.1)
    begin_s = flight.env.now
    flight.send(1, 2, 2_000_000, kind="own", deadline_s=1.0)
    flight.send(0, 2, 20_000)
    flight.send(1, 2, 20_000, kind="late")
    flight.env.run(until=1.0)
    late, relayed, _ = sorted(flight.rows, key=lambda r: (r.t_done_s, r.hops))
    for row, hops in ((relayed, 2), (late, 1)):
        assert (row.hops, row.status, row.reason) == (hops, Status.EXPIRED, "deadline_queued")
    assert relayed.t_start_s == begin_s
    assert relayed.airtime_s > 0.0
    assert np.isnan(late.t_start_s)
    assert late.airtime_s == 0.0


def test_pieces_lost_on_one_hop_are_not_sent_on_the_next(tmp_path: Path) -> None:
    links = trace(tmp_path, "0,0,1,,0.3,100", "0,1,2,,0.3,100", "0,0,2,,,0")
    flight = Hover(AirSettings(trace=links, retry_limit=0, relay_max_hops=2), LINE_M)
    flight.fly(60.0, lambda frame: flight.send(0, 2, 64 * 1336, piece_bytes=1336))
    share = np.mean([r.arrived_bytes for r in flight.rows]) / (64 * 1336)
    assert share == pytest.approx(0.49, abs=0.01)
    assert {(r.status, r.hops) for r in flight.rows} == {(Status.PARTIAL, 2)}
    assert flight.air.airtime_s[1] == pytest.approx(0.7 * flight.air.airtime_s[0], rel=0.05)


# --- what relays do with others' payloads ---------------------------------------------------------------


def over_one(folder: Path, *links: tuple[int, int, float]) -> Hover:
    """A fleet of four with links of these goodputs (sender, receiver, Mb/s) and none else, two hops at most."""
    given = {(i, j): mbps for i, j, mbps in links}
    rows = [f"0,{i},{j},,,{given.get((i, j), 0)}" for i in range(4) for j in range(4) if i != j]
    return Hover(
        AirSettings(trace=trace(folder, *rows), relay_max_hops=2), np.array([[20.0 * i, 0.0, 60.0] for i in range(4)])
    ).fly(0.1)


@pytest.mark.parametrize("lost", [0, 1])
def test_what_a_lost_drone_has_at_hand_dies_with_it_and_what_it_handed_on_does_not(lost: int, tmp_path: Path) -> None:
    """0 sends to 2 over 1, and 1 sends to 3. By the time that one of them is lost, 1 has both."""
    flight = over_one(tmp_path, (0, 1, 80.0), (1, 2, 10.0), (1, 3, 10.0))
    begin_s = flight.env.now
    relayed = flight.send(0, 2, 50_000, kind="relayed", deadline_s=1.0)
    flight.env.run(until=begin_s + 0.02)
    own = flight.send(1, 3, 50_000, kind="own", deadline_s=1.0)
    flight.air.silence(lost)
    at_once = {r.number: r.reason for r in flight.rows}
    assert at_once == ({} if lost == 0 else {relayed: "sender_gone", own: "sender_gone"})
    flight.env.run(until=1.2)
    fates = {r.number: r.status for r in flight.rows}
    assert set(fates) == {relayed, own}
    assert set(fates.values()) == {Status.DELIVERED if lost == 0 else Status.LOST}


def test_a_relay_counts_a_payload_s_wait_from_when_it_came(tmp_path: Path) -> None:
    """It came over a slow hop to a relay that is busy: that says nothing of the link on which it waits."""
    flight = over_one(tmp_path, (0, 1, 4.0), (1, 2, 40.0), (1, 3, 2.0))
    flight.send(1, 2, 40_000, kind="before", deadline_s=1.0)
    flight.env.run(until=0.2)
    known = flight.air.goodput_mbps(1)[1]
    assert known > 20.0
    flight.send(0, 2, 20_000, deadline_s=1.0)  # 40 ms on its first hop, more with 1 on the air
    flight.env.run(until=0.22)
    flight.send(1, 3, 60_000, kind="busy", deadline_s=1.0)
    medium = flight.air.medium
    while not any(s.hops == 2 for s in medium.queued(1)):
        flight.env.run(until=flight.env.now + 1e-4)
        assert flight.env.now < 0.5
    assert flight.air.goodput_mbps(1)[1] == known
    flight.env.run(until=flight.env.now + 0.02)
    assert flight.air.goodput_mbps(1)[1] < 0.5 * known  # now it has waited


@pytest.mark.parametrize("reliable", [False, True])
def test_pieces_that_came_as_far_as_a_relay_have_not_arrived(reliable: bool, tmp_path: Path) -> None:
    """The deadline passes on the first hop, and on the second: only what is at the target counts."""
    flight = over_one(tmp_path, (0, 1, 2.0), (1, 2, 40.0), (3, 1, 40.0))
    flight.send(0, 2, 40_000, piece_bytes=1000, reliable=reliable, deadline_s=0.08)
    flight.env.run(until=0.3)
    flight.send(0, 1, 40_000, piece_bytes=1000, reliable=reliable, deadline_s=0.08)
    flight.env.run(until=0.6)
    relayed, direct = flight.rows
    assert (relayed.status, relayed.arrived_bytes, relayed.missing) == (Status.EXPIRED, 0, ())
    assert direct.status == Status.PARTIAL
    assert 5_000 < direct.arrived_bytes < 30_000
    assert relayed.airtime_s == pytest.approx(direct.airtime_s, rel=0.1)
    expired = flight.air.counters.data_expired_bytes
    assert expired == 40_000 + 40_000 - direct.arrived_bytes


class _Ways:
    """Routes by the order in which samples leave drone 0: the first goes a longer way than the second."""

    max_hops = 4

    def __init__(self, ways: Mapping[int, list[int]]) -> None:
        self._ways, self._left = ways, 0

    def renew(self, _: object) -> None: ...

    def next_hop(self, here: int, target: int, hops: int) -> int:
        if target != 3:
            return target
        if here == 0:
            self._left += 1
            return self._ways[self._left - 1][1]
        return next(way[way.index(here) + 1] for way in self._ways.values() if here in way)


def test_an_older_sample_on_a_longer_way_does_not_replace_a_newer_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drone 2 has the newer one waiting behind other traffic when the older one comes."""
    fleet = Hover(replace(CALM, relay_max_hops=4), CROSS_M[:5], spread=0.0)
    monkeypatch.setattr(fleet.air, "_routes", _Ways({0: [0, 1, 4, 2, 3], 1: [0, 2, 3]}))
    numbers = []

    def tick(frame: int) -> None:
        if frame == 0:
            fleet.send(2, 1, 4_000_000, kind="other", deadline_s=0.5)
            fleet.send(1, 2, 1_000_000, kind="other", deadline_s=0.5)  # drone 1 passes the older one on late
            numbers.append(fleet.send(0, 3, 20_000, deadline_s=0.5))
            fleet.env.timeout(8e-3).callbacks.append(lambda _: numbers.append(fleet.send(0, 3, 20_000, deadline_s=0.5)))

    fleet.fly(0.6, tick)
    fates = {row.number: (row.status, row.reason) for row in fleet.rows}
    assert [fates[n] for n in numbers] == [(Status.EXPIRED, "replaced"), (Status.DELIVERED, "")]
