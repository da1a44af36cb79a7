"""The air as a whole: fates of samples, descriptors, silenced drones, conservation, determinism."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from radio_flights import Hover, trace
from wrong_rows import wrong_rows

from sortie.radio import Air, Status
from sortie.radio.counters import CAUSES, Counters
from sortie.radio.mac.broadcasts import Broadcasts
from sortie.radio.rates import STANDARDS
from sortie.radio.settings import AirSettings, BurstSettings
from sortie.scenarios.link_state import SILENT_MBPS

CALM = AirSettings(shadowing_sigma_db=0.0)
DEFAULT = AirSettings()


def everyone(f: Hover, payload: int, *, peers: int = 4, deadline_s: float = 0.1) -> None:
    """Each drone sends a payload to so many others."""
    for i in range(f.n):
        for j in range(1, peers + 1):
            f.send(i, (i + j) % f.n, payload, deadline_s=deadline_s)


def test_full_sharing_does_not_fit_one_channel_and_two_percent_of_the_cells_do() -> None:
    f = Hover(DEFAULT, n=5)
    f.fly(5.0, lambda _: everyone(f, 655_360, deadline_s=0.09))
    fates = Counter((r.status, r.reason) for r in f.rows)
    assert f.air.utilisation > 0.8  # backoffs, and idle between a deadline and the next frame
    assert min(fates[Status.EXPIRED, f"deadline_{where}"] for where in ("queued", "in_service")) > 100
    assert f.air.counters.data_delivered_bytes < 0.5 * f.air.counters.data_sent_bytes
    late = Hover(DEFAULT, n=5)
    late.fly(5.0, lambda _: everyone(late, 655_360, deadline_s=10.0))
    assert late.air.utilisation > 0.9  # the rest are backoffs
    assert Counter(r.reason for r in late.rows)["replaced"] > 100
    few = Hover(DEFAULT, n=5)
    few.fly(5.0, lambda _: everyone(few, 13_120))
    assert Counter(r.status for r in few.rows) == {Status.DELIVERED: 5 * 4 * 50}
    assert few.air.utilisation < 0.2


def test_the_row_of_one_sample() -> None:
    f = Hover(replace(CALM, tx_power_dbm=30.0)).fly(0.1)
    begin_s = f.env.now
    f.send(0, 1, 2000, kind="features", deadline_s=0.1)
    f.env.run(until=0.2)
    (row,) = f.rows
    ppdu_s = 44e-6 + 13.6e-6 * 3
    wanted = dict(
        number=0, sender=0, receiver=1, kind="features", payload_bytes=2000, status=Status.DELIVERED, reason=""
    )
    wanted |= dict(
        fragments=2, fragments_lost=0, repairs=0, wire_bytes=2000 + 2 * 150, mcs=11, deadline_s=begin_s + 0.1
    )
    wanted |= dict(t_sent_s=begin_s, t_start_s=begin_s, hops=1, arrived_bytes=2000, missing=())
    assert {name: getattr(row, name) for name in wanted} == wanted
    assert row.airtime_s == pytest.approx(ppdu_s + 16e-6 + 32e-6)  # with its block ack
    assert ppdu_s <= row.t_done_s - begin_s <= ppdu_s + 9e-6  # at once on an idle medium, at the next slot


def test_a_dead_link_costs_a_few_tries_and_says_so() -> None:
    f = Hover(CALM, n=3)
    f.extra = np.array([[0.0, 90.0, 0.0], [0.0] * 3, [0.0] * 3])
    f.fly(1.0, lambda _: (f.send(0, 1, 50_000), f.send(0, 2, 50_000)))
    fates = Counter((r.receiver, r.status, r.reason) for r in f.rows)
    assert fates == {(1, Status.LOST, "no_link"): 10, (2, Status.DELIVERED, ""): 10}
    assert all(r.airtime_s < 10e-3 and r.mcs == -1 and r.wire_bytes == 0 for r in f.rows if r.receiver == 1)
    assert f.air.goodput_mbps(0)[0] == SILENT_MBPS
    assert f.air.goodput_mbps(0)[1] > 100


def test_what_a_silenced_drone_had_put_on_the_air_is_counted() -> None:
    def wire_bytes(end: Callable[[Hover], object]) -> int:
        f = Hover(CALM)
        f.air.advance()
        f.send(0, 1, 600_000)
        f.env.timeout(0.01).callbacks.append(lambda _: end(f))
        f.env.run(until=0.02)
        assert 0.009 < f.rows[0].airtime_s < 0.0105  # less the backoffs; an exchange counts at its begin
        assert f.air.counters.data_wire_bytes == sum(r.wire_bytes for r in f.rows)
        return f.rows[0].wire_bytes

    silenced = wire_bytes(lambda f: f.air.silence(0))
    assert silenced == wire_bytes(lambda f: f.send(0, 1, 1)) > 100_000  # as one that is replaced then


def test_a_descriptor_on_the_air_counts_as_heard_and_missed_whatever_becomes_of_its_sender() -> None:
    def check(end: Callable[[Air], None]) -> None:
        f = Hover(CALM, n=3, spread=0.0)
        f.air.advance(np.array([[0.0, 0.0, 200.0], [0.0] * 3, [0.0] * 3]))
        f.publish(0)
        f.env.timeout(2e-4).callbacks.append(lambda _: end(f.air))
        f.env.run(until=0.01)
        assert [(sender, ids) for _, sender, ids in f.heard] == [(0, (1,))]
        assert (f.air.counters.receptions, f.air.counters.missed) == (1, 1)
        assert f.air.counters.lost_to["weak_signal"] == 1

    assert wrong_rows([lambda air: None, lambda air: air.silence(0)], check) == {}


def test_what_is_in_flight_at_the_end_is_told() -> None:
    f = Hover(CALM)
    f.air.advance()
    f.send(0, 1, 2_000_000)
    f.send(0, 1, 1000, kind="d")
    f.env.run(until=0.005)
    rows = f.air.finish()
    assert [(r.number, r.status, r.reason) for r in rows] == [(0, Status.IN_FLIGHT, ""), (1, Status.IN_FLIGHT, "")]
    assert 0.0045 < rows[0].airtime_s < 0.006
    assert 0 < rows[0].wire_bytes < 2_000_000
    assert isnan(rows[1].t_start_s)
    assert isnan(rows[1].t_done_s)
    assert f.air.data_in_flight_bytes == 2_001_000


@pytest.mark.parametrize("hops", [1, 3])
def test_a_silenced_drone_has_no_link_sends_nothing_and_is_reached_by_nothing(hops: int) -> None:
    flight = Hover(AirSettings(shadowing_sigma_db=0.0, relay_max_hops=hops), n=4)
    numbers: dict[int, tuple[int, int]] = {}

    def tick(k: int) -> None:
        if k == 3:
            for j in (0, 2):
                numbers[flight.send(1, j, 200_000, deadline_s=5.0)] = (1, j)  # has to be dropped
            flight.publish(1)  # its frame waits for its moment
            flight.air.silence(1)
        if k >= 3:
            mbps = flight.air.link_mbps()
            assert not mbps[1].any()
            assert not mbps[:, 1].any()
            assert (mbps[np.ix_([0, 2, 3], [0, 2, 3])][~np.eye(3, dtype=bool)] > 0).all()
        for i in (0, 2, 3):
            flight.publish(i)
            numbers[flight.send(i, 1, 3000)] = (i, 1)
            numbers[flight.send(i, (2, 0, 0, 2)[i], 3000)] = (i, (2, 0, 0, 2)[i])

    flight.fly(1.0, tick)
    from_gone = [r for r in flight.rows if r.sender == 1]
    assert [r.reason for r in from_gone] == ["sender_gone"] * 2
    gone_s = 0.3
    assert {r.reason for r in flight.rows if r.receiver == 1 and r.t_sent_s > gone_s} == {"receiver_gone"}
    for t_s, sender, heard in flight.heard:
        if t_s > gone_s + 1e-3:
            assert sender != 1
            assert 1 not in heard
    others = [r for r in flight.rows if 1 not in (r.sender, r.receiver)]
    assert sum(r.status == "delivered" for r in others) > 0.9 * len(others)
    assert flight.air.airtime_s[1] < 1e-3 * 5


def test_a_silenced_drone_answers_nobody(tmp_path: Path) -> None:
    """Also not who asks what has arrived of frames that were sent before."""
    settings = AirSettings(shadowing_sigma_db=0.0, trace=trace(tmp_path, "0,0,1,,0.9,"))
    asked = 0
    for seed in range(12):
        flight = Hover(settings, n=2, seed=seed)
        flight.air.advance()
        flight.send(0, 1, 2500, deadline_s=0.09)
        flight.env.run(until=0.002)
        flight.air.silence(1)
        before_s = flight.air.airtime_s[1]
        flight.env.run(until=0.09)
        assert flight.air.airtime_s[1] == before_s, seed
        asked += [row.reason for row in flight.rows] == ["receiver_gone"]
    assert asked > 6


def test_a_link_too_weak_to_be_detected_is_none_for_routes_and_for_payloads() -> None:
    """Though its rate would still be one."""
    at = np.array([[0.0, 0.0, 60.0], [60.0, 0.0, 60.0], [400.0, 0.0, 60.0]])
    heard, deaf = (AirSettings(shadowing_sigma_db=0.0, preamble_detection_dbm=dbm) for dbm in (-95.0, -70.0))
    for config, there in ((heard, True), (deaf, False)):
        flight = Hover(config, at)
        flight.fly(0.3, lambda k, flight=flight: flight.send(0, 2, 500))
        mbps = flight.air.link_mbps()
        assert mbps[0, 1] > 0
        assert (mbps[0, 2] > 0) == there
        assert all((r.reason == "no_link") != there for r in flight.rows)


traffic = st.lists(
    st.tuples(
        st.integers(0, 19),  # frame
        st.integers(0, 3),  # sender
        st.integers(1, 3),  # receiver, relative
        st.integers(1, 900_000),
        st.sampled_from("ab"),
        st.booleans(),
        st.floats(0, 0.4),
    ),
    max_size=40,
)


@settings(max_examples=60, deadline=None)
@given(
    samples=traffic,
    seed=st.integers(0, 99),
    retry_limit=st.sampled_from([0, 7]),
    loss_db=st.sampled_from([0.0, 10.0, 25.0]),
    bad=st.sampled_from([0.0, 0.5]),
    piece_bytes=st.none() | st.just(1336),
    hops=st.integers(1, 3),
    silenced_at=st.none() | st.integers(0, 19),
)
def test_bytes_are_conserved_whatever_is_flown_and_goodput_stays_below_the_phy_rate(
    samples: list[Any],
    seed: int,
    retry_limit: int,
    loss_db: float,
    bad: float,
    piece_bytes: int | None,
    hops: int,
    silenced_at: int | None,
) -> None:
    bursts = BurstSettings(good_to_bad=0.3, loss_bad=bad, step_s=0.1) if bad else BurstSettings()
    config = AirSettings(retry_limit=retry_limit, tx_power_dbm=15.0, relay_max_hops=hops, bursts=bursts)
    f = Hover(config, n=4, seed=seed)
    f.extra = np.zeros((4, 4))
    f.extra[1, :] = loss_db

    def tick(k: int) -> None:
        for i in range(4):
            f.publish(i)
            assert all(0 <= g < STANDARDS["ax"].rates_mbps[80][11] for g in f.air.goodput_mbps(i))
        for frame, sender, hop, payload, kind, reliable, deadline_s in samples:
            if frame == k:
                how = {"kind": kind, "reliable": reliable, "deadline_s": deadline_s, "piece_bytes": piece_bytes}
                f.send(sender, (sender + hop) % 4, payload, **how)
        if k == silenced_at:
            f.air.silence(3)

    f.fly(2.0, tick)
    c, rows = f.air.counters, f.rows + f.air.finish()
    assert sorted(r.number for r in rows) == list(range(len(samples)))
    by = {s: sum(r.payload_bytes for r in rows if r.status is s) for s in Status}
    arrived = sum(r.arrived_bytes for r in rows if r.status is Status.PARTIAL)
    assert by[Status.DELIVERED] + arrived == c.data_delivered_bytes
    assert by[Status.IN_FLIGHT] == f.air.data_in_flight_bytes
    settled = c.data_delivered_bytes + c.data_lost_bytes + c.data_expired_bytes
    assert sum(by.values()) == settled + by[Status.IN_FLIGHT] == c.data_sent_bytes == sum(s[3] for s in samples)
    if piece_bytes is None:
        assert (by[Status.LOST], by[Status.EXPIRED]) == (c.data_lost_bytes, c.data_expired_bytes)
    for r in f.rows:
        assert r.t_sent_s <= r.t_done_s <= r.deadline_s + 1e-9
        assert isnan(r.t_start_s) or r.t_sent_s <= r.t_start_s <= r.t_done_s
        assert (r.status is Status.DELIVERED) == (r.reason == "") == (r.arrived_bytes == r.payload_bytes)
        assert (r.status is Status.PARTIAL) == bool(r.missing) == (0 < r.arrived_bytes < r.payload_bytes)
        assert r.wire_bytes >= r.arrived_bytes
        assert r.hops <= hops
    assert sum(f.air.airtime_s) <= 4 * 2.0
    assert f.air.utilisation <= 1.0


# --- context -----------------------------------------------------------------------------------------


def test_broadcasts_reach_everyone_near_and_are_counted() -> None:
    f = Hover(CALM, n=5, spread=0.0)
    f.fly(2.0, lambda k: f.publish(k % 5))
    assert [ids for _, _, ids in f.heard] == [tuple(i for i in range(5) if i != k % 5) for k in range(20)]
    assert f.air.counters.receptions == 80
    assert next(f.env._eid) <= 20 + 2 * 20 + 3  # one event a frame to tick, two a broadcast, the process and the end
    assert f.air.airtime_s == pytest.approx([4 * 468e-6] * 5)


def test_broadcasts_in_step_are_sent_together_and_out_of_step_hardly_collide() -> None:
    counters = {}
    for spread in (0.0, 0.8):
        f = Hover(CALM, n=5, spread=spread)
        f.fly(20.0, lambda t, f=f: [f.publish(i) for i in range(5)])
        counters[spread] = f.air.counters
        assert sum(counters[spread].lost_to.values()) == counters[spread].missed
    assert counters[0.0].lost_to["half_duplex"] == counters[0.0].missed == 4000  # who sends hears nobody
    assert counters[0.8].missed < 0.02 * 4000


def test_same_inputs_same_fates_and_a_sixth_silent_drone_changes_none() -> None:
    def fates(n: int, seed: int = 1) -> tuple[list, list]:
        f = Hover(AirSettings(retry_limit=0), n=n, seed=seed)

        def tick(_: int) -> None:
            for i in range(5):
                f.publish(i)
                f.send(i, (i + 1) % 5, 100_000)

        f.fly(5.0, tick)
        return f.rows, [(t, s, tuple(i for i in ids if i < 5)) for t, s, ids in f.heard]

    assert fates(5) == fates(5)
    assert fates(5) == fates(6)
    assert fates(5) != fates(5, seed=2)


def test_a_descriptor_may_be_handed_over_before_its_time() -> None:
    f = Hover(CALM, spread=0.0).fly(0.1)
    heard: list[float] = []
    f.air.broadcast(0, 208, lambda ids: heard.append(f.env.now), in_s=0.03)
    f.env.run(until=0.2)
    assert heard == pytest.approx([0.1 + 0.03 + 468e-6], abs=10e-6)


def test_every_living_drone_hears_a_descriptor_or_misses_it_for_a_reason() -> None:
    """Drone 0 sends; 1 hears it, 2 meets another, 3 sends itself, 4 is too weak, or out of reach and not named."""

    def check(as_lists: bool, gone: set[int], far: bool) -> None:
        counters, heard = Counters(), []
        casts = Broadcasts(
            6.0, 6, counters, gone, seed=1, replication=0, frame_s=0.1, publish_spread=0.8, as_lists=as_lists
        )
        names = ("collision_data", "half_duplex", "weak_signal")
        fates = [0, len(CAUSES) + 1, *(1 + CAUSES.index(name) for name in names), len(CAUSES) + 1]
        receivers = np.arange(6)
        if far:
            receivers, fates = np.delete(receivers, 4), [*fates[:4], fates[5]]
        casts.end(casts.frame(0, 180, heard.append), receivers, bytes(fates))
        assert heard == [[1, 5]]
        missed = 3 - (3 in gone)
        assert (counters.receptions, counters.missed, counters.collided) == (2, missed, 1)
        wanted = dict.fromkeys(CAUSES, 0) | {"collision_data": 1, "half_duplex": int(3 not in gone), "weak_signal": 1}
        assert counters.lost_to == wanted
        assert sum(counters.lost_to.values()) == counters.missed

    assert wrong_rows(product([True, False], [set(), {3}, {0, 3}], [False, True]), check) == {}


def test_arguments_out_of_bounds_are_refused() -> None:
    f = Hover(CALM).fly(0.1)
    nan = float("nan")
    rows = [
        (lambda: f.send(0, 0, 1), r"sender is 0 and receiver 0, must be two drones in \[0, 1\]"),
        (lambda: f.send(0, 1, 0), "payload_bytes is 0, must be at least 1"),
        (lambda: f.send(0, 1, 1, deadline_s=nan), "deadline_s is nan, must be at least 0"),
        (lambda: f.send(0, 1, 10, piece_bytes=0), "piece_bytes is 0, must be at least 1"),
        (lambda: f.air.broadcast(2, 10, print), r"sender is 2, must be in \[0, 1\]"),
        (lambda: f.air.broadcast(0, 3000, print), r"payload_bytes is 3000, must be in \[1, 2200\]"),
        (lambda: f.air.broadcast(0, 10, print, -0.1), "in_s is -0.1, must be at least 0"),
        (lambda: Hover(CALM, spread=2.0), r"publish_spread is 2\.0, must be in \[0, 1\]"),
    ]

    def check(call: Callable[[], object], message: str) -> None:
        with pytest.raises(ValueError, match=message):
            call()

    assert wrong_rows(rows, check) == {}


def test_one_class_takes_every_setting_and_repeats_itself() -> None:
    more = dict(rate_control="minstrel", rts=True, relay_max_hops=2, block_ack_window=256, fading="frame")
    config = AirSettings(
        shadowing_distance_m=20.0, antenna="dipole", path_loss="two_ray", bursts=BurstSettings(good_to_bad=0.1), **more
    )
    flights = [Hover(config, n=4) for _ in range(2)]
    for f in flights:
        f.fly(1.0, lambda _, f=f: [f.send(i, (i + 1) % 4, 9000, piece_bytes=900) for i in range(4)])
    assert flights[0].rows == flights[1].rows != []
