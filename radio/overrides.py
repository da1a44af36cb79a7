"""What stands in place of the link models, or on top of them: link traces and bursts of loss.

Frames of a traced link go by the trace, those of any other by the models and, where the scenario has them, bursts.
What happens to a unicast frame's tries is worked out where its sample is served (`sortie.radio.sample`); whom a group frame
reaches is settled here, by a uniform number for each link and frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sortie.radio.channel.bursts import PairNumbers, PairStates
from sortie.radio.channel.traces import Given, LinkTrace
from sortie.radio.rates import mean_group_per, snr_index
from sortie.radio.settings import AirSettings

FloatArray = NDArray[np.float64]
_GOLDEN = 0.6180339887498949


class LinkNow(NamedTuple):
    """What holds for a link's unicast frames in this frame, NaN where the model does."""

    burst_loss: float
    """Probability that a try is lost besides the PER."""
    loss: float
    """Probability that a try is lost, in place of the PER."""
    goodput_mbps: float
    """Payload rate of the link alone on the channel."""


class Overrides:
    """Traces and bursts, frame by frame.

    Args:
        settings: see `sortie.radio.settings.AirSettings`.
        trace: None where there is none.
        n: number of drones.
        seed, replication: as in `sortie.scenarios.streams.stream`.
        frame_s: time between two calls of `advance`.
    """

    def __init__(
        self, settings: AirSettings, trace: LinkTrace | None, n: int, *, seed: int, replication: int, frame_s: float
    ) -> None:
        self._n, self._frame_s, self._trace = n, frame_s, trace
        bursts = settings.bursts
        self._states = None
        if bursts.good_to_bad > 0.0 or bursts.loss_good > 0.0:
            self._states = PairStates(bursts, n, seed, replication, frame_s)
        self._numbers = PairNumbers(seed, replication, n, "override loss", ordered=True)
        self._frame = -1
        nothing = np.full((n, n), np.nan)
        self._given = Given(nothing, nothing, nothing)
        self._burst_loss: FloatArray = np.zeros((n, n))
        self._draws: FloatArray = np.zeros((n, n))
        # group frames go out in the primary 20 MHz with the whole power, so over less noise
        self._group_gain_db = 10.0 * float(np.log10(settings.bandwidth_mhz / 20.0))
        self._group_rate_mbps = settings.group_rate_mbps
        self._k_db = settings.rician_k_db
        self._snr_rows: list[list[float]] | None = None
        self._known_rows: list[list[float]] | None = None

    @classmethod
    def wanted(cls, settings: AirSettings) -> bool:
        """Whether the scenario has any."""
        return settings.trace is not None or settings.bursts.good_to_bad > 0.0 or settings.bursts.loss_good > 0.0

    def advance(self, extra_loss_db: ArrayLike | None, noise_rise_db: ArrayLike | None = None) -> None:
        """Move on by one frame.

        Args:
            extra_loss_db: [N, N], taken off a traced SNR; None is none.
            noise_rise_db: [N], how far jammers lift each receiver's noise; None is not at all.
        """
        self._frame += 1
        self._draws = self._numbers.row()
        if self._states is not None:
            self._burst_loss = self._states.advance()
        if self._trace is not None:
            self._given = given = self._trace.at(self._frame * self._frame_s, self._n)
            snr_db = given.snr_db
            if extra_loss_db is not None:
                snr_db = snr_db - np.asarray(extra_loss_db, dtype=float)
            if noise_rise_db is not None:
                snr_db = snr_db - np.asarray(noise_rise_db, dtype=float)
            self._given = given._replace(snr_db=snr_db)
            self._known_rows, self._snr_rows = self._snr_rows, snr_db.tolist()

    def snr_db(self, modelled_db: FloatArray) -> FloatArray:
        """[N, N]: the trace's SNR in this frame where it has one, else the model's."""
        return np.where(np.isnan(self._given.snr_db), modelled_db, self._given.snr_db)

    def known_snr_db(self, modelled_db: FloatArray) -> FloatArray:
        """[N, N]: the same of the frame before."""
        if self._known_rows is None:
            return self.snr_db(modelled_db)
        known = np.array(self._known_rows)
        return np.where(np.isnan(known), modelled_db, known)

    @property
    def loss(self) -> FloatArray:
        """[N, N]: the trace's loss in this frame, NaN where it has none."""
        return self._given.loss

    @property
    def traced(self) -> NDArray[np.bool_]:
        """[N, N]: links that the trace gives a loss or a goodput in this frame, whatever their SNR."""
        return ~(np.isnan(self._given.loss) & np.isnan(self._given.goodput_mbps))

    def mbps(self, modelled: FloatArray) -> FloatArray:
        """[N, N]: the trace's goodput where it has one, else the model's."""
        return np.where(np.isnan(self._given.goodput_mbps), modelled, self._given.goodput_mbps)

    def snr_of(self, sender: int, receiver: int, known_db: float, now_db: float) -> tuple[float, float]:
        """The SNR of a link in the frame before and in this one, the model's being given."""
        if self._snr_rows is None or isnan(now := self._snr_rows[sender][receiver]):
            return known_db, now_db
        return (now if self._known_rows is None else self._known_rows[sender][receiver]), now

    def link(self, sender: int, receiver: int) -> LinkNow:
        """What holds for unicast frames of a link."""
        loss, mbps = float(self._given.loss[sender, receiver]), float(self._given.goodput_mbps[sender, receiver])
        return LinkNow(float(self._burst_loss[sender, receiver]), loss, mbps)

    def heard(self, sender: int, heard: Sequence[int], mpdu_bytes: int, times: int) -> list[int]:
        """Whom a group frame reaches, ascending.

        Args:
            heard: whom it reaches by the models, ascending.
            times: how many group frames the sender has sent in this frame before.
        """
        draws = (self._draws[sender] + times * _GOLDEN) % 1.0
        on_top = self._burst_loss[sender]
        if self._trace is None:
            return [i for i in heard if draws[i] >= on_top[i]]
        loss, snr_db = self._given.loss[sender], self._given.snr_db[sender]
        traced = ~(np.isnan(loss) & np.isnan(snr_db))
        reached = [i for i in heard if not traced[i] and draws[i] >= on_top[i]]
        for i in np.flatnonzero(traced).tolist():
            missed = float(loss[i])
            if isnan(missed):
                per = mean_group_per(self._group_rate_mbps, self._k_db, mpdu_bytes)  # kept: frames come in few lengths
                missed = per[snr_index(float(snr_db[i]) + self._group_gain_db)]
                missed = 1.0 - (1.0 - missed) * (1.0 - float(on_top[i]))
            if i != sender and draws[i] >= missed:
                reached.append(i)
        return sorted(reached)
