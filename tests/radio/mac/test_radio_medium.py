"""The medium, exchange by exchange: closed forms of 802.11's channel access, ns-3's throughput, and who spoils what."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
import pytest
import simpy
from radio_bench import AIFS_S, FRAME, GROUP_S, NOISE_DBM, Bench, exchange_s
from scipy import integrate, stats
from wrong_rows import wrong_rows

from sortie.radio import Air
from sortie.radio.mac import edca
from sortie.radio.mac.airtime import ACK_S, BLOCK_ACK_S, legacy_ppdu_s, ppdu_s
from sortie.radio.mac.contention import SIFS_S, SLOT_S, saturation_mbps
from sortie.radio.mac.jobs import End
from sortie.radio.mac.medium import FAINT_DB
from sortie.radio.rates import group_curve
from sortie.radio.settings import AccessSettings, AirSettings, EdcaSettings

# --- closed forms --------------------------------------------------------------------------------------


def test_a_lone_sample_ends_after_its_frames_at_the_next_slot() -> None:
    b = Bench(-50.0)
    b.run(1.0)
    job = b.submit(0, 4)
    b.run(2.0)
    ((t, number, how),) = b.log
    assert (number, how) == (job.number, End.ARRIVED)
    assert 1.0 + exchange_s(4) <= t + 1e-9 <= 1.0 + exchange_s(4) + SLOT_S + 2e-9
    assert b.medium.data_busy_s == pytest.approx(exchange_s(4) + BLOCK_ACK_S, abs=2e-9)


def test_a_sample_has_the_channel_for_its_frames_and_answers() -> None:
    """Frames with 4 B of delimiter each, padded to 4 B; an ack of one, a block ack of several, longer for up to 256."""

    sizes = {(1, 1494): 1500, (1, 197): 204, (4, 200): 3 * 1500 + 204, (4, 1491): 3 * 1500 + 1496, (4, 1493): 4 * 1500}

    def check(rts: bool, window: int, sample: tuple[int, int]) -> None:
        (frames, last), size = sample, sizes[sample]
        b = Bench(-50.0, rts=rts, block_ack_window=window)
        job = b.job(0, frames)
        job.last_bytes = last
        b.medium.submit(job)
        b.run(1.0)
        answer_s = ACK_S if frames == 1 else BLOCK_ACK_S if window == 64 else 40e-6
        sent_s = ppdu_s(size, 360.3)
        assert job.granted_s == pytest.approx(sent_s + SIFS_S + answer_s + rts * 2 * (28e-6 + SIFS_S), abs=2e-9)
        assert b.medium.transmit_s[:2] == pytest.approx([sent_s + rts * 28e-6, answer_s + rts * 28e-6], abs=2e-9)

    assert wrong_rows(product((False, True), (64, 256), sizes), check) == {}


def test_a_descriptor_on_an_idle_medium_goes_at_once() -> None:
    b = Bench(-50.0)
    for k in range(20):
        b.run(0.01 * (k + 1) + 1e-6 * k)
        before = b.env.now
        b.announce(k % 3)
        b.run(before + 2e-3)
        t, sender, fates = b.heard[-1]
        assert GROUP_S <= t - before + 1e-9 <= GROUP_S + SLOT_S + 2e-9
        assert (sender, fates) == (k % 3, (edca.HEARD, edca.HEARD))
    assert b.medium.context_busy_s == pytest.approx(20 * GROUP_S)


def test_two_descriptors_of_one_station_keep_their_backoff() -> None:
    """After a frame a station draws 0 … 3 slots, whatever the medium is like."""
    gaps = set()
    for seed in range(30):
        b = Bench(-50.0, seed=seed)
        b.announce(0)
        b.announce(0)
        b.run(1.0)
        gaps.add(round((b.heard[1][0] - b.heard[0][0] - GROUP_S - AIFS_S["voice"]) / SLOT_S, 6))
    assert gaps == {0.0, 1.0, 2.0, 3.0}


def test_single_frames_reach_bianchis_throughput() -> None:
    """Without capture, A-MPDUs and EIFS this is his model, but for how counters freeze and what a collision costs."""
    edca_2 = EdcaSettings(best_effort=AccessSettings(2, 15, 1023))
    one = ppdu_s(FRAME + 6, 360.3)
    senders = (1, 2, 5, 10, 20)
    ran = [Bench(-50.0, max(2, n), max_ampdu_frames=1, edca=edca_2).saturate(n, 50, 4.0) for n in senders]
    wanted = [saturation_mbps(n, 1344 * 8, one, ACK_S, goes_on_at_once=True) for n in senders]
    assert ran == pytest.approx(wanted, rel=0.06)


def test_saturated_ampdus_are_as_in_ns3() -> None:
    """ns-3 3.44, 64 frames at MCS 7, all stations alike in power, mean of three seeds."""
    ran = [Bench(-46.0, max(2, n)).saturate(n, 3200, 6.0) for n in (1, 2, 5, 10, 20)]
    assert ran == pytest.approx([294.3, 275.4, 242.5, 210.2, 178.7], rel=0.05)


def test_twenty_saturated_senders_in_a_grid_are_as_in_ns3() -> None:
    """ns-3 3.44, 20 m apart, each to a neighbour, mean of three seeds.

    Two pairs whose exchanges overlap must not hold the channel for good, though each misses what begins while it sends.
    """

    def check(mcs: int, mbps: float) -> None:
        at = np.array([(20.0 * (i % 5), 20.0 * (i // 5)) for i in range(20)])
        distance_m = np.maximum(np.linalg.norm(at[:, None] - at[None], axis=-1), 1.0)
        b = Bench(20.0 - 46.8 - 21.0 * np.log10(distance_m), mcs=mcs)
        b.to = {i: i + 1 if i % 5 < 4 else i - 1 for i in range(20)}
        assert b.saturate(20, 3200, 6.0) == pytest.approx(mbps, rel=0.06)

    assert wrong_rows([(3, 106.0), (7, 191.2)], check) == {}


def test_how_often_a_descriptor_meets_a_saturated_sender() -> None:
    """It waits for the frame on the air and draws v of 0 … 3 slots, the sender b of 0 … 15 and one slot more of AIFS.

    They meet where v = b + 1, and where b + 1 < v leaves a slot to v and the next draw is 0: 3 / 64 + 1 / 1024.
    """
    b = Bench(-50.0, mcs=3)
    b.again = {0}
    b.submit(0, 64)
    draws = np.random.default_rng(1)
    for k in range(4000):
        b.env.timeout(0.012 * k + 0.01 * draws.random()).callbacks.append(lambda _: b.announce(2))
    b.run(48.5)
    lost = [fates for _, _, fates in b.heard if fates[1] != edca.HEARD]
    assert {fates[1] for fates in lost} == {edca.COLLISION_DATA}
    assert len(lost) / len(b.heard) == pytest.approx(3 / 64 + 1 / 1024, abs=0.011)


# --- who spoils what -----------------------------------------------------------------------------------


def test_frames_of_one_instant_are_lost_to_each_other_unless_one_is_much_stronger() -> None:
    power = np.full((4, 4), -60.0)
    power[1, 3] = -40.0  # station 1 is close to 3
    b = Bench(power)
    b.run(0.5)
    b.announce(0)
    b.announce(1)
    b.run(1.0)
    fates = {sender: fates for _, sender, fates in b.heard}
    assert fates[0] == (edca.HALF_DUPLEX, edca.COLLISION_CONTEXT, edca.COLLISION_CONTEXT)
    assert fates[1] == (edca.HALF_DUPLEX, edca.COLLISION_CONTEXT, edca.HEARD)


def test_below_the_preamble_threshold_nothing_is_heard() -> None:
    power = np.full((3, 3), -60.0)
    power[0, 1], power[0, 2] = -81.9, -82.1
    b = Bench(power)
    b.announce(0)
    b.run(1.0)
    assert b.heard[0][2] == (edca.HEARD, edca.WEAK)


def test_group_frames_arrive_as_often_as_their_per_says() -> None:
    def check(length: int) -> None:
        curve = group_curve(24.0)
        left_db = curve.snr_db(0.5, 700)  # in the primary 20 MHz, so that half the frames of 700 B are lost
        power_dbm = NOISE_DBM - 10 * np.log10(4) + left_db
        b = Bench(power_dbm, group_rate_mbps=24.0, preamble_detection_dbm=-95.0)
        for k in range(6000):
            b.run(1e-3 * (k + 1))
            b.announce(0, length=length)
        b.run(7.0)
        fates = np.array([fates for _, _, fates in b.heard])
        assert fates.shape == (6000, 2)
        assert set(fates.ravel().tolist()) == {edca.HEARD, edca.WEAK}
        fade_db = stats.norm(0, 10 / np.log(10) * np.sqrt(2 / 1e4))  # what K = 40 dB leaves of it
        expected = integrate.quad(lambda g: (1 - curve.per(left_db + g, length)) * fade_db.pdf(g), -0.5, 0.5)[0]
        assert 0.1 < expected < 0.9
        assert (fates == edca.HEARD).mean() == pytest.approx(expected, abs=0.02)

    assert wrong_rows([304, 1458], check) == {}


FAR = np.full((3, 3), -76.4)

FAR[0, 2] = FAR[2, 0] = -82.7


def test_ends_that_do_not_hear_each_other_spoil_what_the_middle_hears() -> None:
    power = FAR.copy()
    power[2, 1] = -70.0
    b = Bench(power, mcs=3)
    b.announce(0)
    b.announce(2, 100e-6)
    b.run(1.0)
    assert [fates for _, _, fates in b.heard] == [(edca.HIDDEN, edca.WEAK), (edca.HALF_DUPLEX, edca.HIDDEN)]
    near = Bench(-76.4, mcs=3)
    near.announce(0)
    near.announce(2, 100e-6)
    near.run(1.0)
    assert {fates for _, _, fates in near.heard} == {(edca.HEARD, edca.HEARD)}


def test_hidden_senders_lose_and_rts_brings_most_of_it_back() -> None:
    def both(power: np.ndarray | float, **knobs: object) -> float:
        b = Bench(power, 3, mcs=3, **knobs)
        b.again = {0, 2}
        b.submit(0, 3200, to=1)
        b.submit(2, 3200, to=1)
        b.run(6.0)
        held = sum(b.medium.in_service(i).arrived_frames for i in (0, 2))
        return float(b.arrived.sum() + held) * 1344 * 8e-6 / 6.0

    hidden, cleared, seen = both(FAR), both(FAR, rts=True), both(-76.4)
    assert hidden < 0.92 * seen
    assert cleared > 1.1 * hidden
    assert cleared == pytest.approx(121.8, rel=0.05)  # ns-3 3.44


def test_after_its_own_frame_a_station_senses_by_energy_what_began_before() -> None:
    """It misses the preamble of a frame that begins with its first; -62 dBm is 20 dB above the weakest preamble."""

    def check(power_dbm: float, waits: bool) -> None:
        power = np.full((4, 4), -50.0)
        power[0, 2] = power_dbm
        b = Bench(power, mcs=3)
        b.run(0.5)
        b.submit(0, 64, to=1)
        b.announce(2)
        b.announce(2)
        b.run(1.0)
        end_s = 0.5 + exchange_s(64, 3)
        (first, _, _), (second, _, _) = b.heard
        assert first < 0.5 + 2 * GROUP_S
        assert (second > end_s) == waits

    assert wrong_rows([(-61.0, True), (-63.0, False)], check) == {}


def test_what_begins_later_is_sensed_by_its_preamble_again() -> None:
    power = np.full((4, 4), -63.0)
    b = Bench(power, mcs=3)
    b.announce(0)
    b.run(0.5)
    b.submit(1, 64, to=3)
    b.run(0.5 + GROUP_S)
    b.announce(0)
    b.run(1.0)
    assert b.heard[1][0] > 0.5 + exchange_s(64, 3)


def test_far_fleets_do_not_wait_for_each_other() -> None:
    power = np.full((4, 4), -50.0)
    power[:2, 2:] = power[2:, :2] = -95.0
    apart, together = Bench(power), Bench(-50.0, 4)
    for b in (apart, together):
        b.again = {0, 2}
        b.submit(0, 3200, to=1)
        b.submit(2, 3200, to=3)
        b.run(3.0)
    done = [sum(b.medium.in_service(i).arrived_frames for i in (0, 2)) + b.arrived.sum() for b in (apart, together)]
    assert done[0] > 1.9 * done[1]


def test_faint_frames_are_heard_as_energy_where_they_are_many() -> None:
    """Each is 10 dB below the weakest preamble: five leave the medium idle, twenty make it busy until they are over."""

    def first_frame_s(strangers: int) -> float:
        """When a frame of station 0 is over that comes while others send that cannot hear one another."""
        power = np.full((strangers + 1, strangers + 1), -200.0)
        power[1:, 0] = AirSettings().preamble_detection_dbm - 10.0
        b = Bench(power)
        for i in range(1, strangers + 1):
            b.announce(i)
        b.announce(0, 1e-4)
        b.run(0.1)
        return next(t for t, sender, _ in b.heard if sender == 0)

    alone_s = first_frame_s(1)
    assert first_frame_s(5) == alone_s
    assert first_frame_s(20) > alone_s + 0.9 * (GROUP_S - 1e-4)


def test_a_faint_frame_is_lost_to_a_weak_signal_whatever_else_is_on_the_air() -> None:
    power = np.full((3, 3), -60.0)
    power[2, 1] = AirSettings().preamble_detection_dbm - FAINT_DB - 0.5
    power[0, 2] = power[2, 0] = -200.0
    b = Bench(power)
    b.announce(0)
    b.announce(2, 1e-4)
    b.run(0.1)
    fates = {sender: fates for _, sender, fates in b.heard}
    assert (fates[0][0], fates[2][1]) == (edca.HEARD, edca.FAINT)


def test_control_frames_take_as_long_as_their_bytes_at_24_mbps() -> None:
    last = {"ACK": 14, "CONTROL": 20, "REQUEST_NS": 24, "BLOCK_ACK": 32, "BLOCK_ACK_LONG": 56}
    wanted = {name: round(legacy_ppdu_s(length, 24.0) * 1e9) for name, length in last.items()}
    assert {name: getattr(edca, name) for name in last} == wanted


DRONES, SECONDS = 40, 1.2


class CopiesAll:
    """The compiled stations; before each plan every station counts as different."""

    def __init__(self, medium: Any) -> None:
        self._medium = medium

    def __getattr__(self, name: str) -> Any:
        return getattr(edca, name)

    def ahead(self, *args: Any) -> Any:
        n = (len(self._medium._differing) - 1) // 2
        self._medium._differing[:] = [n, *range(n), *[edca.SENDS] * n]
        return edca.ahead(*args)


def flown(*, copies_all: bool, seed: int) -> list[tuple[Any, ...]]:
    """All that small groups over 1.5 km hear of each other, with payloads, replaced ones, and drones that leave."""
    rng, env, log = np.random.default_rng(seed), simpy.Environment(), []
    at_m = rng.uniform(0.0, 1500.0, (DRONES // 4, 1, 2)) + rng.uniform(0.0, 120.0, (DRONES // 4, 4, 2))
    place_m = np.concatenate([at_m.reshape(-1, 2), np.full((DRONES, 1), 60.0)], axis=1)
    place_m[:4, 0] += 1e5 * np.arange(1, 5)  # four that nobody hears
    drift_m = np.linspace(0.0, 200.0, 40)[:, None, None] * rng.uniform(-1.0, 1.0, (1, DRONES, 3))
    air = Air(env, AirSettings(), place_m + drift_m, seed=seed, frame_s=0.1)
    if copies_all:
        air.medium._e = CopiesAll(air.medium)

    def fly() -> Iterator[simpy.Event]:
        for _ in range(round(SECONDS / 0.1) - 1):
            air.advance()
            for i in range(DRONES):
                air.broadcast(i, 1400, lambda heard, i=i: log.append((env.now, i, tuple(heard))))
            for i in rng.choice(DRONES, 16, replace=False).tolist():
                peer = 4 * (i // 4) + (i + 1) % 4
                air.send(
                    i,
                    peer,
                    int(rng.integers(200, 90_000)),
                    kind="features",
                    reliable=bool(i % 2),
                    deadline_s=0.09,
                    on_done=lambda row: log.append((env.now, *row)),
                )
            for part_s in (0.013, 0.021, 0.066):
                yield env.timeout(part_s)
                who = int(rng.integers(DRONES if part_s > 0.02 else 4))
                air.silence(who)
                air.wake(who)

    env.process(fly())
    env.run(until=SECONDS)
    return [*log, tuple(air.airtime_s), str(air.counters), *map(str, air.finish())]


def test_copying_what_differs_is_copying_all() -> None:
    def check(seed: int) -> None:
        some, everything = flown(copies_all=False, seed=seed), flown(copies_all=True, seed=seed)
        assert len(some) > 400
        assert list(map(repr, some)) == list(map(repr, everything))

    assert wrong_rows([1, 2, 3], check) == {}
