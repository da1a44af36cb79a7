"""Age of information: how old what a receiver knows of a sender is, in closed form.

A sender gives a sign every `period_s`, which arrives `delay_s` later or is lost; the age at the receiver is the time
since the sending of the newest that arrived. With X the number of periods from one arrival to the next, the mean
age is D + T E[X²] / (2 E[X]), the mean of its peaks D + T E[X], and for D = 0 the share of time above k periods is
E[(X − k)⁺] / E[X] (S. Kaul, R. Yates and M. Gruteser, INFOCOM 2012).

With independent losses of probability p, X is geometric. With a Gilbert–Elliott chain that moves once a period, the
state is known at each arrival alone, and the same moments follow from its matrix of *lost* steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class Chain(NamedTuple):
    """A Gilbert–Elliott channel whose state moves once a period, before its sign is sent."""

    good_to_bad: float
    bad_to_good: float
    loss_good: float
    loss_bad: float

    @property
    def mean_loss(self) -> float:
        """Share of signs that are lost in the long run; what independent losses would be compared at."""
        bad = self.good_to_bad / (self.good_to_bad + self.bad_to_good)
        return (1.0 - bad) * self.loss_good + bad * self.loss_bad


def mean_age_s(period_s: float, loss: float | Chain, delay_s: float = 0.0) -> float:
    """Mean over time; for independent losses D + T (1 + p) / (2 (1 − p))."""
    first, second = _moments(loss)
    return delay_s + period_s * second / (2.0 * first)


def mean_peak_age_s(period_s: float, loss: float | Chain, delay_s: float = 0.0) -> float:
    """Mean of the ages just before an arrival; for independent losses D + T / (1 − p), and as it depends on the mean
    loss alone, bursts do not move it."""
    return delay_s + period_s * _moments(loss)[0]


def share_older(periods: int, loss: float | Chain) -> float:
    """Share of time with an age above so many whole periods, for no delay; p^k for independent losses."""
    if not isinstance(loss, Chain):
        return float(loss**periods)
    # E[(X − k)⁺] = Σ P(X > m) over m ≥ k, and P(X > m) = a Lᵐ 1
    lost, arrived = _matrices(loss)
    start = _at_arrival(lost, arrived)
    tail = start @ np.linalg.matrix_power(lost, periods) @ np.linalg.inv(np.eye(2) - lost) @ np.ones(2)
    return float(tail / _moments(loss)[0])


def _moments(loss: float | Chain) -> tuple[float, float]:
    """E[X] and E[X²], in periods.

    Raises:
        ValueError: if nothing ever arrives.
    """
    if not isinstance(loss, Chain):
        if not 0.0 <= loss < 1.0:
            raise ValueError(f"loss is {loss}, must be in [0, 1)")
        return 1.0 / (1.0 - loss), (1.0 + loss) / (1.0 - loss) ** 2
    if loss.mean_loss >= 1.0:
        raise ValueError(f"mean loss is {loss.mean_loss}, must be below 1")
    lost, arrived = _matrices(loss)
    start, once = _at_arrival(lost, arrived), np.linalg.inv(np.eye(2) - lost)
    first = float(start @ once @ np.ones(2))
    return first, 2.0 * float(start @ once @ once @ np.ones(2)) - first


def _matrices(c: Chain) -> tuple[FloatArray, FloatArray]:
    """[2, 2]: probabilities of moving from state to state with the sign lost, and with it arrived."""
    move = np.array([[1.0 - c.good_to_bad, c.good_to_bad], [c.bad_to_good, 1.0 - c.bad_to_good]])
    loss = np.array([c.loss_good, c.loss_bad])
    return move * loss, move * (1.0 - loss)


def _at_arrival(lost: FloatArray, arrived: FloatArray) -> FloatArray:
    """[2]: the state's distribution right after an arrival, the stationary one of arrivals."""
    step = np.linalg.inv(np.eye(2) - lost) @ arrived
    values, vectors = np.linalg.eig(step.T)
    start = np.real(vectors[:, np.argmax(np.real(values))])
    return np.asarray(start / start.sum())
