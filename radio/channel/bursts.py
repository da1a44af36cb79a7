"""Loss in bursts: a two-state Markov chain for every pair of drones (Gilbert 1960, Elliott 1963).

A pair is *good* or *bad*, in both directions alike, as when a house or a body stands between. In each state a frame
fails at each try with a probability of its own, besides what its SNR loses: 1 − (1 − PER)(1 − loss). In the long run
a share π_B = p / (p + r) of the steps is bad, and a burst lasts 1 / r steps on average (p good to bad, r bad to good).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sortie.radio.settings import BurstSettings
from sortie.scenarios.frames import frame_at
from sortie.scenarios.streams import stream

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_BLOCK_NUMBERS = 1 << 18


def bad_share(good_to_bad: float, bad_to_good: float) -> float:
    """π_B: the share of steps in which a pair is bad, in the long run."""
    return good_to_bad / (good_to_bad + bad_to_good)


def mean_loss(settings: BurstSettings) -> float:
    """Mean probability that a try is lost to bursts, in the long run."""
    bad = bad_share(settings.good_to_bad, settings.bad_to_good)
    return (1.0 - bad) * settings.loss_good + bad * settings.loss_bad


def walk(bad: BoolArray, draws: FloatArray, good_to_bad: float, bad_to_good: float) -> BoolArray:
    """The states after each step.

    Args:
        bad: [...] the states before the first step.
        draws: [steps, ...] uniform numbers.

    Returns:
        [steps, ...], True where bad.
    """
    states = np.empty(draws.shape, bool)
    for step, u in enumerate(draws):
        bad = np.where(bad, u >= bad_to_good, u < good_to_bad)
        states[step] = bad
    return states


class PairNumbers:
    """Uniform numbers for pairs of drones, row after row; the stream of drone h draws for the drones of lower id.

    So one more drone changes nobody's numbers.
    """

    def __init__(self, seed: int, replication: int, n: int, purpose: str) -> None:
        self._n = n
        self._streams = [stream(seed, replication, h, purpose) for h in range(n)]
        self._block = max(1, min(1024, _BLOCK_NUMBERS // (n * n)))
        self._numbers: FloatArray = np.zeros((0, n, n))
        self._next = 0

    def row(self) -> FloatArray:
        """[N, N], symmetric; 0 on the diagonal."""
        if self._next == len(self._numbers):
            self._refill()
        self._next += 1
        return np.asarray(self._numbers[self._next - 1])

    def _refill(self) -> None:
        self._next = 0
        self._numbers = numbers = np.zeros((self._block, self._n, self._n))
        for h in range(1, self._n):
            numbers[:, h, :h] = drawn = self._streams[h].random((self._block, h))
            numbers[:, :h, h] = drawn


class PairStates:
    """Which pairs are bad, frame by frame; a frame is in the state of the step that it begins in.

    Args:
        settings: see `sortie.radio.settings.BurstSettings`.
        n: number of drones.
        seed, replication: as in `sortie.scenarios.streams.stream`.
        frame_s: time between two calls of `advance`.
    """

    def __init__(self, settings: BurstSettings, n: int, seed: int, replication: int, frame_s: float) -> None:
        self.settings = settings
        self._frame_s = frame_s
        self._numbers = PairNumbers(seed, replication, n, "bursts")
        self._frame = self._step = -1
        self.bad: BoolArray = np.zeros((n, n), bool)
        """[N, N], symmetric."""

    def advance(self) -> FloatArray:
        """Move on by one frame; returns [N, N]: the probability that a try is lost, sender by receiver."""
        c = self.settings
        self._frame += 1
        due = frame_at(self._frame * self._frame_s, c.step_s)
        while self._step < due:
            self._step += 1
            u = self._numbers.row()
            if self._step == 0:  # begins as it is in the long run
                self.bad = u < bad_share(c.good_to_bad, c.bad_to_good)
            else:
                self.bad = walk(self.bad, u[None], c.good_to_bad, c.bad_to_good)[0]
        return np.where(self.bad, c.loss_bad, c.loss_good)
