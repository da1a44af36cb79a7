"""The air as a whole: fates, repairs, goodput as measured, conservation, determinism."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from math import isnan

import numpy as np
import pytest
import simpy
from hypothesis import given, settings
from hypothesis import strategies as st
from radio_examples import CROSS_M, still

from sortie.radio import Air, Status, Transmission
from sortie.radio.goodput import Goodput
from sortie.radio.rates import STANDARDS
from sortie.radio.settings import AirSettings
from sortie.scenarios.link_state import SILENT_MBPS, LinkState, state_of

DEFAULT = AirSettings()
STILL = AirSettings(shadowing_sigma_db=0.0)


class Flight:
    """A fleet that hovers in a cross; `tick` is called in every frame after the links have moved on."""

    def __init__(
        self, config: AirSettings = DEFAULT, n: int = 5, *, seed: int = 1, replication: int = 0, spread: float = 0.8
    ) -> None:
        self.env = simpy.Environment()
        self.n = n
        self.air = Air(
            self.env, config, still(CROSS_M[:n]), seed=seed, replication=replication, frame_s=0.1, publish_spread=spread
        )
        self.rows: list[Transmission] = []
        self.heard: list[tuple[float, int, tuple[int, ...]]] = []
        self.extra = np.zeros((n, n))

    def send(
        self,
        sender: int,
        receiver: int,
        payload: int,
        *,
        kind: str = "f",
        reliable: bool = False,
        deadline_s: float = 0.1,
    ) -> int:
        return self.air.send(
            sender, receiver, payload, kind=kind, reliable=reliable, deadline_s=deadline_s, on_done=self.rows.append
        )

    def publish(self, sender: int) -> None:
        self.air.broadcast(sender, 208, lambda ids: self.heard.append((self.env.now, sender, tuple(ids))))

    def fly(self, duration_s: float, tick: Callable[[float], object] = lambda t: None) -> Flight:
        def frames() -> simpy.events.ProcessGenerator:
            for k in range(round(duration_s * 10)):
                if k:
                    yield self.env.timeout(k / 10 - self.env.now)
                self.air.advance(self.extra)
                tick(k / 10)

        self.env.process(frames())
        self.env.run(until=duration_s)
        return self

    def everyone(
        self, payload: int, *, peers: int = 4, deadline_s: float = 0.1, reliable: bool = False
    ) -> Callable[[float], None]:
        def tick(_: float) -> None:
            for i in range(self.n):
                for j in range(1, peers + 1):
                    self.send(i, (i + j) % self.n, payload, deadline_s=deadline_s, reliable=reliable)

        return tick


def test_full_sharing_does_not_fit_one_channel() -> None:
    f = Flight()
    f.fly(5.0, f.everyone(655_360, deadline_s=0.09))
    fates = Counter((r.status, r.reason) for r in f.rows)
    assert f.air.utilisation > 0.8  # backoffs, and idle between a deadline and the next frame
    assert fates[Status.EXPIRED, "deadline_queued"] > 100
    assert fates[Status.EXPIRED, "deadline_in_service"] > 100
    assert f.air.counters.data_delivered_bytes < 0.5 * f.air.counters.data_sent_bytes
    f = Flight()
    f.fly(5.0, f.everyone(655_360, deadline_s=10.0))
    assert f.air.utilisation > 0.9  # the rest are backoffs
    assert Counter(r.reason for r in f.rows)["replaced"] > 100


def test_two_percent_of_the_cells_fit_without_a_miss() -> None:
    f = Flight()
    f.fly(5.0, f.everyone(13_120))
    assert {r.status for r in f.rows} == {Status.DELIVERED}
    assert len(f.rows) == 5 * 4 * 50
    assert f.air.utilisation < 0.2


def test_the_row_of_one_sample() -> None:
    f = Flight(AirSettings(shadowing_sigma_db=0.0, tx_power_dbm=30.0))
    f.fly(0.2, lambda t: t == 0 and f.send(0, 1, 2000, kind="features"))
    (row,) = f.rows
    assert (row.number, row.sender, row.receiver, row.kind, row.payload_bytes) == (0, 0, 1, "features", 2000)
    assert (row.status, row.reason, row.fragments, row.fragments_lost, row.repairs) == (Status.DELIVERED, "", 2, 0, 0)
    assert row.wire_bytes == 2000 + 2 * 150
    assert row.mcs == 11
    assert row.t_sent_s == row.t_start_s == 0.0
    ppdu_s = 44e-6 + 13.6e-6 * 3
    assert row.airtime_s == pytest.approx(ppdu_s + 16e-6 + 32e-6)  # with its block ack
    assert ppdu_s <= row.t_done_s <= ppdu_s + 9e-6  # at once on an idle medium, at the next slot
    assert row.deadline_s == 0.1


def test_a_lossy_link_loses_best_effort_samples_and_repairs_reliable_ones() -> None:
    edge = AirSettings(shadowing_sigma_db=0.0, rician_k_db=3.0, retry_limit=0)  # every failed frame is a lost fragment
    fates = {}
    for reliable in (False, True):
        f = Flight(edge, 2)
        f.fly(20.0, lambda t, f=f, r=reliable: f.send(0, 1, 30_000, reliable=r))
        fates[reliable] = f.rows
    assert all(r.status in (Status.DELIVERED, Status.LOST) for r in fates[False])
    lost = [r for r in fates[False] if r.status is Status.LOST]
    assert len(lost) > 10
    assert {r.reason for r in lost} == {"fragment_lost"}
    assert all(r.fragments_lost > 0 and r.t_done_s - r.t_sent_s < 0.01 for r in lost)
    repaired = [r for r in fates[True] if r.repairs]
    assert len(repaired) > 10
    for r in repaired:
        assert r.status is Status.DELIVERED
        assert r.t_done_s - r.t_sent_s > 0.025 * r.repairs  # heartbeat + NACK delay, each round
        once = max(x.wire_bytes for x in fates[True] if not x.repairs)
        assert once < r.wire_bytes <= once + r.fragments_lost * 1494 + r.repairs * 300  # what was lost, no more
    f = Flight(edge, 2)
    f.fly(20.0, lambda t: f.send(0, 1, 30_000, reliable=True, deadline_s=0.02))
    assert {(r.status, r.reason) for r in f.rows if r.fragments_lost} == {(Status.EXPIRED, "deadline_in_service")}


def test_a_dead_link_costs_a_few_tries_and_says_so() -> None:
    f = Flight(STILL, 3)
    f.extra[0, 1] = 90.0
    f.fly(1.0, lambda t: (f.send(0, 1, 50_000), f.send(0, 2, 50_000)))
    fates = Counter((r.receiver, r.status, r.reason) for r in f.rows)
    assert fates == {(1, Status.LOST, "no_link"): 10, (2, Status.DELIVERED, ""): 10}
    assert all(r.airtime_s < 10e-3 and r.mcs == -1 and r.wire_bytes == 0 for r in f.rows if r.receiver == 1)
    assert f.air.goodput_mbps(0)[0] == SILENT_MBPS
    assert f.air.goodput_mbps(0)[1] > 100


def test_a_newer_sample_replaces_the_older_of_its_kind_only() -> None:
    f = Flight(STILL, 2)

    def tick(t: float) -> None:
        if t == 0:
            for kind in ("features", "detections", "features"):
                f.send(0, 1, 600_000, kind=kind)

    f.fly(0.1, tick)
    assert [(r.number, r.reason) for r in f.rows] == [(0, "replaced"), (1, ""), (2, "")]
    assert isnan(f.rows[0].t_start_s) or f.rows[0].airtime_s == 0.0


def test_a_silenced_drone_neither_sends_nor_hears() -> None:
    f = Flight(STILL)

    def tick(t: float) -> None:
        for i in range(5):
            f.publish(i)
        if t == 0.5:
            f.send(2, 1, 600_000)
            f.send(1, 2, 600_000)
            f.air.silence(2)
            f.send(2, 1, 600_000)
            f.send(1, 3, 1000)

    f.fly(1.0, tick)
    late = [(sender, ids) for t, sender, ids in f.heard if t > 0.5]
    assert all(sender != 2 and 2 not in ids for sender, ids in late)
    assert any(ids for _, ids in late)
    assert any(2 in ids for t, _, ids in f.heard if t < 0.5)
    fates = {r.number: (r.status, r.reason) for r in f.rows}
    assert fates == {
        0: (Status.LOST, "sender_gone"),
        1: (Status.LOST, "receiver_gone"),
        2: (Status.LOST, "sender_gone"),
        3: (Status.DELIVERED, ""),
    }


def test_what_a_silenced_drone_had_put_on_the_air_is_counted() -> None:
    def wire_bytes(end: Callable[[Flight], object]) -> int:
        f = Flight(STILL, 2)
        f.air.advance()
        f.send(0, 1, 600_000)
        f.env.timeout(0.01).callbacks.append(lambda _: end(f))
        f.env.run(until=0.02)
        assert 0.009 < f.rows[0].airtime_s < 0.0105  # less the backoffs; an exchange counts at its begin
        assert f.air.counters.data_wire_bytes == sum(r.wire_bytes for r in f.rows)
        return f.rows[0].wire_bytes

    silenced = wire_bytes(lambda f: f.air.silence(0))
    assert silenced == wire_bytes(lambda f: f.send(0, 1, 1)) > 100_000  # as one that is replaced then


@pytest.mark.parametrize("end", [lambda air: None, lambda air: air.silence(0)], ids=["it flies on", "it is lost"])
def test_a_descriptor_on_the_air_counts_as_heard_and_missed_whatever_becomes_of_its_sender(
    end: Callable[[Air], None],
) -> None:
    f = Flight(STILL, 3, spread=0.0)
    f.extra[0, 2] = 200.0
    f.air.advance(f.extra)
    f.publish(0)
    f.env.timeout(2e-4).callbacks.append(lambda _: end(f.air))
    f.env.run(until=0.01)
    assert [(sender, ids) for _, sender, ids in f.heard] == [(0, (1,))]
    assert (f.air.counters.receptions, f.air.counters.missed) == (1, 1)
    assert f.air.counters.lost_to["weak_signal"] == 1


def test_what_is_in_flight_at_the_end_is_told() -> None:
    f = Flight(STILL, 2)
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


# --- goodput as measured -----------------------------------------------------------------------------


def test_goodput_of_a_large_sample_is_its_bits_over_its_time() -> None:
    f = Flight(STILL, 2)
    f.fly(0.1, lambda t: f.send(0, 1, 64 * 1344 * 5))
    (row,) = f.rows
    mbps = row.payload_bytes * 8e-6 / (row.t_done_s - row.t_start_s)
    assert (
        0.95 * mbps < f.air.goodput_mbps(0)[0] <= mbps
    )  # never above what backoffs leave; its first exchange had none
    assert f.air.goodput_mbps(1) == (0.0,)  # nothing sent, nothing known


@pytest.mark.parametrize("payload", [50_000, 163_840, 655_360])
def test_a_drop_of_30_db_shows_within_one_frame(payload: int) -> None:
    f = Flight()
    read: dict[float, tuple[float, ...]] = {}

    def tick(t: float) -> None:
        read[round(t, 1)] = f.air.goodput_mbps(2)
        if t >= 1.9:
            f.extra[2, :] = f.extra[:, 2] = 30.0  # in force from 2.0
        send = f.everyone(payload, deadline_s=0.065)
        f.env.timeout(0.03).callbacks.append(lambda _: send(t))

    f.fly(3.0, tick)
    assert max(read[2.0]) > 20
    assert max(read[2.1]) < 5


def test_small_samples_show_that_a_link_has_recovered() -> None:
    f = Flight(STILL, 3)
    read: dict[float, float] = {}

    def tick(t: float) -> None:
        t = round(t, 1)
        read[t] = f.air.goodput_mbps(0)[0]
        f.extra[0, 1] = 60.0 if 0.9 <= t < 1.9 else 0.0  # in force from 1.0 to 2.0
        if t * 2 == int(t * 2):
            f.send(0, 1, 150, kind="detections")

    f.fly(4.0, tick)
    assert read[0.9] > 100
    assert read[1.9] == SILENT_MBPS
    assert read[2.6] > 5


def test_a_sample_held_up_by_its_own_queue_lowers_the_reading() -> None:
    f = Flight(STILL, 3)

    def tick(t: float) -> None:
        t = round(t, 1)
        if t == 0:
            f.send(0, 1, 100_000)
            f.send(0, 2, 100_000)
        if t == 0.1:
            assert min(f.air.goodput_mbps(0)) > 100
            f.extra[0, 1] = 33.0
        if t == 0.2:
            f.send(0, 1, 3_000_000)
            f.send(0, 2, 100_000)
        if t == 0.3:
            assert max(f.air.goodput_mbps(0)) < 5

    f.fly(0.4, tick)
    assert {r.reason for r in f.rows[2:]} <= {"deadline_queued", "deadline_in_service"}


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
    traffic,
    st.integers(0, 99),
    st.sampled_from([0, 7]),
    st.sampled_from([0.0, 10.0, 25.0]),
    st.none() | st.integers(0, 19),
)
def test_bytes_are_conserved_and_goodput_stays_below_the_phy_rate(
    samples: list, seed: int, retry_limit: int, loss_db: float, silenced_at: int | None
) -> None:
    f = Flight(AirSettings(retry_limit=retry_limit, tx_power_dbm=15.0), 4, seed=seed)
    f.extra[1, :] = loss_db

    def tick(t: float) -> None:
        k = round(t * 10)
        for i in range(4):
            f.publish(i)
            assert all(0 <= g < STANDARDS["ax"].rates_mbps[80][11] for g in f.air.goodput_mbps(i))
        for frame, sender, hop, payload, kind, reliable, deadline_s in samples:
            if frame == k:
                f.send(sender, (sender + hop) % 4, payload, kind=kind, reliable=reliable, deadline_s=deadline_s)
        if k == silenced_at:
            f.air.silence(3)

    f.fly(2.0, tick)
    flying = f.air.finish()
    c = f.air.counters
    rows = f.rows + flying
    assert sorted(r.number for r in rows) == list(range(len(samples)))
    by = {s: sum(r.payload_bytes for r in rows if r.status is s) for s in Status}
    assert by[Status.DELIVERED] == c.data_delivered_bytes
    assert by[Status.LOST] == c.data_lost_bytes
    assert by[Status.EXPIRED] == c.data_expired_bytes
    assert by[Status.IN_FLIGHT] == f.air.data_in_flight_bytes
    assert sum(by.values()) == c.data_sent_bytes == sum(s[3] for s in samples)
    for r in f.rows:
        assert r.t_sent_s <= r.t_done_s <= r.deadline_s + 1e-9
        assert isnan(r.t_start_s) or r.t_sent_s <= r.t_start_s <= r.t_done_s
        assert (r.status is Status.DELIVERED) == (r.reason == "")
        assert r.status is not Status.DELIVERED or r.wire_bytes >= r.payload_bytes
    assert sum(f.air.airtime_s) <= 4 * 2.0
    assert f.air.utilisation <= 1.0


# --- context -----------------------------------------------------------------------------------------


def test_broadcasts_reach_everyone_near_and_cost_two_events_each() -> None:
    f = Flight(STILL, spread=0.0)
    f.fly(2.0, lambda t: f.publish(round(t * 10) % 5))
    assert len(f.heard) == 20
    assert all(ids == tuple(i for i in range(5) if i != sender) for _, sender, ids in f.heard)
    assert f.air.counters.receptions == 80
    assert next(f.env._eid) <= 20 + 2 * 20 + 3  # one a frame to tick, two a broadcast, the process and the end
    assert f.air.airtime_s == pytest.approx([4 * 468e-6] * 5)


def test_broadcasts_in_step_are_sent_together_and_out_of_step_hardly_collide() -> None:
    counters = {}
    for spread in (0.0, 0.8):
        f = Flight(STILL, spread=spread)
        f.fly(20.0, lambda t, f=f: [f.publish(i) for i in range(5)])
        counters[spread] = f.air.counters
        assert sum(counters[spread].lost_to.values()) == counters[spread].missed
    assert counters[0.0].lost_to["half_duplex"] == counters[0.0].missed == 4000  # who sends hears nobody
    assert counters[0.8].missed < 0.02 * 4000


def test_a_far_receiver_misses_some_broadcasts_a_dead_one_all() -> None:
    f = Flight(AirSettings(shadowing_sigma_db=0.0, preamble_detection_dbm=-110.0), 3)
    f.extra[0, 1], f.extra[0, 2] = 37.5, 90.0
    f.fly(20.0, lambda t: f.publish(0))
    counts = Counter(i for _, _, ids in f.heard for i in ids)
    assert 20 < counts[1] < 190
    assert counts[2] == 0
    assert f.air.counters.missed == 400 - counts[1]


def test_same_inputs_same_fates_and_a_sixth_silent_drone_changes_none() -> None:
    def fates(n: int, seed: int = 1) -> tuple[list, list]:
        f = Flight(AirSettings(retry_limit=0), n, seed=seed)

        def tick(_: float) -> None:
            for i in range(5):
                f.publish(i)
                f.send(i, (i + 1) % 5, 100_000)

        f.fly(5.0, tick)
        return f.rows, [(t, s, tuple(i for i in ids if i < 5)) for t, s, ids in f.heard]

    assert fates(5) == fates(5)
    assert fates(5) == fates(6)
    assert fates(5) != fates(5, seed=2)


def test_the_first_frame_may_begin_after_the_air_is_there() -> None:
    f = Flight(STILL)
    f.env.run(until=0.25)
    f.air.advance()
    f.send(0, 1, 2000)
    f.publish(0)
    f.env.run(until=0.5)
    assert [r.status for r in f.rows] == [Status.DELIVERED]
    assert [ids for _, _, ids in f.heard] == [(1, 2, 3, 4)]


def test_a_descriptor_that_is_handed_over_early_is_as_one_that_is_handed_over_in_time() -> None:
    """Also between payloads: what waits for its time neither holds them up nor is held up."""
    rng = np.random.default_rng(3)
    due = list(zip(np.sort(rng.uniform(0.0, 0.9, 200)).tolist(), rng.integers(0, 5, 200).tolist(), strict=True))

    def flown(early: bool) -> tuple[list[object], list[object]]:
        f, heard = Flight(seed=3, spread=0.0), []

        def give(at: float, sender: int) -> None:
            in_s = max(0.0, at - f.env.now)
            f.air.broadcast(sender, 208, lambda ids: heard.append((at, round(f.env.now, 9), list(ids))), in_s)

        def tick(t: float) -> None:
            for at, sender in due:
                if t <= at < t + 0.1 and early:
                    give(at, sender)
                elif t <= at < t + 0.1:
                    wait = f.env.timeout(at - f.env.now, (at, sender))
                    wait.callbacks.append(lambda event: give(*event.value))
            f.everyone(40_000, peers=1)(t)

        f.fly(1.0, tick)
        return heard, [(row.status, round(row.t_done_s, 9), row.airtime_s) for row in f.rows]

    heard, rows = flown(early=True)
    assert (heard, rows) == flown(early=False)
    assert (len(heard), len(rows)) == (200, 50)
    assert all(heard_s - at > 0.4e-3 for at, heard_s, _ in heard)


def test_arguments_out_of_bounds_are_refused() -> None:
    f = Flight(STILL, 2)
    f.air.advance()
    with pytest.raises(ValueError, match=r"sender is 0 and receiver 0, must be two drones in \[0, 1\]"):
        f.send(0, 0, 1)
    with pytest.raises(ValueError, match="payload_bytes is 0, must be at least 1"):
        f.send(0, 1, 0)
    with pytest.raises(ValueError, match=r"deadline_s is nan, must be at least 0"):
        f.send(0, 1, 1, deadline_s=float("nan"))
    with pytest.raises(ValueError, match=r"sender is 2, must be in \[0, 1\]"):
        f.air.broadcast(2, 10, print)
    with pytest.raises(ValueError, match=r"payload_bytes is 3000, must be in \[1, 2200\]"):
        f.air.broadcast(0, 3000, print)
    with pytest.raises(ValueError, match=r"in_s is -0.1, must be at least 0"):
        f.air.broadcast(0, 10, print, -0.1)
    with pytest.raises(ValueError, match=r"publish_spread is 2\.0, must be in \[0, 1\]"):
        Flight(STILL, 2, spread=2.0)


def test_a_link_whose_payloads_only_waited_is_not_silent() -> None:
    """Silent means that something was tried and nothing got through; a queue behind another link says less."""
    links = Goodput(3)
    links.measured(0, 1, 50.0, 1.0)
    links.bounded(0, 1, 0.0)
    links.bounded(0, 2, 0.0)
    assert {receiver: state_of(mbps) for receiver, mbps in links.read(0, 1.0).items()} == {1: LinkState.MEASURED}
    links.measured(0, 1, 0.0, 1.0)
    links.bounded(0, 1, 3.0)
    assert state_of(links.read(0, 1.0)[1]) == LinkState.SILENT
