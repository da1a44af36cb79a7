"""CSMA/CA sender by sender, to judge the analytic medium by; nothing in a sortie uses it.

Every sender always has something to send. It waits for a DIFS of silence, counts its backoff down by a slot while the
channel stays idle, keeps the rest while it is busy, and sends at zero; senders at zero together collide, double their
windows and draw again; a success resets the window (IEEE 802.11-2020, §10.3.4). One event is one busy period. The
analytic model (`sortie.radio.mac.contention`) shares none of this code and none of its assumptions: here collisions have memory,
lengths differ, and a sender that has just sent may go on at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sortie.radio.mac.contention import CW_MAX, CW_MIN, DIFS_S, SIFS_S, SLOT_S

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Turn:
    """What one sender puts on the air whenever it wins."""

    ppdu_s: float
    """Time of its frame or A-MPDU."""
    ack_s: float
    """Time of the ack or block ack."""
    frames: int
    """Frames in it."""
    frame_bits: float
    """Payload of each."""
    per: float = 0.0
    """Probability that one of the frames is lost; all lost is no ack, as in a collision."""


@dataclass(frozen=True, slots=True)
class CsmaRun:
    """What came of it, over `elapsed_s`."""

    elapsed_s: float
    attempts: NDArray[np.int64]
    """[N] transmissions, collided ones included."""
    collided: NDArray[np.int64]
    """[N] of them that met another's."""
    delivered_bits: FloatArray
    """[N] payload."""
    air_s: FloatArray
    """[N] time spent sending."""

    @property
    def throughput_mbps(self) -> float:
        """Of all together."""
        return float(self.delivered_bits.sum()) / self.elapsed_s * 1e-6

    @property
    def collision_probability(self) -> float:
        """Of a transmission."""
        return float(self.collided.sum() / self.attempts.sum())


def run(
    turns: Sequence[Turn],
    busy_periods: int,
    rng: np.random.Generator,
    *,
    goes_on_at_once: bool = True,
    collision_tail_s: float = DIFS_S,
) -> CsmaRun:
    """Let saturated senders contend.

    Args:
        turns: one for each sender.
        busy_periods: how many successes and collisions to watch, after a tenth as many to warm up.
        rng: where backoffs come from.
        goes_on_at_once: whoever has sent counts its new backoff from the end of the DIFS, as the standard has it, so
            that a draw of 0 sends again unopposed. False: it waits one slot more, as Bianchi's chain has it.
        collision_tail_s: silence after a collision: DIFS, or EIFS for receivers that could not read a frame.

    Raises:
        ValueError: no sender.
    """
    n = len(turns)
    if n < 1:
        raise ValueError("turns is empty, must name at least one sender")
    ppdu_s = np.array([t.ppdu_s for t in turns])
    window = np.full(n, CW_MIN + 1)
    counter = rng.integers(0, window)
    attempts, collided = np.zeros(n, np.int64), np.zeros(n, np.int64)
    bits, air_s = np.zeros(n), np.zeros(n)
    elapsed_s = 0.0
    warm_up = busy_periods // 10
    for period in range(busy_periods + warm_up):
        if period == warm_up:
            elapsed_s = 0.0
            for total in (attempts, collided, bits, air_s):
                total[:] = 0
        idle = counter.min()
        counter -= idle
        sends = np.flatnonzero(counter == 0)
        longest_s = ppdu_s[sends].max()
        elapsed_s += idle * SLOT_S + longest_s
        attempts[sends] += 1
        air_s[sends] += ppdu_s[sends]
        answered = False
        if len(sends) == 1:
            turn = turns[sends[0]]
            through = turn.frames if turn.per == 0.0 else turn.frames - rng.binomial(turn.frames, turn.per)
            answered = through > 0
            bits[sends] += through * turn.frame_bits
        else:
            collided[sends] += 1
        if answered:
            elapsed_s += SIFS_S + turn.ack_s + DIFS_S
            window[sends] = CW_MIN + 1
        else:
            elapsed_s += collision_tail_s
            window[sends] = np.minimum(2 * window[sends], CW_MAX + 1)
        counter[sends] = rng.integers(0, window[sends]) + (0 if goes_on_at_once else 1)
    return CsmaRun(elapsed_s, attempts, collided, bits, air_s)
