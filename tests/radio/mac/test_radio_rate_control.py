"""Rate control from acks: finds the ideal rate in a channel that stands still, lags in one that moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from radio_flights import Hover
from wrong_rows import wrong_rows

from sortie.radio import Transmission
from sortie.radio.mac.rate_control import INTERVAL_S, KEEP, Minstrel
from sortie.radio.rates import STANDARDS, rate_table
from sortie.radio.sample import Service
from sortie.radio.settings import AirSettings

RATES = STANDARDS["ax"].rates_mbps[80]
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
    control, used, rng = Minstrel(RATES), [], np.random.default_rng(seed)
    for k, snr in enumerate(snr_db):
        now = k * INTERVAL_S
        used.append(control.mcs(0, 1, now))
        control.sent(0, 1, now, _counts(used[-1], frames, k, _pers(snr), rng))
    return np.array(used)


def _goodput(mcs: np.ndarray, snr_db: np.ndarray) -> np.ndarray:
    return np.array([RATES[m] * (1 - _pers(s)[m]) for m, s in zip(mcs, snr_db, strict=True)])


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


def test_it_lags_in_a_channel_that_moves() -> None:
    """A drop by 12 dB, and back: what the ideal control, which knows the SNR, would have got meanwhile."""
    snr = np.concatenate([np.full(100, 30.0), np.full(100, 18.0), np.full(100, 30.0)])
    ideal = np.array([max(r * (1 - p) for r, p in zip(RATES, _pers(s), strict=True)) for s in snr])
    share = _goodput(_fly(snr, 122), snr) / ideal
    assert share[80:100].mean() > 0.93  # the ideal rate or the one below
    assert share[100] < 0.2  # the drop takes it by surprise
    assert share[100:105].mean() < 0.6
    assert share[180:200].mean() > 0.9
    assert share[200:203].mean() < 0.9  # and so does the recovery
    assert share[280:].mean() > 0.9  # at most one MCS off


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
