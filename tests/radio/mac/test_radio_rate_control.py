"""Rate control from acks: finds the ideal rate in a channel that stands still, lags in one that moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import simpy
from radio_examples import CROSS_M, still

from sortie.radio import Air, Transmission
from sortie.radio.mac.rate_control import INTERVAL_S, KEEP, Minstrel
from sortie.radio.rates import STANDARDS, rate_table
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


@pytest.mark.parametrize("snr_db", [3.0, 9.0, 14.0, 20.0, 27.0, 40.0])
def test_it_converges_to_the_ideal_rate_in_a_still_channel(snr_db: float) -> None:
    snr = np.full(300, snr_db)
    used = _fly(snr, 122)
    ideal = TABLE.rate_mbps[TABLE.index(snr_db)] * (1 - TABLE.mean_per[TABLE.index(snr_db)])
    settled = _goodput(used, snr)[20:]
    assert settled.mean() > 0.95 * ideal
    assert settled.max() <= ideal * (1 + 1e-9)
    assert used[0] == 0


def test_fewer_frames_converge_more_slowly() -> None:
    snr = np.full(400, 27.0)
    top = _fly(snr, 1220).max()
    first = [int((_fly(snr, frames) == top).argmax()) for frames in (1220, 122, 10)]
    assert first == sorted(first)
    assert first[0] <= 2
    assert first[2] > 5


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


def test_links_do_not_know_of_each_other() -> None:
    control = Minstrel((10.0, 100.0))
    for k in range(20):
        control.mcs(0, 1, k * INTERVAL_S)
        control.mcs(1, 0, k * INTERVAL_S)
        control.sent(0, 1, k * INTERVAL_S, ((0, 0), (50, 50)))
        control.sent(1, 0, k * INTERVAL_S, ((50, 50), (50, 0)))
    assert (control.mcs(0, 1, 2.0), control.mcs(1, 0, 2.0)) == (1, 0)


def _delivered(control: str, loss_db: float) -> list[Transmission]:
    env = simpy.Environment()
    config = AirSettings(rate_control=control, shadowing_sigma_db=0.0)
    air = Air(env, config, still(CROSS_M[:2]), seed=1, frame_s=0.1)
    rows: list[Transmission] = []

    def frames() -> simpy.events.ProcessGenerator:
        for k in range(100):
            air.advance(np.full((2, 2), loss_db if 50 <= k < 75 else 0.0))
            air.send(0, 1, 163_840, kind="f", reliable=False, deadline_s=0.09, on_done=rows.append)
            yield env.timeout(0.1)

    env.process(frames())
    env.run(until=10.0)
    return rows


def test_in_the_air_it_starts_low_finds_the_ideal_rate_and_lags() -> None:
    ideal, learned = _delivered("ideal", 14.0), _delivered("minstrel", 14.0)
    assert learned[0].mcs == 0
    assert {r.mcs for r in ideal[:50]} == {ideal[0].mcs}
    assert max(abs(r.mcs - ideal[0].mcs) for r in learned[10:50]) <= 1
    took_s = {name: [r.t_done_s - r.t_sent_s for r in rows[50:75]] for name, rows in (("i", ideal), ("m", learned))}
    usual_s = max(took_s["i"][1:])  # not the frame in which it did not know yet
    late = [s > 2.0 * usual_s for s in took_s["m"]]
    assert late[0]
    assert sum(late) < 25
    assert not any(late[20:])


def _crowded(control: str, senders: int) -> list[Transmission]:
    """Each drone of a ring keeps a sample waiting for its neighbour, at an SNR that the top rate can bear."""
    env = simpy.Environment()
    config = AirSettings(rate_control=control, shadowing_sigma_db=0.0)
    around = 2 * np.pi * np.arange(senders) / senders
    places = np.column_stack([10 * np.cos(around), 10 * np.sin(around), np.full(senders, 60.0)])
    air = Air(env, config, still(places), seed=1, frame_s=0.1)
    rows: list[Transmission] = []

    def frames() -> simpy.events.ProcessGenerator:
        for _ in range(40):
            air.advance()
            for k in range(senders):
                air.send(k, (k + 1) % senders, 163_840, kind="f", reliable=False, deadline_s=0.09, on_done=rows.append)
            yield env.timeout(0.1)

    env.process(frames())
    env.run(until=4.0)
    return rows


def test_collisions_cost_some_rate_and_nothing_else() -> None:
    """What collided counts as lost, at whatever rate: the control sinks below the ideal, but not to the bottom.

    Two drones collide often enough for it; with twelve the mean is no further from the ideal than chance moves it.
    """
    late = {n: [r for r in _crowded("minstrel", n) if r.t_sent_s > 3.0] for n in (2, 12)}
    mean = {n: np.mean([r.mcs for r in rows]) for n, rows in late.items()}
    assert all(r.status == "delivered" for rows in late.values() for r in rows)
    assert {r.mcs for r in _crowded("ideal", 12)} == {11}
    assert all(8.0 < one < 10.7 for one in mean.values())
