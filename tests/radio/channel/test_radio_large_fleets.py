"""Fleets of any size: links of a pair do not depend on who else flies; only links within earshot are worked out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest
import simpy
from radio_examples import CROSS_M, moving, still, tilting
from radio_flights import Hover
from wrong_rows import wrong_rows

from sortie.radio import Air
from sortie.radio.channel.bursts import PairStates
from sortie.radio.channel.draws import StreamShadowing
from sortie.radio.channel.earshot import both_ways, near_pairs
from sortie.radio.channel.shadowing import ShadowField
from sortie.radio.channel.snr import OUT_OF_RANGE_DB, SQUARE, Channel, earshot_m
from sortie.radio.settings import AirSettings, BurstSettings

NEAR = AirSettings(tx_power_dbm=0.0, path_loss_exponent=3.0)


def _wide_fleet(n: int, frames: int = 70) -> np.ndarray:
    """Drones in a square that grows with their number, all flying east; the first n are the same for every n."""
    rng = np.random.default_rng(3)
    start = np.concatenate([np.concatenate([rng.random((1, 2)), np.full((1, 1), 0.06)], axis=1) for _ in range(n)])
    drift = np.arange(frames)[:, None, None] * np.array([0.5, 0.0, 0.0])
    return 1000.0 * start + drift * (np.arange(n) % 7)[None, :, None]


@pytest.mark.parametrize("distance_m", [None, 30.0])
def test_a_pair_of_a_large_fleet_has_the_links_that_it_has_alone(distance_m: float | None) -> None:
    """Over three blocks of frames, with tilted dipoles of some drones, a jammer and losses by direction."""
    frames, n = 70, SQUARE + 3
    at, up = moving(frames, n), tilting(frames, n)
    own = {1: "dipole", 3: "dipole", SQUARE: "dipole", SQUARE + 1: "dipole"}
    config = AirSettings(own_antennas=own, shadowing_distance_m=distance_m)
    extra = np.arange(n * n, dtype=float).reshape(n, n) % 7
    large, small = Channel(config, at, 4, 1, 0.1, up), Channel(config, at[:, :4], 4, 1, 0.1, up[:, :4])
    calm = AirSettings(own_antennas=own, shadowing_sigma_db=0.0)
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
    """Places and attitudes, between drones and for a jammer; large fleets follow from their next block on."""
    frames, config = 70, AirSettings(shadowing_sigma_db=0.0, antenna="dipole")
    at, up = moving(frames, n), tilting(frames, n)
    other, turned = at.copy(), up.copy()
    other[at_frame:] += np.array([0.0, 0.5, 3.0]) * np.arange(n)[:, None]
    turned[at_frame:] = tilting(frames, n + 1)[at_frame:, 1:]
    jammers = [((20.0, 10.0, 5.0), 5.0)]
    air = Air(simpy.Environment(), config, at, seed=1, frame_s=0.1, up=up)
    changed, planned = air.channel, Channel(config, other, 1, 0, 0.1, turned)
    follows_from = at_frame if n <= SQUARE else -(-at_frame // 32) * 32
    for frame in range(frames):
        if frame == at_frame:
            air.reroute(other, turned)
        changed.advance(None, jammers)
        planned.advance(None, jammers)
        np.testing.assert_allclose(changed.noise_rise_db(jammers), planned.noise_rise_db(jammers), atol=1e-9)
        if frame < at_frame or frame >= follows_from:
            np.testing.assert_allclose(changed.snr_db, planned.snr_db, atol=1e-6)


@pytest.mark.parametrize("distance_m", [None, 30.0])
@pytest.mark.parametrize("antenna", ["isotropic", "dipole"])
def test_a_flight_that_goes_another_way_is_as_if_it_had_been_planned(distance_m: float | None, antenna: str) -> None:
    """From the next frame on; what is drawn stays, within a block and across its end."""
    config = AirSettings(**{"shadowing_distance_m": distance_m, "antenna": antenna})
    planned = still(CROSS_M, 1300)
    other = planned.copy()
    other[700:, 2] += np.linspace(0, 40, 600)[:, None] * np.array([0.6, 0.8, 0.1])
    changed, known = Channel(config, planned, 1, 0, 0.1), Channel(config, other, 1, 0, 0.1)
    for frame in range(1300):
        if frame == 700:
            changed.reroute(other)
        changed.advance()
        known.advance()
        assert np.array_equal(changed.snr_db, known.snr_db, equal_nan=True)
        assert changed.now.rows_db[2][1] == known.now.rows_db[2][1]


def test_a_large_fleet_works_out_just_the_links_within_earshot() -> None:
    positions = _wide_fleet(120)
    channel = Channel(NEAR, positions, 1, 0, 0.1)
    far_m = earshot_m(NEAR)
    assert 100.0 < far_m < 600.0
    for frame in range(70):
        channel.advance()
        p = positions[frame]
        apart = np.sqrt(((p[:, None] - p[None]) ** 2).sum(axis=-1))
        listed = channel.snr_db > OUT_OF_RANGE_DB
        near = (apart <= far_m) & ~np.eye(120, dtype=bool)
        assert (listed | ~near).all()
        assert listed.sum() < 1.3 * near.sum()
        assert 0.02 < near.mean() < 0.5
        np.testing.assert_allclose(channel.shadow_db, channel.shadow_db.T, equal_nan=True)


def test_nothing_out_of_earshot_is_heard() -> None:
    """A small fleet works every link out: beyond earshot, in 1000 frames of 32 drones, no link carries a descriptor."""

    def check(sigma_db: float, k_db: float) -> None:
        config = replace(NEAR, shadowing_sigma_db=sigma_db, rician_k_db=k_db, preamble_detection_dbm=-110.0)
        positions = np.repeat(_wide_fleet(SQUARE, 1), 1000, axis=0) * earshot_m(config) / 235.0
        apart = np.sqrt(((positions[0][:, None] - positions[0][None]) ** 2).sum(axis=-1))
        heard = np.zeros((SQUARE, SQUARE), int)
        env = simpy.Environment()
        air = Air(env, config, positions, seed=2, frame_s=0.1)
        for frame in range(1000):
            env.run(until=0.1 * frame + 1e-3)
            air.advance()
            for i in range(SQUARE):
                air.broadcast(i, 20, lambda ids, i=i: np.add.at(heard[i], ids, 1))
        env.run(until=100.0)
        beyond = apart > earshot_m(config)
        assert beyond.sum() > 500
        assert heard[beyond].sum() == 0
        assert heard.sum() > 1000
        assert sigma_db or apart[heard > 0].max() > 0.5 * earshot_m(config)

    assert wrong_rows([(3.5, 12.0), (0.0, 40.0)], check) == {}


def test_shadowing_by_counter_has_the_distribution_of_that_by_stream() -> None:
    n = SQUARE + 16
    place = np.random.default_rng(1).random((n, 3)) * 30.0
    channel = Channel(AirSettings(), still(place, 640), 4, 0, 0.1)
    shadows = []
    for _ in range(640):
        channel.advance()
        shadows.append(channel.shadow_db[SQUARE:, :SQUARE].ravel())
    s = np.array(shadows)
    assert s.std() == pytest.approx(3.5, rel=0.03)
    assert (s[:-10] * s[10:]).mean() / s.var() == pytest.approx(np.exp(-1 / 4.5), abs=0.03)


def test_every_pair_in_range_is_listed_both_ways() -> None:
    p = np.random.default_rng(2).random((5, 80, 3)) * 100.0
    low, high, distance = near_pairs(p, 25.0)
    links = both_ways(80, low, high)
    apart = np.sqrt(((p[:, :, None] - p[:, None]) ** 2).sum(axis=-1))
    near = (apart.min(axis=0) <= 25.0) & ~np.eye(80, dtype=bool)
    assert np.argwhere(near).tolist() == np.stack([links.sender, links.receiver], axis=1).tolist()
    assert links.begin == [0, *np.cumsum(near.sum(axis=1)).tolist()]
    np.testing.assert_allclose([links.of_pairs(row) for row in distance], apart[:, links.sender, links.receiver])
    assert (np.diff(high * 80 + low) > 0).all()


def test_pairs_that_are_always_listed_stand_in_order_among_the_near_ones() -> None:
    at = np.array([[[0.0, 0, 0], [500, 0, 0], [10, 0, 0], [510, 0, 0]]])
    low, high, apart = near_pairs(at, 50.0, [(0, 3), (0, 2), (1, 2)])
    assert list(zip(low.tolist(), high.tolist(), apart[0].tolist(), strict=True)) == [
        (0, 2, 10.0),
        (1, 2, 490.0),
        (0, 3, 510.0),
        (1, 3, 10.0),
    ]
    assert near_pairs(at, 5.0, [(0, 1)])[0].tolist() == [0]


Array = np.ndarray[Any, Any]
CALM = AirSettings(shadowing_sigma_db=0.0)
LOSSY = AirSettings(shadowing_sigma_db=0.0, retry_limit=0, bursts=BurstSettings(loss_good=0.5))


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
