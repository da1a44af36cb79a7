"""Bytes on the wire, durations, Bianchi's contention against ns-3's values, and the control that chooses rates."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from radio_flights import Hover
from wrong_rows import wrong_rows

from sortie.radio import Transmission
from sortie.radio.mac import airtime
from sortie.radio.mac.airtime import frames_exchanges, legacy_ppdu_s
from sortie.radio.mac.contention import DIFS_S, SIFS_S, SLOT_S, contention, saturation_mbps
from sortie.radio.mac.rate_control import INTERVAL_S, KEEP, Minstrel
from sortie.radio.rates import STANDARDS, Standard, rate_table
from sortie.radio.sample import Service
from sortie.radio.settings import AirSettings


def test_a_descriptor_on_the_wire() -> None:
    assert airtime.datagram_bytes(180, fragmented=False, unicast=False) == 268
    assert airtime.frame_bytes(180, unicast=False) == 304
    assert airtime.group_frame_s(180, 6.0) == pytest.approx(432e-6, abs=1e-12)


def test_wire_bytes_of_a_sample_are_its_fragments_headers() -> None:
    """A piece that is of use alone has the headers of a sample of its own."""
    counts = {655_360: 488, 163_840: 122, 13_120: 10, 1000: 1, 1344: 1, 1345: 2}
    assert {size: airtime.fragments(size, 1344) for size in counts} == counts
    whole, fragment = 20 + 12 + 16 + 28 + 28 + 38, 20 + 12 + 16 + 36 + 28 + 38
    assert airtime.sample_wire(1000, 1344) == airtime.sample_wire(1000, 1344, alone=True) == (1, 1000 + whole)
    assert airtime.sample_wire(2000, 1344) == (2, 2000 + 2 * fragment)
    assert airtime.sample_wire(2000, 1344, alone=True) == (2, 2000 + 2 * whole)


def test_a_repair_names_each_fragment_that_it_may_ask_for() -> None:
    """A bit of a word of 32 for each, up to 256."""
    one = 2 * (20 + 16 + 28 + 38) + 28 + 32
    more = {1: 0, 32: 0, 33: 4, 64: 4, 65: 8, 256: 28, 257: 28, 4000: 28}
    assert {lost: airtime.repair_wire_bytes(lost) - one for lost in more} == {n: more[n] + 4 for n in more}


def test_control_frames_last_as_the_standard_says() -> None:
    assert pytest.approx(28e-6) == airtime.ACK_S
    assert pytest.approx(32e-6) == airtime.BLOCK_ACK_S


N, AX = STANDARDS["n"], STANDARDS["ax"]


def test_an_ampdu_ends_at_its_number_its_length_or_at_5484_us() -> None:
    rows = [
        # by number: what is asked for, and what the standard's block ack can answer
        (1494, 600.5, 64, AX, 64),
        (1494, 600.5, 300, AX, 256),
        (1494, 390.0, 256, STANDARDS["ac"], 64),
        # by length, delimiters included: 65,535 B hold 43 frames of 1524 B, and only 42 with 4 B more each
        (1494, 135.0, 256, N, 43),
        (1524, 135.0, 256, N, 42),
        (1520, 135.0, 256, N, 43),
        # by time: 5,484 µs less the preamble's 44 µs carry 5,848 B at 8.6 Mb/s
        (1458, 8.6, 64, AX, 4),
        (1460, 8.6, 64, AX, 3),
        (1494, 36.0, 64, AX, 16),
        # one frame goes, however long it takes
        (65_000, 8.6, 64, AX, 1),
    ]

    def check(frame: int, rate_mbps: float, most: int, standard: Standard, count: int) -> None:
        assert airtime.ampdu_frames(frame, rate_mbps, most, standard) == count

    assert wrong_rows(rows, check) == {}


def test_a_sample_takes_its_ampdus_and_what_lies_between() -> None:
    """A preamble of 44 µs, symbols of 13.6 µs for 22 bits and the bytes of an A-MPDU; then SIFS, ack, DIFS, a slot."""

    rows = [
        # fragments have 150 B around them, and 4 B of delimiter in an A-MPDU
        (130 * 1344, 1344, False, 600.5, 64, [64 * 1498, 64 * 1498, 2 * 1498]),
        (128 * 1344, 1344, False, 600.5, 64, [64 * 1498, 64 * 1498]),
        # the last, short one rides behind the others, or alone in an A-MPDU of its own
        (63 * 1344 + 100, 1344, False, 600.5, 64, [63 * 1498 + 254]),
        (64 * 1344 + 100, 1344, False, 600.5, 64, [64 * 1498, 254]),
        *[(3 * 1344 + rest, 1344, False, 8.6, 64, [3 * 1498, rest + 154]) for rest in range(1, 60, 3)],
        *[(1344 + rest, 1344, False, 8.6, 64, [1498 + rest + 154]) for rest in range(1, 60, 3)],
        # whole samples and pieces that are of use alone have 142 B around them
        *[(size, 1344, False, 8.6, 64, [size + 146]) for size in range(100, 160, 3)],
        *[(5 * 500 + rest, 500, True, 8.6, 4, [4 * 646, 646 + rest + 146]) for rest in range(1, 60, 3)],
        # frames that travel one by one have no delimiter
        *[(2 * 500 + rest, 500, False, 8.6, 1, [650, 650, rest + 150]) for rest in range(1, 60, 3)],
    ]

    def check(
        payload_bytes: int, fragment_bytes: int, alone: bool, rate_mbps: float, most: int, ampdus: list[int]
    ) -> None:
        whole = airtime.sample_exchanges(payload_bytes, fragment_bytes, rate_mbps, most, alone=alone)
        symbols = sum(math.ceil((22 + 8 * size) / (rate_mbps * 13.6)) for size in ampdus)
        assert whole.count == len(ampdus)
        assert whole.ppdu_s == pytest.approx(len(ampdus) * 44e-6 + symbols * 13.6e-6, rel=1e-9)
        between_s = SIFS_S + airtime.BLOCK_ACK_S + DIFS_S + SLOT_S
        assert whole.clean_s == pytest.approx(whole.ppdu_s + len(ampdus) * between_s, rel=1e-9)

    assert wrong_rows(rows, check) == {}


def test_tries_and_residual_loss() -> None:
    assert airtime.tries(0.5, 2) == pytest.approx(1 + 0.5 + 0.25)
    assert airtime.tries(1.0, 7) == 8
    assert airtime.tries(0.0, 7) == 1
    assert airtime.residual_loss(0.5, 2) == 0.125


def test_collision_probability_is_bianchis() -> None:
    found = [contention(n).collision_probability for n in (5, 10, 20, 50)]
    assert found == pytest.approx([0.2715, 0.3844, 0.4809, 0.5953], abs=5e-5)


def test_a_lone_sender_waits_half_its_window_and_never_collides() -> None:
    alone = contention(1)
    assert alone.idle_s == pytest.approx(7.5 * SLOT_S)
    assert alone.collisions == pytest.approx(0, abs=1e-12)
    with pytest.raises(ValueError, match="senders is 0, must be at least 1"):
        contention(0)


def test_he_throughput_is_ns3s() -> None:
    """Of 5 to 50 senders of single frames, and of 1 to 100 senders of A-MPDUs."""
    single = {86.0: (34.967, 33.074, 30.928, 27.698), 360.3: (55.839, 53.936, 51.286, 46.857)}
    for rate_mbps, mbps in single.items():
        one = frames_exchanges(1, 1538, 1538, rate_mbps, 1, airtime.ACK_S)
        assert [12e-3 / one.channel_s(contention(n)) for n in (5, 10, 20, 50)] == pytest.approx(mbps, rel=1e-4)
    several = {(86.0, 16): (76.8, 66.7, 55.9, 48.8, 42.8), (360.3, 64): (319, 277, 233, 203, 178)}
    for (rate_mbps, frames), mbps in several.items():
        one = frames_exchanges(frames, 1538, 1538, rate_mbps, frames)
        ours = [frames * 12e-3 / one.channel_s(contention(n)) for n in (1, 5, 20, 50, 100)]
        assert ours == pytest.approx(mbps, rel=2e-3)


def test_11a_throughput_is_ns3s_once_the_winner_may_go_on() -> None:
    """Its 11a reference lets the winner draw a zero backoff again (probability 1/16), its HE one does not."""
    ppdu_s = 20e-6 + 8 * 1538 / 54e6  # the reference does not round up to whole symbols
    ours = [saturation_mbps(n, 12e3, ppdu_s, airtime.ACK_S, goes_on_at_once=True) for n in (5, 10, 20, 50)]
    assert ours == pytest.approx([29.832, 28.152, 26.293, 23.562], rel=1e-3)
    for n, reference in ((5, 29.832), (50, 23.562)):  # what the medium uses is lower by 2 to 4 %
        plain = saturation_mbps(n, 12e3, legacy_ppdu_s(1538, 54.0), airtime.ACK_S)
        assert -0.04 < plain / reference - 1 < -0.02


def test_rates_follow_from_subcarriers_modulation_code_and_symbol() -> None:
    """Data subcarriers × bits × code rate / symbol time (IEEE 802.11-2020 §19.5, §21.5; 802.11ax §27.5)."""

    def check(standard: Standard) -> None:
        subcarriers = {"n": {20: 52, 40: 108}, "ac": {20: 52, 40: 108, 80: 234}, "ax": {20: 234, 40: 468, 80: 980}}
        bits = (0.5, 1, 1.5, 2, 3, 4, 4.5, 5, 6, 20 / 3, 7.5, 25 / 3)
        assert set(standard.rates_mbps) == set(subcarriers[standard.name])
        for width, rates in standard.rates_mbps.items():
            exact = [subcarriers[standard.name][width] * b / standard.symbol_s * 1e-6 for b in bits[: len(rates)]]
            assert rates == pytest.approx(exact, abs=0.051)

    assert wrong_rows(STANDARDS.values(), check) == {}


def test_generations_differ_in_preamble_and_symbol() -> None:
    n, ac, ax = (STANDARDS[name] for name in ("n", "ac", "ax"))
    assert airtime.ppdu_s(1538, 65.0, n) == pytest.approx(36e-6 + 48 * 4e-6)
    assert airtime.ppdu_s(1538, 65.0, ac) == pytest.approx(40e-6 + 48 * 4e-6)
    assert airtime.ppdu_s(1538, 86.0, ax) == pytest.approx(44e-6 + 11 * 13.6e-6)


RATES_MBPS = STANDARDS["ax"].rates_mbps[80]
TABLE = rate_table(80, 12.0, 1494)


def _pers(snr_db: float) -> list[float]:
    return [row[TABLE.index(snr_db)] for row in TABLE.all_per]


def _counts(
    mcs: int, frames: int, turn: int, per_by_mcs: Sequence[float], rng: np.random.Generator
) -> list[tuple[int, int]]:
    """Nine tenths at one MCS, the rest at the others by turns; how many were sent and acknowledged at each."""
    sent, probes = [0] * len(per_by_mcs), frames / 10
    sent[mcs] = round(frames - probes)
    for k in range(int(turn * probes), int((turn + 1) * probes)):
        sent[5 * k % len(sent)] += 1
    return [(n, n - int(rng.binomial(n, per))) for n, per in zip(sent, per_by_mcs, strict=True)]


def _fly(snr_db: np.ndarray, frames: int, seed: int = 1) -> np.ndarray:
    """The MCS in use in each interval of a link whose mean SNR is given for each."""
    control, used, rng = Minstrel(RATES_MBPS), [], np.random.default_rng(seed)
    for k, snr in enumerate(snr_db):
        now = k * INTERVAL_S
        used.append(control.mcs(0, 1, now))
        control.sent(0, 1, now, _counts(used[-1], frames, k, _pers(snr), rng))
    return np.array(used)


def _goodput(mcs: np.ndarray, snr_db: np.ndarray) -> np.ndarray:
    return np.array([RATES_MBPS[m] * (1 - _pers(s)[m]) for m, s in zip(mcs, snr_db, strict=True)])


def test_it_converges_to_the_ideal_rate_in_a_still_channel() -> None:
    def check(snr_db: float) -> None:
        snr = np.full(300, snr_db)
        used = _fly(snr, 122)
        ideal = TABLE.rate_mbps[TABLE.index(snr_db)] * (1 - TABLE.mean_per[TABLE.index(snr_db)])
        settled = _goodput(used, snr)[20:]
        assert settled.mean() > 0.95 * ideal
        assert settled.max() <= ideal * (1 + 1e-9)
        assert used[0] == 0

    assert wrong_rows([3.0, 9.0, 14.0, 20.0, 27.0, 40.0], check) == {}


def test_a_rate_that_fails_fades_by_its_weight() -> None:
    control = Minstrel((10.0, 100.0))
    for k in range(40):
        control.mcs(0, 1, k * INTERVAL_S)
        control.sent(0, 1, k * INTERVAL_S, ((100, 100), (900, 900)))
    windows = 0
    while control.mcs(0, 1, (40 + windows) * INTERVAL_S) == 1:
        control.sent(0, 1, (40 + windows) * INTERVAL_S, ((100, 100), (900, 0)))
        windows += 1
    # 100 · KEEP^n falls below 0.1 · 100 or below 10 · 0.9
    assert windows == int(np.ceil(np.log(0.1) / np.log(KEEP)))


def weighed(*exchanges: list[tuple[int, int]]) -> int:
    """The rate after intervals in which so many frames were sent and acknowledged at each rate."""
    minstrel, now_s = Minstrel((10.0, 20.0, 40.0)), 0.0
    assert minstrel.mcs(0, 1, now_s) == 0
    for counts in exchanges:
        minstrel.sent(0, 1, now_s, counts)
        now_s += INTERVAL_S
        best = minstrel.mcs(0, 1, now_s)
    return best


def test_rates_are_weighed_by_what_came_through() -> None:
    """A tenth is enough, less is not; nothing that came through counts too; above nine tenths the faster one wins."""
    none = (0, 0)
    assert weighed([none, none, (100, 10)]) == 2
    assert weighed([none, none, (100, 9)]) == 0
    assert weighed([(10, 10), none, (100, 26)]) == 2  # 10.4 Mb/s beat 9
    assert weighed([(10, 10), none, (100, 22)]) == 0
    assert weighed([none, (10, 10), (10, 10)], [none, none, (10, 0)]) == 2  # 30 beat 18
    assert weighed([none, (10, 10), (10, 10)], *[[none, none, (10, 0)]] * 3) == 1  # 16.9 do not
    assert weighed([(10, 10), (100, 95), none]) == 1


def test_an_interval_begins_when_the_last_was_weighed() -> None:
    minstrel = Minstrel((10.0, 20.0, 40.0))
    minstrel.sent(0, 1, 0.0, [(0, 0), (10, 10), (0, 0)])
    assert minstrel.mcs(0, 1, 5.0) == 1  # long after
    minstrel.sent(0, 1, 5.0, [(0, 0), (10, 0), (10, 10)])
    assert minstrel.mcs(0, 1, 5.0 + 0.5 * INTERVAL_S) == 1
    assert minstrel.mcs(0, 1, 5.0 + INTERVAL_S) == 2
    assert minstrel.mcs(1, 0, 5.0 + INTERVAL_S) == 0  # each direction by itself


def test_a_sender_without_a_link_tries_no_rate() -> None:
    service = Service(AirSettings(rate_control="minstrel"), -88.0)
    assert service.use(0, 1, 0.0, -50.0, False).unreachable == "no_link"
    assert service.use(0, 1, 0.0, 50.0, False).link.mcs == 0  # it knows of none yet


def test_in_the_air_it_starts_low_finds_the_ideal_rate_and_lags() -> None:
    """Behind 14 dB of loss between two and a half seconds of good links."""

    def delivered(control: str) -> list[Transmission]:
        flight = Hover(AirSettings(rate_control=control, shadowing_sigma_db=0.0))

        def tick(frame: int) -> None:
            flight.send(0, 1, 163_840)
            flight.extra = np.full((2, 2), 14.0 if 49 <= frame < 74 else 0.0)  # from the next frame on

        return flight.fly(10.0, tick).rows

    ideal, learned = delivered("ideal"), delivered("minstrel")
    assert learned[0].mcs == 0
    assert {r.mcs for r in ideal[:50]} == {ideal[0].mcs}
    assert max(abs(r.mcs - ideal[0].mcs) for r in learned[10:50]) <= 1
    usual_s = max(r.t_done_s - r.t_sent_s for r in ideal[51:75])  # not the frame in which it did not know yet
    late = [r.t_done_s - r.t_sent_s > 2.0 * usual_s for r in learned[50:75]]
    assert late[0]
    assert sum(late) < 25
    assert not any(late[20:])
