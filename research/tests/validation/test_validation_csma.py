"""The analytic medium against CSMA/CA run sender by sender."""

from __future__ import annotations

import numpy as np
import pytest

from research.validation import csma
from sortie.radio.mac.airtime import ACK_S, BLOCK_ACK_S, frames_exchanges
from sortie.radio.mac.contention import CW_MIN, DIFS_S, SIFS_S, SLOT_S, contention

CASES = [(1, 86.0, ACK_S), (64, 360.3, BLOCK_ACK_S)]


def _both(frames: int, rate_mbps: float, ack_s: float, n: int, **rules: object) -> tuple[float, csma.CsmaRun]:
    one = frames_exchanges(frames, 1538, 1538, rate_mbps, frames, ack_s)
    turn = csma.Turn(one.ppdu_s, ack_s, frames, 12_000.0)
    ran = csma.run([turn] * n, 8_000, np.random.default_rng(n), **rules)
    return frames * 12e-3 / one.channel_s(contention(n)), ran


@pytest.mark.parametrize("n", [5, 10, 20, 50])
@pytest.mark.parametrize(("frames", "rate_mbps", "ack_s"), CASES)
def test_the_analytic_throughput_is_within_5_percent_of_the_run(
    frames: int, rate_mbps: float, ack_s: float, n: int
) -> None:
    analytic, ran = _both(frames, rate_mbps, ack_s, n)
    assert ran.throughput_mbps == pytest.approx(analytic, rel=0.05)
    assert ran.collision_probability == pytest.approx(contention(n).collision_probability, abs=0.03)


@pytest.mark.parametrize("n", [5, 20])
def test_with_bianchis_own_counting_it_is_within_2_percent(n: int) -> None:
    analytic, ran = _both(16, 86.0, BLOCK_ACK_S, n, goes_on_at_once=False)
    assert ran.throughput_mbps == pytest.approx(analytic, rel=0.02)
    assert ran.collision_probability == pytest.approx(contention(n).collision_probability, abs=0.012)


def test_a_lone_sender_takes_its_mean_backoff() -> None:
    turn = csma.Turn(1e-3, ACK_S, 1, 8000.0)
    ran = csma.run([turn], 20_000, np.random.default_rng(0))
    cycle_s = 1e-3 + SIFS_S + ACK_S + DIFS_S + CW_MIN / 2 * SLOT_S
    assert ran.collided.sum() == 0
    assert ran.throughput_mbps == pytest.approx(8e-3 / cycle_s, rel=2e-3)


def test_lost_frames_of_an_ampdu_cost_their_share() -> None:
    turn = csma.Turn(2e-3, BLOCK_ACK_S, 32, 12_000.0, per=0.25)
    clean = csma.Turn(2e-3, BLOCK_ACK_S, 32, 12_000.0)
    lossy, full = (csma.run([t] * 4, 8000, np.random.default_rng(1)) for t in (turn, clean))
    assert lossy.throughput_mbps / full.throughput_mbps == pytest.approx(0.75, rel=0.02)
    dead = csma.run([csma.Turn(2e-3, BLOCK_ACK_S, 1, 1.0, per=1.0)] * 2, 2000, np.random.default_rng(2))
    assert dead.throughput_mbps == 0.0
    assert dead.collision_probability < 2 / (CW_MIN + 1) / 4  # no ack doubles the window as a collision does


def test_senders_take_turns_whatever_their_rate() -> None:
    """A slow sender takes as many turns, so more of the time."""
    slow, fast = csma.Turn(4e-3, BLOCK_ACK_S, 16, 12_000.0), csma.Turn(0.5e-3, BLOCK_ACK_S, 16, 12_000.0)
    ran = csma.run([slow, fast], 20_000, np.random.default_rng(3))
    assert ran.delivered_bits[0] == pytest.approx(ran.delivered_bits[1], rel=0.05)
    assert ran.air_s[0] > 7 * ran.air_s[1]


def test_nobody_is_refused() -> None:
    with pytest.raises(ValueError, match="turns is empty, must name at least one sender"):
        csma.run([], 10, np.random.default_rng(0))
