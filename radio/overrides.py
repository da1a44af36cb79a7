"""What stands in place of the link models, or on top of them: link traces and bursts of loss.

Frames of a traced link go by the trace, those of any other by the models and, where the scenario has them, bursts.
The medium draws what each frame on the air loses to them.
"""

from __future__ import annotations

from math import isnan
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sortie.radio.channel.bursts import PairStates
from sortie.radio.channel.traces import Given, LinkTrace
from sortie.radio.settings import AirSettings

FloatArray = NDArray[np.float64]


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
        self._frame = -1
        nothing = np.full((n, n), np.nan)
        self._given = Given(nothing, nothing, nothing)
        self._burst_loss: FloatArray = np.zeros((n, n))
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

    def group_loss(self) -> FloatArray:
        """[N, N]: probability that a group frame is lost besides what its SNR loses, or in place of it where traced."""
        return np.where(np.isnan(self._given.loss), self._burst_loss, self._given.loss)
