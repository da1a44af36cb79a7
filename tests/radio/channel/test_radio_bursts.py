"""The Gilbert–Elliott chain: shares, lengths, keys, and what it does to frames in the air."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby, pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from radio_flights import Hover

from sortie.radio import Status
from sortie.radio.channel.bursts import PairStates, bad_share, mean_loss, walk
from sortie.radio.settings import AirSettings, BurstSettings

FLOWN = BurstSettings(good_to_bad=0.05, bad_to_good=0.28, step_s=0.1)


def states(config: BurstSettings, frames: int, n: int = 3, *, seed: int = 1, frame_s: float = 0.1) -> np.ndarray:
    """[frames, n, n]: which pairs are bad."""
    pairs = PairStates(config, n, seed, 0, frame_s)
    out = []
    for _ in range(frames):
        pairs.advance()
        out.append(pairs.bad)
    return np.array(out)


def test_share_and_length_of_bursts() -> None:
    bad = states(FLOWN, 60_000)
    series = [bad[:, i, j] for i, j in ((0, 1), (0, 2), (1, 2))]
    lengths = np.array([len(list(run)) for s in series for is_bad, run in groupby(s) if is_bad])
    assert np.mean(series) == pytest.approx(bad_share(0.05, 0.28), abs=0.01)
    assert lengths.mean() == pytest.approx(1 / 0.28, rel=0.03)
    assert np.mean(lengths == 1) == pytest.approx(0.28, abs=0.02)  # geometric
    assert np.mean(lengths > 5) == pytest.approx(0.72**5, abs=0.02)


def test_pairs_are_alike_both_ways_and_unlike_each_other_and_one_more_drone_changes_none() -> None:
    bad = states(FLOWN, 5000)
    assert (bad == bad.transpose(0, 2, 1)).all()
    assert abs(np.corrcoef(bad[:, 0, 1], bad[:, 0, 2])[0, 1]) < 0.05
    assert (bad == states(FLOWN, 5000, 6)[:, :3, :3]).all()
    assert (bad != states(FLOWN, 5000, seed=2)).any()


def test_a_step_may_last_many_frames_or_less_than_one() -> None:
    slow = states(replace(FLOWN, step_s=1.0), 1000)
    assert (slow.reshape(100, 10, 3, 3) == slow[::10, None]).all()
    fast = states(replace(FLOWN, step_s=0.05), 1000)
    every = states(FLOWN, 1999, frame_s=0.1)  # the same chain, seen at every step
    assert (fast[:990] == every[0:1980:2]).all()


def test_a_step_as_long_as_a_frame_is_one_in_every_frame() -> None:
    """However the multiples of a tenth are rounded: pairs that change at each step change a hundred times."""
    pairs = PairStates(BurstSettings(good_to_bad=1.0, bad_to_good=1.0, step_s=0.1), 3, 1, 0, 0.1)
    states = [bool(pairs.advance()[0, 1]) for _ in range(101)]
    assert [a != b for a, b in pairwise(states)] == [True] * 100


def test_pairs_change_once_a_step_and_lose_by_their_state() -> None:
    """Steps of three frames, of which the last begins by rounding a little late."""
    bursts = BurstSettings(good_to_bad=0.3, bad_to_good=0.3, step_s=0.3, loss_good=0.25, loss_bad=0.75)
    pairs = PairStates(bursts, 12, 5, 0, 0.1)
    rows = [pairs.advance() for _ in range(30)]
    for frame in range(1, 30):
        assert np.array_equal(rows[frame], rows[frame - 1]) is (frame % 3 != 0)
    assert set(np.unique(np.array(rows))) == {0.25, 0.75}
    first = [PairStates(bursts, 40, seed, 0, 0.1).advance() for seed in range(3)]
    upper = np.triu_indices(40, 1)
    bad = np.mean([(row[upper] == 0.75).mean() for row in first])
    assert bad == pytest.approx(bad_share(0.3, 0.3), abs=0.04)


@given(p=st.floats(0.0, 1.0), r=st.floats(0.01, 1.0), u=st.lists(st.floats(0.0, 0.999), min_size=1, max_size=30))
def test_a_walk_obeys_its_draws(p: float, r: float, u: list[float]) -> None:
    bad = False
    for step, state in enumerate(walk(np.array(False), np.array(u), p, r)):
        bad = (u[step] >= r) if bad else (u[step] < p)
        assert state == bad


def test_the_mean_of_what_is_lost() -> None:
    assert mean_loss(BurstSettings(good_to_bad=0.05, bad_to_good=0.2, loss_good=0.1, loss_bad=0.6)) == pytest.approx(
        0.2
    )


def test_a_bad_pair_hears_no_descriptor_and_gets_no_sample() -> None:
    often = BurstSettings(good_to_bad=0.1, bad_to_good=0.2, step_s=0.1)
    flight = Hover(AirSettings(bursts=often, shadowing_sigma_db=0.0), spread=0)

    def tick(frame: int) -> None:
        flight.publish(0)
        flight.send(0, 1, 5000, kind=f"{frame}")

    flight.fly(200.0, tick)
    bad = states(often, 2000, 2)[:, 0, 1]
    heard = np.array([bool(ids) for _, _, ids in flight.heard])
    came = np.array([r.status is Status.DELIVERED for r in flight.rows])
    assert (heard == ~bad[: len(heard)]).all()
    assert (came == ~bad[: len(came)]).all()
    missed = {(r.status, r.reason) for r in flight.rows if r.status is not Status.DELIVERED}
    # tried until then, or behind the block-ack requests of the one before
    assert missed == {(Status.EXPIRED, "deadline_in_service"), (Status.EXPIRED, "deadline_queued")}


def test_retries_pay_for_a_loss_at_each_try() -> None:
    def airtime_s(loss: float) -> float:
        config = AirSettings(bursts=BurstSettings(loss_good=loss), shadowing_sigma_db=0.0)
        flight = Hover(config).fly(0.1)
        flight.send(0, 1, 100_000)
        flight.env.run(until=1.0)
        return flight.rows[0].airtime_s

    more = airtime_s(0.5) / airtime_s(0.0)
    assert 2.0 < more < 3.2  # each frame goes twice, with a preamble and a block ack for each round of retries


def faint(loss: float, **more: Any) -> AirSettings:
    """Links at the edge of what can be received, in bursts of so much loss."""
    return AirSettings(
        shadowing_sigma_db=0.0,
        tx_power_dbm=-11.5,
        rician_k_db=30.0,
        preamble_detection_dbm=-120.0,
        bursts=BurstSettings(loss_good=loss),
        **more,
    )


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
