"""The radio's joints: which argument goes where, two options together, drones that are gone, draws that must be independent.

Joints, each with a test below:

1. A jammer meets a receiver: that receiver's noise, in the attitude of this frame, over modelled and traced links alike.
2. A loss between a sender and a receiver: sender by receiver, over modelled and traced links alike.
3. What a sender knows: the frame before, whatever changed since.
4. A link's ends: each with its own antenna, attitude and height.
5. A block of frames and the next: one flight, in small fleets and large ones, with every option at once.
6. A silenced drone: no link to it and none from it, no frame of it, no entry of it in what others know.
7. A route over several hops: its hops are spent where they are flown, and its goodput is that of its hops in sequence.
8. A repair: it waits for the heartbeat and for the answer.
9. Goodput: down at once, up by a share of the gap.
10. Accounts: up to now, whatever was asked before.

Draws that must be independent of each other:

- losses of fragments: of each sender, direction, seed and replication;
- losses of descriptors: of each receiver of one descriptor;
- shadowing and bursts: of each pair, and of each other;
- publishing moments: of each drone.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from radio_examples import CROSS_M, still
from radio_flights import Hover, trace

from sortie.radio.air import Air
from sortie.radio.channel.antenna import antenna_loss_db
from sortie.radio.channel.bursts import PairStates
from sortie.radio.channel.draws import StreamShadowing
from sortie.radio.channel.pathloss import path_loss_db
from sortie.radio.channel.shadowing import ShadowField
from sortie.radio.channel.snr import SQUARE, Channel
from sortie.radio.channel.traces import read_links
from sortie.radio.goodput import RISE, Goodput
from sortie.radio.overrides import Overrides
from sortie.radio.relay import Routes
from sortie.radio.settings import AirSettings, BurstSettings

Array = np.ndarray[Any, Any]
CALM = AirSettings(shadowing_sigma_db=0.0)
LOSSY = AirSettings(shadowing_sigma_db=0.0, retry_limit=0, bursts=BurstSettings(loss_good=0.5))


def tilting(frames: int, n: int) -> Array:
    """[frames, n, 3]: every drone's own axis, another in every frame."""
    k, i = np.arange(frames)[:, None], np.arange(n)
    tilt, turn = 0.2 + 0.5 * np.sin(0.05 * k + i) ** 2, 0.11 * k + 2.0 * i
    return np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=-1)


def moving(frames: int, n: int) -> Array:
    """[frames, n, 3]: a row that spreads, at several heights."""
    k, i = np.arange(frames)[:, None], np.arange(n)
    return np.stack([i * 30.0 + 0.03 * k * i, 5.0 * np.sin(0.02 * k + i), 40.0 + 7.0 * i + 0.0 * k], axis=-1)


# --- the channel -----------------------------------------------------------------------------------


@pytest.mark.parametrize("antenna", ["isotropic", "dipole"])
@pytest.mark.parametrize("path_loss", ["log_distance", "two_ray"])
def test_every_frame_is_the_link_budget_of_that_frame(antenna: Any, path_loss: Any) -> None:
    """With jammers, losses that differ by direction, tilted antennas of some drones: by hand, link by link."""
    n, frames = 4, 40
    own = {1: "isotropic"} if antenna == "dipole" else {2: "dipole"}
    config = AirSettings(
        shadowing_sigma_db=0.0, antenna=antenna, own_antennas=own, path_loss=path_loss, ground_roughness_m=0.0,  # type: ignore[arg-type]
    )  # fmt: skip
    at, up = moving(frames, n), tilting(frames, n)
    channel = Channel(config, at, 1, 0, 0.1, up)
    extra = np.arange(n * n, dtype=float).reshape(n, n)
    jammers = [((50.0, 40.0, 10.0), 15.0), ((-80.0, 0.0, 90.0), 25.0)]
    pattern = config.antennas(n)

    def lost_db(drone: int, toward: Array, frame: int) -> float:
        cosine = toward @ up[frame, drone] / np.linalg.norm(toward)
        return float(antenna_loss_db(pattern[drone], cosine))

    for frame in range(frames):
        channel.advance(extra, jammers)
        for j in range(n):
            noise_mw = 10 ** (channel.noise_dbm / 10)
            for place, power_dbm in jammers:
                away = at[frame, j] - place
                loss = float(path_loss_db(config, np.linalg.norm(away), at[frame, j, 2], place[2]))
                noise_mw += 10 ** ((power_dbm - loss - lost_db(j, away, frame)) / 10)
            for i in set(range(n)) - {j}:
                away = at[frame, i] - at[frame, j]
                loss = float(path_loss_db(config, np.linalg.norm(away), at[frame, i, 2], at[frame, j, 2]))
                loss += lost_db(i, away, frame) + lost_db(j, away, frame) + extra[i, j]
                wanted = config.tx_power_dbm - loss - 10 * np.log10(noise_mw)
                assert channel.snr_db[i, j] == pytest.approx(wanted, abs=1e-6), (frame, i, j)


@pytest.mark.parametrize("distance_m", [None, 30.0])
def test_a_pair_of_a_large_fleet_has_the_links_that_it_has_alone(distance_m: float | None) -> None:
    """Over three blocks of frames, with tilted dipoles of some drones, a jammer and losses by direction."""
    frames, n = 70, SQUARE + 3
    at, up = moving(frames, n), tilting(frames, n)
    own = {1: "dipole", 3: "dipole", SQUARE: "dipole", SQUARE + 1: "dipole"}
    config = AirSettings(own_antennas=own, shadowing_distance_m=distance_m)  # type: ignore[arg-type]
    extra = np.arange(n * n, dtype=float).reshape(n, n) % 7
    large, small = Channel(config, at, 4, 1, 0.1, up), Channel(config, at[:, :4], 4, 1, 0.1, up[:, :4])
    calm = AirSettings(own_antennas=own, shadowing_sigma_db=0.0)  # type: ignore[arg-type]
    late = [Channel(calm, at, 4, 1, 0.1, up), Channel(replace_ids(calm), at[:, -3:], 4, 1, 0.1, up[:, -3:])]
    jammers = [((20.0, 10.0, 5.0), 5.0)]
    for _ in range(frames):
        large.advance(extra, jammers)
        small.advance(extra[:4, :4], jammers)
        np.testing.assert_allclose(large.snr_db[:4, :4], small.snr_db, atol=2e-3)
        late[0].advance(extra, jammers)
        late[1].advance(extra[-3:, -3:], jammers)
        np.testing.assert_allclose(late[0].snr_db[-3:, -3:], late[1].snr_db, atol=2e-3)


def replace_ids(config: AirSettings) -> AirSettings:
    """The settings for the last three drones alone."""
    own = {drone - SQUARE: antenna for drone, antenna in config.own_antennas.items() if drone >= SQUARE}
    return AirSettings(own_antennas=own, shadowing_sigma_db=config.shadowing_sigma_db)


@pytest.mark.parametrize(("n", "distance_m"), [(3, None), (3, 60.0), (SQUARE + 8, None), (SQUARE + 8, 60.0)])
def test_shadowing_goes_on_from_one_block_of_frames_to_the_next(n: int, distance_m: float | None) -> None:
    """A step between two blocks is as small as one within a block, also for drones that only a large fleet has."""
    at = np.zeros((2200 if n <= SQUARE else 200, n, 3))
    at[:, :, 0], at[:, :, 2] = np.arange(n) * 20.0, 60.0
    config = AirSettings(shadowing_distance_m=distance_m)
    channel = Channel(config, at, 2, 0, 0.1)
    rows = []
    for _ in range(len(at)):
        channel.advance()
        rows.append(channel.shadow_db[np.triu_indices(n, 1)])
    steps = np.abs(np.diff(np.array(rows), axis=0))
    usual = np.nanmean(steps)
    by_frame = np.nanmean(steps, axis=1)
    few = 6.0 if n == 3 else 1.6  # of 3 pairs, or of 780
    assert by_frame.max() < few * usual
    late = np.nanmean(steps[:, -7:], axis=1)  # pairs of the last drones
    assert late.max() < 6.0 * usual


@pytest.mark.parametrize("n", [3, SQUARE + 8])
def test_a_field_of_shadows_has_the_time_of_the_flight_in_every_block(n: int) -> None:
    """Also after the fleet has taken another way."""
    frames = 2200 if n <= SQUARE else 200
    at = np.zeros((frames, n, 3))
    at[:, :, 0], at[:, :, 2] = np.arange(n) * 20.0, 60.0
    channel, field = Channel(AirSettings(shadowing_distance_m=60.0), at, 2, 0, 0.1), ShadowField(3.5, 60.0, 4.5, 2, 0)
    other = at.copy()
    other[frames // 2 + 1 :, :, 1] = np.arange(n) * 5.0
    for frame in range(frames):
        if frame == frames // 2 + 1 and n <= SQUARE:
            channel.reroute(other)
            at = other
        channel.advance()
        if frame % 16 in (0, 15):
            wanted = field.between(at[frame], 0.1 * frame)
            np.testing.assert_allclose(np.nan_to_num(channel.shadow_db), wanted, atol=1e-3)


@pytest.mark.parametrize("n", [4, SQUARE + 3])
@pytest.mark.parametrize("at_frame", [5, 32])
def test_a_fleet_that_takes_another_way_has_the_links_of_one_that_flew_it_all_along(n: int, at_frame: int) -> None:
    """Places and attitudes, for the links between drones and for a jammer; large fleets follow from their next block on."""
    frames, config = 70, AirSettings(shadowing_sigma_db=0.0, antenna="dipole")
    at, up = moving(frames, n), tilting(frames, n)
    other, turned = at.copy(), up.copy()
    other[at_frame:] += np.array([0.0, 0.5, 3.0]) * np.arange(n)[:, None]
    turned[at_frame:] = tilting(frames, n + 1)[at_frame:, 1:]
    jammers = [((20.0, 10.0, 5.0), 5.0)]
    changed, planned = Channel(config, at, 1, 0, 0.1, up), Channel(config, other, 1, 0, 0.1, turned)
    follows_from = at_frame if n <= SQUARE else -(-at_frame // 32) * 32
    for frame in range(frames):
        if frame == at_frame:
            changed.reroute(other, turned)
        changed.advance(None, jammers)
        planned.advance(None, jammers)
        np.testing.assert_allclose(changed.noise_rise_db(jammers), planned.noise_rise_db(jammers), atol=1e-9)
        if frame < at_frame or frame >= follows_from:
            np.testing.assert_allclose(changed.snr_db, planned.snr_db, atol=1e-6)


def test_a_sender_knows_the_frame_before_whatever_has_changed_since() -> None:
    """Jammer, loss and motion show in what it knows one frame later, and then as they were."""
    at = still(CROSS_M[:3], 10).copy()
    at[5:, 1, 0] += 100.0
    channel = Channel(AirSettings(), at, 1, 0, 0.1)
    jammers = [((0.0, 30.0, 60.0), 10.0)]
    channel.advance()
    was = channel.now.square_db
    np.testing.assert_array_equal(channel.before.square_db, was)  # in the first frame its own
    for frame in range(1, 10):
        extra = None if frame % 3 else np.full((3, 3), float(frame))
        channel.advance(extra, jammers if frame % 2 else ())
        np.testing.assert_array_equal(channel.before.square_db, was)
        assert not np.allclose(channel.now.square_db[0, 1], was[0, 1], atol=1e-6)
        was = channel.now.square_db


@pytest.mark.parametrize("by_trace", [False, True])
def test_a_payload_goes_at_the_rate_of_the_frame_before_and_is_lost_to_the_present_one(
    by_trace: bool, tmp_path: Path
) -> None:
    """A link that fades from one frame to the next, for four frames: its sender learns it a frame late, both times."""
    weak = set(range(5, 9))
    rows = [f"{0.1 * k:.1f},0,1,{8 if k in weak else 40},," for k in range(20)]
    config = AirSettings(trace=trace(tmp_path, *rows)) if by_trace else CALM
    flight = Hover(config, np.array([[0.0, 0.0, 60.0], [20.0, 0.0, 60.0]]))
    planned: list[Any] = []

    def tick(k: int) -> None:
        flight.send(0, 1, 3000)
        planned.append(flight.air.link_mbps()[0, 1])

    for k in range(12):
        flight.extra = None
        if not by_trace and k in weak:
            flight.extra = np.full((2, 2), 38.0)
        flight.air.advance(flight.extra)
        tick(k)
        flight.env.run(until=0.1 * (k + 1))
    mcs, snr_db = ({round(10 * r.t_sent_s): getattr(r, name) for r in flight.rows} for name in ("mcs", "snr_db"))
    fast = mcs[0]
    assert {k for k in range(12) if mcs[k] < fast} == {k for k in range(12) if planned[k] < planned[0]} == {6, 7, 8, 9}
    assert {k for k in range(12) if snr_db[k] < 20} == weak


# --- traces and bursts beside the models -------------------------------------------------------------


def traced(tmp_path: Path, *rows: str, n: int = 3) -> Overrides:
    file = trace(tmp_path, *rows, columns="t_s,sender,receiver,snr_db,loss,goodput_mbps")
    settings = AirSettings(trace=file)
    return Overrides(settings, read_links(file, n), n, seed=1, replication=0, frame_s=0.1)


def test_losses_and_jammers_act_on_a_traced_link_as_on_a_modelled_one(tmp_path: Path) -> None:
    """By sender and receiver for a loss, by receiver for a jammer; known one frame later."""
    over = traced(tmp_path, "0,0,1,30,,", "0,1,0,25,,", "0,1,2,20,,")
    extra, rise = np.arange(9.0).reshape(3, 3), np.array([1.0, 5.0, 11.0])
    model = np.full((3, 3), -50.0)
    over.advance(None)
    assert over.snr_of(0, 1, -9.0, -8.0) == (30.0, 30.0)
    over.advance(extra, rise)
    wanted = {(0, 1): 30 - 1 - 5, (1, 0): 25 - 3 - 1, (1, 2): 20 - 5 - 11}
    for (i, j), snr_db in wanted.items():
        assert over.snr_db(model)[i, j] == snr_db
        assert over.snr_of(i, j, -9.0, -8.0) == ({(0, 1): 30.0, (1, 0): 25.0, (1, 2): 20.0}[i, j], snr_db)
        assert over.known_snr_db(model)[i, j] == {(0, 1): 30.0, (1, 0): 25.0, (1, 2): 20.0}[i, j]
    assert over.snr_of(2, 0, -9.0, -8.0) == (-9.0, -8.0)  # not traced
    over.advance(None)
    for (i, j), snr_db in wanted.items():
        assert over.known_snr_db(model)[i, j] == snr_db
        assert over.snr_of(i, j, 0.0, 0.0)[0] == snr_db


def test_losses_and_jammers_that_the_air_is_told_of_reach_traced_links(tmp_path: Path) -> None:
    """The same through the air as for the links alone, beside modelled ones, and only while they last."""
    links = trace(tmp_path, "0,0,1,30,,", "0,1,0,25,,")
    flight = Hover(AirSettings(shadowing_sigma_db=0.0, trace=links), n=3)
    jammers, extra = [((0.0, 30.0, 60.0), 10.0)], np.arange(9.0).reshape(3, 3)
    flight.air.advance()
    plain = flight.air.snr_db
    assert (plain[0, 1], plain[1, 0]) == (30.0, 25.0)
    for loss, by in ((extra, ()), (None, jammers), (extra, jammers), (None, ())):
        flight.air.advance(loss, by)
        rise = flight.air.channel.noise_rise_db(by)
        assert (rise > 1.0).all() == bool(by)
        lost = plain - flight.air.snr_db
        wanted = rise[None] + (0.0 if loss is None else loss)
        off = ~np.eye(3, dtype=bool)
        np.testing.assert_allclose(lost[off], np.broadcast_to(wanted, (3, 3))[off], atol=1e-9)


@pytest.mark.parametrize("loss", [0.3, 0.9])
def test_a_traced_loss_takes_tries_as_a_burst_of_that_loss_does(loss: float, tmp_path: Path) -> None:
    """Of fragments and of requests for a block ack: on a good link the two are the same, draw by draw."""
    rows = [f"0,{i},{j},,{loss}," for i, j in ((0, 1), (1, 0))]
    flown = []
    for given in (dict(trace=trace(tmp_path, *rows)), dict(bursts=BurstSettings(loss_good=loss))):
        flight = Hover(AirSettings(shadowing_sigma_db=0.0, rician_k_db=30.0, **given))  # type: ignore[arg-type]
        flight.fly(6.0, lambda k, flight=flight: flight.send(0, 1, 2_600))  # type: ignore[misc]
        flown.append(
            [(r.number, r.status, r.t_start_s, r.t_done_s, r.airtime_s, r.fragments_lost) for r in flight.rows]
        )
    assert len(flown[0]) == 60
    assert flown[0] == flown[1]


def test_a_traced_loss_takes_from_the_rate_of_its_own_direction(tmp_path: Path) -> None:
    """Whatever is lost is sent again, so that a link carries 1 − loss of what it does without; others are as modelled."""
    flight = Hover(
        AirSettings(shadowing_sigma_db=0.0, trace=trace(tmp_path, "0,0,1,,0.4,", "0,1,0,,0.1,", "0,2,0,,0,")), n=3
    )
    flight.fly(0.2)
    mbps = flight.air.link_mbps()
    whole = mbps[2, 0]
    assert (mbps[0, 1], mbps[1, 0]) == (pytest.approx(0.6 * whole), pytest.approx(0.9 * whole))
    assert mbps[0, 2] == pytest.approx(whole, rel=0.01)


# --- who is gone ---------------------------------------------------------------------------------------


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


# --- routes --------------------------------------------------------------------------------------------


def test_a_payload_has_no_more_hops_left_than_it_has_not_flown() -> None:
    """In a row of five, each reached well by its neighbours alone: two hops reach two drones on, and no farther way is taken."""
    n = 5
    mbps = np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            if i != j:
                mbps[i, j] = {1: 100.0, 2: 12.0, 3: 5.0, 4: 2.0}[abs(i - j)]
    routes = Routes(3)
    routes.renew(mbps)
    for left in (1, 2, 3):
        for target in (2, 3, 4):
            path, hops = [0], left
            while path[-1] != target:
                path.append(routes.next_hop(path[-1], target, hops))
                hops -= 1
                assert hops >= 0, (left, target, path)
    assert routes.path(0, 4) != [0, 4]


def test_a_relayed_sample_takes_at_most_the_hops_that_a_route_may_have(tmp_path: Path) -> None:
    """Links that change while it is under way: each relay has only what is left, and then goes straight to the target."""
    n = 5
    mbps = {1: 60.0, 2: 6.0, 3: 3.0, 4: 2.0}
    rows = [f"0,{i},{j},,,{mbps[abs(i - j)]}" for i in range(n) for j in range(n) if i != j]
    flight = Hover(
        AirSettings(trace=trace(tmp_path, *rows), relay_max_hops=2), np.array([[20.0 * i, 0, 60] for i in range(n)])
    )
    flight.fly(2.0, lambda k: flight.send(0, 4, 8000, deadline_s=0.9) if k % 4 == 0 else None)
    assert flight.rows
    assert {r.hops for r in flight.rows} <= {1, 2}


def test_goodput_over_hops_is_that_of_the_hops_in_sequence(tmp_path: Path) -> None:
    """1 / (1 / 80 + 1 / 20), not the weaker of the two."""
    rows = ["0,0,1,,,80", "0,1,0,,,80", "0,1,2,,,20", "0,2,1,,,20", "0,0,2,,,1", "0,2,0,,,1"]
    flight = Hover(AirSettings(trace=trace(tmp_path, *rows), relay_max_hops=2), n=3)

    def tick(k: int) -> None:
        flight.send(0, 1, 20_000, kind="a")
        flight.send(1, 2, 20_000, kind="b")

    flight.fly(1.0, tick)
    known, onward = flight.air.goodput_mbps(0), flight.air.goodput_mbps(1)[1]
    assert known[1] == pytest.approx(1 / (1 / known[0] + 1 / onward))
    assert 1.0 < known[1] < 0.7 * min(known[0], onward)


# --- transport and goodput ------------------------------------------------------------------------------


@pytest.mark.parametrize(("heartbeat_s", "nack_delay_s"), [(0.02, 0.005), (0.05, 0.03), (0.0, 0.04)])
def test_a_repair_waits_for_the_heartbeat_and_the_answer(
    heartbeat_s: float, nack_delay_s: float, tmp_path: Path
) -> None:
    """Both, in every round."""
    file = trace(tmp_path, "0,0,1,,0.5,", "0,1,0,,0.5,")
    config = AirSettings(trace=file, retry_limit=0, heartbeat_s=heartbeat_s, nack_delay_s=nack_delay_s)
    flight = Hover(config)
    flight.fly(6.0, lambda k: flight.send(0, 1, 6000, reliable=True, deadline_s=0.95) if k % 10 == 0 else None)
    repaired = [r for r in flight.rows if r.repairs and r.status == "delivered"]
    assert len(repaired) >= 3
    for r in repaired:
        took_s = r.t_done_s - r.t_start_s
        waits_s = r.repairs * (heartbeat_s + nack_delay_s)
        assert waits_s <= took_s < waits_s + 0.01 * (r.repairs + 1)


def test_goodput_falls_at_once_and_rises_by_a_share_of_the_gap() -> None:
    goodput = Goodput(2)
    seen = []
    for k, mbps in enumerate((100.0, 40.0, 80.0, 80.0, 10.0)):
        goodput.measured(0, 1, mbps, 0.1 * k)
        seen.append(goodput.read(0, 0.1 * k)[1])
    first = 40 + RISE * 40
    assert seen == pytest.approx([100.0, 40.0, first, first + RISE * (80 - first), 10.0])
    assert goodput.read(1, 0.4) == {}  # the other direction is another link
    goodput.bounded(0, 1, 50.0)
    assert goodput.read(0, 0.4)[1] == 10.0  # a bound does not raise it
    goodput.bounded(0, 1, 4.0)
    assert goodput.read(0, 0.4)[1] == 4.0


@pytest.mark.parametrize("payload", [40, 150, 1300, 60_000])
def test_no_goodput_is_above_what_the_link_carries_alone(payload: int) -> None:
    """A lone small frame is acknowledged before a full one would be."""
    flight = Hover(CALM, n=3)
    flight.fly(2.0, lambda k: [flight.send(0, j, payload) for j in (1, 2)])
    flight.air.advance()
    known, carried = flight.air.goodput_mbps(0), flight.air.link_mbps()[0, 1:]
    assert (np.array(known) <= carried * 1.006).all()  # what is carried has paid for a fade in two hundred
    assert min(known) > 0.02 * carried.min()


def test_accounts_do_not_depend_on_what_was_asked_before() -> None:
    """Half-way through a transmission: each figure asked first, and after the others."""

    def asked(*names: str) -> dict[str, Any]:
        flight = Hover(CALM, n=2)
        flight.air.advance()
        flight.send(0, 1, 200_000, deadline_s=0.5)
        flight.env.run(until=0.0213)
        return {name: getattr(flight.air, name) for name in names}

    together = asked("airtime_s", "utilisation")
    assert asked("utilisation", "airtime_s") == together
    assert asked("utilisation")["utilisation"] == together["utilisation"]


def test_bytes_that_arrived_are_those_of_the_pieces_that_did() -> None:
    """Of 53 pieces the last is shorter, and counts as what it is, whether it comes or not."""
    flight = Hover(LOSSY, n=2)
    flight.fly(8.0, lambda k: flight.send(0, 1, 52 * 200 + 30, piece_bytes=200))
    cut = [r for r in flight.rows if r.missing]
    assert {52 in r.missing for r in cut} == {True, False}
    for r in cut:
        assert r.arrived_bytes == sum(30 if k == 52 else 200 for k in range(53) if k not in r.missing)


def test_a_link_too_weak_to_be_detected_is_none_for_routes_and_for_payloads() -> None:
    """Though its rate would still be one."""
    at = np.array([[0.0, 0.0, 60.0], [60.0, 0.0, 60.0], [400.0, 0.0, 60.0]])
    heard, deaf = (AirSettings(shadowing_sigma_db=0.0, preamble_detection_dbm=dbm) for dbm in (-95.0, -70.0))
    for config, there in ((heard, True), (deaf, False)):
        flight = Hover(config, at)
        flight.fly(0.3, lambda k, flight=flight: flight.send(0, 2, 500))  # type: ignore[misc]
        mbps = flight.air.link_mbps()
        assert mbps[0, 1] > 0
        assert (mbps[0, 2] > 0) == there
        assert all((r.reason == "no_link") != there for r in flight.rows)


# --- draws that must be independent ------------------------------------------------------------------------


def lost_pieces(sender: int, receiver: int, seed: int = 1, replication: int = 0) -> Array:
    """Which pieces of 40 samples were lost, one bit each, where a link loses half of them and nobody else sends."""
    flight = Hover(LOSSY, n=4, seed=seed, replication=replication)
    flight.fly(4.0, lambda k: flight.send(sender, receiver, 60 * 200, piece_bytes=200))
    lost = np.zeros((40, 60), bool)
    assert len(flight.rows) == 40
    for k, row in enumerate(flight.rows):
        lost[k, list(row.missing) if row.arrived_bytes else slice(None)] = True
    return lost[lost.mean(axis=1) < 1].ravel()[: 60 * 20]


def test_losses_are_drawn_for_each_sender_direction_seed_and_replication() -> None:
    """Also between senders with the same history: neither shares its losses with the way back."""
    flights = {
        "there": lost_pieces(0, 1),
        "back": lost_pieces(1, 0),
        "other pair": lost_pieces(2, 3),
        "other receiver": lost_pieces(0, 2),
        "other seed": lost_pieces(0, 1, seed=2),
        "other replication": lost_pieces(0, 1, replication=1),
    }
    assert np.array_equal(flights["there"], lost_pieces(0, 1))
    for (a, one), (b, other) in combinations(flights.items(), 2):
        if {a, b} == {"there", "other receiver"}:
            continue  # one sender with one history
        n = min(len(one), len(other))
        assert n > 500
        assert 0.3 < one.mean() < 0.7
        agree = float(np.mean(one[:n] == other[:n]))
        assert agree == pytest.approx(0.5, abs=0.09), (a, b)


def test_receivers_lose_a_descriptor_each_by_a_draw_of_its_own() -> None:
    flight = Hover(LOSSY, n=5)
    flight.fly(60.0, lambda k: flight.publish(k % 2))
    for sender in (0, 1):
        others = [j for j in range(5) if j != sender]
        heard = np.array([[j in ids for j in others] for _, who, ids in flight.heard if who == sender])
        assert heard.mean() == pytest.approx(0.5, abs=0.06)
        off = np.corrcoef(heard.T)[~np.eye(4, dtype=bool)]
        assert np.abs(off).max() < 0.25


def faint(loss: float, **more: Any) -> AirSettings:
    """Links at the edge of what can be received, in bursts of so much loss."""
    return AirSettings(
        shadowing_sigma_db=0.0, tx_power_dbm=-11.5, rician_k_db=30.0, preamble_detection_dbm=-120.0,
        bursts=BurstSettings(loss_good=loss), **more,
    )  # fmt: skip


def test_a_burst_takes_its_share_of_the_fragments_that_the_signal_lets_through() -> None:
    """On a link that loses some by itself, a burst of a half takes half of the rest."""

    def lost(loss: float) -> float:
        flight = Hover(faint(loss, retry_limit=0), n=2)
        flight.fly(20.0, lambda k: flight.send(0, 1, 13_000))
        assert {r.mcs for r in flight.rows} == {1}
        return sum(r.fragments_lost for r in flight.rows) / sum(r.fragments for r in flight.rows)

    alone = lost(0.0)
    assert 0.1 < alone < 0.3
    assert lost(0.5) == pytest.approx(alone + 0.5 * (1 - alone), abs=0.03)


def test_a_burst_takes_its_share_of_the_descriptors_that_the_signal_lets_through() -> None:
    """Two causes, a draw each: of descriptors that half come by their signal, a burst of a half leaves a quarter, not none."""

    def heard(loss: float) -> float:
        flight = Hover(faint(loss, group_rate_mbps=24.0), n=5)
        flight.fly(12.0, lambda k: flight.publish(0))
        return sum(len(ids) for _, _, ids in flight.heard) / (4 * len(flight.heard))

    alone = heard(0.0)
    assert 0.35 < alone < 0.65
    assert heard(0.5) == pytest.approx(0.5 * alone, abs=0.06)


def columns(n: int, seed: int = 1, replication: int = 0) -> Iterator[tuple[str, Array]]:
    """Shadowing and bursts of every pair of n drones, frame by frame."""
    frames, pairs = 3000, np.triu_indices(n, 1)
    settings = AirSettings(shadowing_time_s=0.02)  # hardly any memory
    shadow = StreamShadowing(settings, seed, replication, n, 0.1).block(frames)
    states = PairStates(BurstSettings(good_to_bad=0.5, bad_to_good=0.5, step_s=0.1), n, seed, replication, 0.1)
    bad = np.array([states.advance() for _ in range(frames)])
    for i, j in zip(*pairs, strict=True):
        yield f"shadowing {i} {j} {seed} {replication}", shadow[:, i, j]
        yield f"bursts {i} {j} {seed} {replication}", bad[:, i, j]


def test_pairs_purposes_seeds_and_replications_share_no_draws() -> None:
    each = dict([*columns(3), *columns(3, seed=2), *columns(3, replication=1)])
    values = np.array(list(each.values()), float)
    assert (values.std(axis=1) > 0).all()
    correlation = np.corrcoef(values)
    np.fill_diagonal(correlation, 0.0)
    worst = np.unravel_index(np.abs(correlation).argmax(), correlation.shape)
    assert np.abs(correlation).max() < 0.1, [list(each)[k] for k in worst]


def test_pairs_begin_in_bursts_as_often_as_they_are_in_them() -> None:
    """Not all of them well: a short sortie has the losses of a long one."""
    begins = []
    for seed in range(60):
        states = PairStates(BurstSettings(good_to_bad=0.2, bad_to_good=0.3), 6, seed, 0, 0.1)
        states.advance()
        begins.append(states.bad[np.triu_indices(6, 1)].mean())
    assert np.mean(begins) == pytest.approx(0.4, abs=0.05)


def test_drones_publish_at_moments_of_their_own() -> None:
    def moments(seed: int, replication: int = 0) -> list[float]:
        flight = Hover(CALM, CROSS_M, seed=seed, replication=replication)
        flight.fly(0.3, lambda k: [flight.publish(i) for i in range(6)] if k == 1 else None)
        at = {sender: t_s - 0.1 for t_s, sender, _ in flight.heard}
        assert 0.0 < min(at.values()) < max(at.values()) < 0.09
        return [at[i] for i in range(6)]

    all_of_them = [*moments(1), *moments(2), *moments(1, replication=1)]
    gaps = np.diff(np.sort(all_of_them))
    assert gaps.min() > 1e-6
    assert np.ptp(all_of_them) > 0.05


def test_one_class_takes_every_setting() -> None:
    """An air over every option at once flies, and repeats itself."""
    config = AirSettings(
        shadowing_distance_m=20.0, antenna="dipole", path_loss="two_ray", fading="frame", rate_control="minstrel", rts=True,
        relay_max_hops=2, bursts=BurstSettings(good_to_bad=0.1), block_ack_window=256,
    )  # fmt: skip

    def flown() -> list[Any]:
        flight = Hover(config, n=4)
        flight.fly(1.0, lambda k: [flight.send(i, (i + 1) % 4, 9000, piece_bytes=900) for i in range(4)])
        assert isinstance(flight.air, Air)
        return flight.rows

    assert flown() == flown()
