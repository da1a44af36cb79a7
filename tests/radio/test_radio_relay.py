"""Routes over several hops: the cheapest by an independent search, flown, paid for, and reported."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from radio_flights import Hover, trace

from sortie.radio import Status
from sortie.radio.relay import Routes, cheapest
from sortie.radio.settings import AirSettings

LINE_M = np.array([[0.0, 0.0, 60.0], [150.0, 0.0, 60.0], [300.0, 0.0, 60.0]])
"""Three in a row: either end is heard badly by the other, well by the middle."""


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


def traced(folder: Path, **knobs) -> AirSettings:  # type: ignore[no-untyped-def]
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


def test_a_good_direct_link_is_not_left() -> None:
    flight = Hover(AirSettings(relay_max_hops=4), n=5)
    flight.fly(5.0, lambda frame: [flight.send(i, (i + 1) % 5, 3000, kind="d") for i in range(5)])
    assert {r.hops for r in flight.rows} == {1}


def test_far_ends_of_a_row_are_reached_over_its_middle() -> None:
    config = AirSettings(shadowing_sigma_db=0.0, tx_power_dbm=7.0, preamble_detection_dbm=-101.0)
    came = {}
    for hops in (1, 2):
        flight = Hover(replace(config, relay_max_hops=hops), LINE_M)
        flight.fly(10.0, lambda frame, f=flight: f.send(0, 2, 60_000))  # type: ignore[misc]
        came[hops] = sum(r.status is Status.DELIVERED for r in flight.rows) / len(flight.rows)
        assert sum(r.hops == hops for r in flight.rows) > 90  # in the first frame nothing is known before it
    assert came[1] < 0.2
    assert came[2] > 0.9


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
        (1, 2, Status.DELIVERED), (2, 1, Status.DELIVERED), (3, 1, Status.DELIVERED),
    }  # fmt: skip


def test_a_lost_relay_is_left(tmp_path: Path) -> None:
    flight = Hover(traced(tmp_path, relay_max_hops=2), LINE_M)

    def tick(frame: int) -> None:
        flight.send(0, 2, 20_000)
        if frame == 10:
            flight.air.silence(1)

    flight.fly(3.0, tick)
    assert [r.hops for r in flight.rows if r.t_sent_s < 0.95] == [2] * 10
    assert {(r.hops, r.status) for r in flight.rows if r.t_sent_s > 1.15} == {(1, Status.DELIVERED)}


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


def test_no_row_of_a_flight_over_relays_has_airtime_and_was_never_served() -> None:
    line_m = np.array([[150.0 * i, 0.0, 60.0] for i in range(5)])
    flight = Hover(AirSettings(relay_max_hops=4, tx_power_dbm=10.0), line_m)
    flight.fly(5.0, lambda frame: [flight.send(i, j, 60_000) for i in range(5) for j in range(5) if i != j])
    rows = flight.rows + flight.air.finish()
    assert sum(r.hops > 1 and r.reason == "deadline_queued" for r in rows) > 30
    assert [r for r in rows if np.isnan(r.t_start_s) and r.airtime_s > 0.0] == []


def test_pieces_lost_on_one_hop_are_not_sent_on_the_next(tmp_path: Path) -> None:
    links = trace(tmp_path, "0,0,1,,0.3,100", "0,1,2,,0.3,100", "0,0,2,,,0")
    flight = Hover(AirSettings(trace=links, retry_limit=0, relay_max_hops=2), LINE_M)
    flight.fly(60.0, lambda frame: flight.send(0, 2, 64 * 1336, piece_bytes=1336))
    share = np.mean([r.arrived_bytes for r in flight.rows]) / (64 * 1336)
    assert share == pytest.approx(0.49, abs=0.01)
    assert {(r.status, r.hops) for r in flight.rows} == {(Status.PARTIAL, 2)}
    assert flight.air.airtime_s[1] == pytest.approx(0.7 * flight.air.airtime_s[0], rel=0.05)


def test_goodput_to_a_relayed_peer_is_that_of_its_hops(tmp_path: Path) -> None:
    flight = Hover(traced(tmp_path, relay_max_hops=2), LINE_M)
    flight.fly(5.0, lambda frame: flight.send(0, 2, 60_000))
    assert flight.air.goodput_mbps(0)[1] == pytest.approx(50.0, rel=0.05)
