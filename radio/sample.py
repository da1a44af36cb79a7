"""One unicast sample on its way: what it is, what has become of it so far, and what the medium must give it."""

from __future__ import annotations

from collections.abc import Callable
from math import isnan, nan

import numpy as np
from numpy.typing import NDArray

from sortie.radio.mac.airtime import (
    ACK_S,
    Exchanges,
    ampdu_frames,
    frame_bytes,
    frames_exchanges,
    repair_wire_bytes,
    residual_loss,
    sample_exchanges,
    tries,
)
from sortie.radio.mac.contention import contention
from sortie.radio.mac.jobs import AirJob
from sortie.radio.mac.rate_control import Minstrel
from sortie.radio.overrides import LinkNow
from sortie.radio.rates import STANDARDS, rate_table, rescale
from sortie.radio.settings import AirSettings
from sortie.radio.transmission import Status, Transmission, losses

IntArray = NDArray[np.intp]
FloatArray = NDArray[np.float64]
_DELIVERED = Status.DELIVERED  # members of an enumeration are slow to look up
_GOLDEN = 0.6180339887498949
_MAX_DEMANDS = 20_000


class Sample(AirJob):
    """A sample, its current pass through the medium, and the goodput measurement that it carries."""

    __slots__ = (
        "arrived",
        "drained_bits",
        "draws",
        "fragments",
        "full_mbps",
        "hops",
        "kind",
        "left",
        "loss_probability",
        "loss_share",
        "lost",
        "mark_bits",
        "mark_left",
        "mark_s",
        "mcs",
        "on_done",
        "order",
        "origin",
        "pass_bytes",
        "pass_frames",
        "passes",
        "payload_bytes",
        "piece_bytes",
        "pieces",
        "receiver",
        "reliable",
        "repairs",
        "snr_db",
        "t_first_s",
        "t_queued_s",
        "t_sent_s",
        "target",
        "unreachable",
        "wire_bytes",
    )

    def __init__(
        self,
        number: int,
        sender: int,
        receiver: int,
        kind: str,
        payload_bytes: int,
        reliable: bool,
        t_sent_s: float,
        deadline_s: float,
        on_done: Callable[[Transmission], None],
        fragments: int,
        wire_bytes: int,
        draws: list[float],
        snr_db: float,
        drained_bits: float,
        piece_bytes: int,
        order: Callable[[Sample, int], IntArray],
    ) -> None:
        """Args: `fragments` and `wire_bytes` of the whole sample; `draws` one uniform number a pass; `drained_bits` what
        the sender had got through when this was written; the rest as in `Air.send`."""
        super().__init__(number, sender, deadline_s)
        self.receiver = receiver  # of this hop, as `sender`
        self.origin, self.target = sender, receiver
        self.hops = 1
        self.kind = kind
        self.payload_bytes = payload_bytes
        self.reliable = reliable
        self.on_done = on_done
        self.order = order  # a random one of so many pieces, for which of them are lost
        self.t_sent_s = self.t_queued_s = t_sent_s
        self.t_first_s = nan
        self.fragments = fragments
        self.left = fragments  # fragments of this pass
        self.pass_bytes = wire_bytes  # on the wire in this pass
        self.pass_frames = 0.0  # with MAC retries, in this pass
        self.lost = 0
        self.repairs = 0
        self.passes = 0  # through the medium, on this hop and before this one
        self.draws = draws
        self.piece_bytes = piece_bytes  # 0: it is of use as a whole only
        self.pieces: IntArray | None = np.arange(fragments) if piece_bytes else None  # of this pass, in their order
        self.arrived: list[IntArray] = []  # pieces at the end of this hop
        self.mcs = -1
        self.snr_db = snr_db
        self.loss_probability = 1.0  # of a fragment, after all MAC retries
        self.loss_share = 0.0  # loss_probability so far, weighted by the part of the pass that it held for
        self.unreachable = ""  # '' or the reason
        self.wire_bytes = 0.0
        self.full_mbps = 0.0  # payload rate of full A-MPDUs, alone, at the MCS in use
        self.mark_s = t_sent_s  # begin of the goodput measurement
        self.mark_left = 1.0  # `remaining` when progress was last booked
        self.mark_bits = 0.0  # acknowledged since mark_s, as goodput counts them
        self.drained_bits = drained_bits

    def restart(self) -> None:
        """Begin a pass anew."""
        self.remaining = self.mark_left = 1.0
        self.loss_share = 0.0

    def book(self) -> float:
        """Count what was acknowledged since the last time, if anything; returns it in bits as goodput counts them."""
        done = self.mark_left - self.remaining
        bits = done * self.alone_s * self.full_mbps * 1e6
        self.mark_bits += bits
        self.wire_bytes += done * self.pass_bytes if not self.unreachable else 0.0
        self.loss_share += done * self.loss_probability
        self.mark_left = self.remaining
        return bits

    def round_draw(self) -> float:
        """The uniform number of the present pass; beyond those it was given, the last one shifted by golden ratios."""
        extra = self.passes - len(self.draws) + 1
        return self.draws[self.passes] if extra <= 0 else (self.draws[-1] + extra * _GOLDEN) % 1.0

    def lose(self) -> int:
        """What of this pass did not get through, its progress being booked; returns how many fragments.

        Pieces go in their order, so that a pass that was cut short has brought the first of them.
        """
        done = 1.0 - self.remaining
        sent = self.left if done >= 1.0 else int(done * self.left + 1e-9)
        if self.unreachable or sent == 0:
            return self.left
        lost = losses(self.round_draw(), sent, min(1.0, self.loss_share / done)) if self.loss_share > 0.0 else 0
        missing = lost + self.left - sent
        if self.pieces is not None:
            which = np.sort(self.order(self, sent)[:lost]) if lost else np.arange(0)
            self.arrived.append(np.delete(self.pieces[:sent], which))
            self.pieces = np.concatenate([self.pieces[which], self.pieces[sent:]])
            self.left = len(self.pieces)
        self.lost += lost
        self.restart()  # the caller has these figures; a second call returns nothing sent
        return missing

    def forward(self, sender: int, receiver: int, now_s: float, draws: list[float], drained_bits: float) -> None:
        """Begin the next hop with what the last one brought."""
        self.sender, self.receiver = sender, receiver
        self.hops += 1
        self.draws, self.passes = draws, 0
        self.t_queued_s, self.drained_bits = now_s, drained_bits
        if self.pieces is not None:
            self.pieces = np.sort(np.concatenate(self.arrived))
            self.arrived = []
        self.left = self.fragments if self.pieces is None else len(self.pieces)
        self.restart()
        self.live = True

    def is_whole(self) -> bool:
        """Whether all that has come is all there is."""
        return self.pieces is None or sum(map(len, self.arrived)) == self.fragments

    def bytes_of(self, pieces: IntArray) -> int:
        """Payload of some of its pieces."""
        short = self.fragments * self.piece_bytes - self.payload_bytes  # by which the last one is shorter
        return len(pieces) * self.piece_bytes - (short if self.fragments - 1 in pieces else 0)

    def row(self, status: Status, reason: str, t_done_s: float) -> Transmission:
        """Its row of the record; one that would be lost or expired while pieces of it have come is partial."""
        arrived = self.payload_bytes if status is _DELIVERED else 0
        missing: tuple[int, ...] = ()
        if self.arrived and self.receiver == self.target and status in (Status.LOST, Status.EXPIRED):
            here = np.concatenate(self.arrived)
            if len(here):
                status, arrived = Status.PARTIAL, self.bytes_of(here)
                missing = tuple(np.setdiff1d(np.arange(self.fragments), here).tolist())
        return Transmission(
            self.number, self.origin, self.target, self.kind, self.payload_bytes, round(self.wire_bytes),
            self.t_sent_s, self.deadline_s, self.t_first_s, t_done_s, status, reason, self.fragments, self.lost,
            self.repairs, self.mcs, self.snr_db, self.granted_s, self.hops, arrived, missing,
        )  # fmt: skip


class Service:
    """Load that a sample puts on the medium over a link of a given quality: rate control, MAC retries, exchanges."""

    def __init__(self, settings: AirSettings, seed: int, replication: int) -> None:
        self._settings = settings
        self._frame_bytes = frame_bytes(settings.fragment_bytes, fragmented=True)
        self._standard = STANDARDS[settings.standard]
        self._table = rate_table(settings.bandwidth_mhz, settings.rician_k_db, self._frame_bytes, settings.standard)
        self._rates = self._standard.rates_mbps[settings.bandwidth_mhz]
        self._full_mbps = tuple(self._full_goodput(rate) for rate in self._rates)
        self._minstrel = Minstrel(self._rates, seed, replication) if settings.rate_control == "minstrel" else None
        probe = frames_exchanges(1, self._frame_bytes, self._frame_bytes, self._rates[0], 1, ACK_S, self._standard)
        self._probe = probe.scaled(settings.retry_limit + 1.0)
        self._mbps_at: FloatArray | None = None
        # both are the same again and again: links are looked up on a grid of SNR, payloads come in few sizes
        self._demands: dict[tuple[int, int, bool, int], Exchanges] = {}
        self._qualities: dict[tuple[int, float], tuple[float, float, float]] = {}

    def begin(
        self,
        s: Sample,
        now_s: float,
        known_snr_db: float,
        snr_db: float,
        receiver_gone: bool,
        given: LinkNow | None = None,
    ) -> None:
        """Set what a sample at the head of its queue asks for, its progress up to now being booked.

        Args:
            s: the sample.
            now_s: the time.
            known_snr_db: mean SNR that its sender knows and picks the MCS by.
            snr_db: mean SNR as it is.
            receiver_gone: whether nobody is there to answer.
            given: what stands beside the models or in their place; None is nothing.
        """
        fresh = s.t_start_s == now_s
        if isnan(s.t_first_s):
            s.t_first_s = now_s
        s.snr_db = snr_db
        table = self._table
        mcs = table.mcs[table.index(known_snr_db)]
        if self._minstrel is not None and mcs >= 0:
            mcs = self._minstrel.mcs(s.sender, s.receiver, now_s)
        if given is not None:
            mcs = self._given_mcs(mcs, given)
        reason = "receiver_gone" if receiver_gone else "no_link" if mcs < 0 else ""
        if fresh or (-1 if reason else mcs) != s.mcs:
            s.mark_s, s.mark_bits = now_s, 0.0
        if reason:
            if fresh or not s.unreachable:
                if s.pieces is not None and not fresh:  # those that went before the link did are there
                    s.lose()
                    s.passes += 1
                    s.pass_bytes = self.wire_bytes(s)
                s.restart()
                s.demand(self._probe)
                s.full_mbps = 0.0
            s.unreachable, s.mcs = reason, -1
            return
        if s.unreachable:
            s.unreachable = ""
            s.restart()
        s.mcs = mcs
        per = table.all_per[mcs][table.index(snr_db)]
        payload = s.payload_bytes if s.left == s.fragments else self.repair_payload(s)
        if s.fragments == 1:
            per = rescale(per, frame_bytes(payload) / self._frame_bytes)
        elif s.piece_bytes:
            per = rescale(per, frame_bytes(s.piece_bytes) / self._frame_bytes)
        if given is not None:
            per = 1.0 - (1.0 - per) * (1.0 - given.burst_loss) if isnan(given.loss) else given.loss
        mean_tries, s.loss_probability, s.full_mbps = self._qualities.get((mcs, per)) or self._quality(mcs, per)
        s.pass_frames = s.left * mean_tries
        if given is not None and not isnan(given.goodput_mbps):
            mean_tries, s.full_mbps = self._full_mbps[mcs] / given.goodput_mbps, given.goodput_mbps
        key = (payload, mcs, s.reliable, s.piece_bytes)
        demand = self._demands.get(key)
        if demand is None:
            if len(self._demands) > _MAX_DEMANDS:
                self._demands.clear()
            demand = self._demands[key] = self._demand(*key)
        s.demand(demand, mean_tries)

    def learn(self, s: Sample, now_s: float) -> None:
        """Let rate control see what a sample has sent since its progress was last booked."""
        if self._minstrel is not None and not s.unreachable:
            at = self._table.index(s.snr_db)
            frames = (s.mark_left - s.remaining) * s.pass_frames
            self._minstrel.sent(s.sender, s.receiver, now_s, s.mcs, frames, [row[at] for row in self._table.all_per])

    def _given_mcs(self, mcs: int, given: LinkNow) -> int:
        """The slowest MCS that carries a traced goodput (or the fastest); some MCS where a loss alone is traced."""
        if isnan(given.goodput_mbps):
            return mcs if isnan(given.loss) else max(mcs, 0)
        if given.goodput_mbps <= 0.0:
            return -1
        fast = (i for i, mbps in enumerate(self._full_mbps) if mbps >= given.goodput_mbps)
        return next(fast, len(self._full_mbps) - 1)

    def _quality(self, mcs: int, per: float) -> tuple[float, float, float]:
        """Mean tries, loss after all of them, and payload rate of full A-MPDUs, of frames that fail with `per`."""
        if len(self._qualities) > _MAX_DEMANDS:
            self._qualities.clear()
        limit = self._settings.retry_limit
        mean_tries, loss = tries(per, limit), residual_loss(per, limit)
        found = self._qualities[mcs, per] = (mean_tries, loss, self._full_mbps[mcs] / mean_tries * (1.0 - loss))
        return found

    def repair_payload(self, s: Sample) -> int:
        """Payload bytes of the fragments that are left."""
        return min(s.payload_bytes, s.left * (s.piece_bytes or self._settings.fragment_bytes))

    def wire_bytes(self, s: Sample) -> int:
        """Bytes of the frames of the fragments that are left."""
        payload = s.payload_bytes if s.left == s.fragments else self.repair_payload(s)
        return payload + s.left * frame_bytes(0, fragmented=s.fragments > 1 and not s.piece_bytes)

    def link_mbps(self, snr_db: FloatArray, loss: FloatArray | None = None) -> FloatArray:
        """Payload rate of full A-MPDUs alone on the channel at a mean SNR, losses paid; 0 where there is no link or NaN.

        Args: `loss` of a try, in place of the PER, where it is not NaN; such a link is there whatever its SNR (`begin`).
        """
        if self._mbps_at is None:
            table = self._table
            self._mbps_at = np.array(
                [
                    self._quality(mcs, per[i])[2] if mcs >= 0 else 0.0
                    for i, mcs in enumerate(table.mcs)
                    for per in [table.all_per[mcs]]
                ]
            )
        at = np.array([self._table.index(snr) for snr in np.nan_to_num(snr_db, nan=-1e9).ravel().tolist()], np.intp)
        mbps = np.asarray(self._mbps_at[at].reshape(snr_db.shape))
        if loss is not None:
            for link in zip(*np.nonzero(~np.isnan(loss)), strict=True):
                mcs = max(0, self._table.mcs[self._table.index(snr_db[link])])
                mbps[link] = self._quality(mcs, float(loss[link]))[2]
        return mbps

    def _demand(self, payload_bytes: int, mcs: int, reliable: bool, piece_bytes: int) -> Exchanges:
        c, rate = self._settings, self._rates[mcs]
        demand = sample_exchanges(
            payload_bytes, piece_bytes or c.fragment_bytes, rate, c.max_ampdu_frames, self._standard, piece_bytes > 0
        )
        if reliable:  # heartbeat and ACKNACK, each an exchange of its own
            length = repair_wire_bytes(1) // 2
            demand = demand + frames_exchanges(1, length, length, rate, 1, ACK_S, self._standard).scaled(2.0)
        return demand

    def _full_goodput(self, rate_mbps: float) -> float:
        """Payload Mb/s of full A-MPDUs without loss, alone on the channel."""
        c = self._settings
        m = ampdu_frames(self._frame_bytes, rate_mbps, c.max_ampdu_frames, self._standard)
        exchanges = frames_exchanges(
            m, self._frame_bytes, self._frame_bytes, rate_mbps, c.max_ampdu_frames, standard=self._standard
        )
        return m * c.fragment_bytes * 8e-6 / exchanges.channel_s(contention(1))
