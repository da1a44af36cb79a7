"""The Gilbert–Elliott chain: shares, lengths, keys, and what it does to frames in the air."""

from __future__ import annotations

from dataclasses import replace
from itertools import groupby

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


def test_both_directions_of_a_pair_are_alike_and_pairs_are_not() -> None:
    bad = states(FLOWN, 5000)
    assert (bad == bad.transpose(0, 2, 1)).all()
    assert abs(np.corrcoef(bad[:, 0, 1], bad[:, 0, 2])[0, 1]) < 0.05


def test_one_more_drone_changes_no_pair() -> None:
    assert (states(FLOWN, 3000, 3) == states(FLOWN, 3000, 6)[:, :3, :3]).all()
    assert (states(FLOWN, 3000, seed=2) != states(FLOWN, 3000)).any()


def test_a_step_may_last_many_frames_or_less_than_one() -> None:
    slow = states(replace(FLOWN, step_s=1.0), 1000)
    assert (slow.reshape(100, 10, 3, 3) == slow[::10, None]).all()
    fast = states(replace(FLOWN, step_s=0.05), 1000)
    every = states(FLOWN, 1999, frame_s=0.1)  # the same chain, seen at every step
    assert (fast[:990] == every[0:1980:2]).all()


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
    flight = Hover(
        AirSettings(bursts=BurstSettings(good_to_bad=0.1, bad_to_good=0.2, step_s=0.1), shadowing_sigma_db=0.0),
        spread=0,
    )

    def tick(frame: int) -> None:
        flight.publish(0)
        flight.send(0, 1, 5000, kind=f"{frame}")

    flight.fly(200.0, tick)
    bad = states(BurstSettings(good_to_bad=0.1, bad_to_good=0.2, step_s=0.1), 2000, 2)[:, 0, 1]
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
    assert (
        2.0 < more < 3.2
    )  # each frame goes twice, and each round of retries has a preamble and a block ack of its own
