"""One unicast sample on its way: what it is, what has become of it so far, and how its link is used."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from math import isnan, nan
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sortie.radio.mac.airtime import (
    BLOCK_ACK_LONG_S,
    BLOCK_ACK_S,
    CTS_S,
    MAX_PPDU_S,
    MPDU_DELIMITER,
    RTS_S,
    ampdu_frames,
    frame_bytes,
    frames_exchanges,
    repair_wire_bytes,
    residual_loss,
    sample_exchanges,
    tries,
)
from sortie.radio.mac.contention import SIFS_S, SLOT_S, contention
from sortie.radio.mac.jobs import NO_FRAMES, NONE_DROPPED, AirJob
from sortie.radio.mac.medium import Link
from sortie.radio.mac.rate_control import Minstrel
from sortie.radio.overrides import LinkNow
from sortie.radio.rates import STANDARDS, StandardName, rate_table, snr_index
from sortie.radio.settings import AirSettings
from sortie.radio.transmission import Status, Transmission

IntArray = NDArray[np.intp]
FloatArray = NDArray[np.float64]
_DELIVERED: Final = Status.DELIVERED  # members of an enumeration are slow to look up
_MAX_KEPT = 20_000


class Use(NamedTuple):
    """How a link is used in this frame: what the medium must know, why nobody is reached, and the rate of full A-MPDUs."""

    link: Link
    unreachable: str
    full_mbps: float


UseNow = tuple[int, Use, float, int]
"""A link in this frame: the medium's number for it, its use, its mean SNR as it is, and which time this was found out."""
UNUSED: Final = Use(Link(-1, dead=True), "", 0.0)


class Sample(AirJob):
    """A sample, its current pass through the medium, and the goodput measurement that it carries."""

    __slots__ = (
        "arrived",
        "begun_s",
        "drained_bits",
        "fragments",
        "full_mbps",
        "hops",
        "key",
        "kind",
        "left",
        "lost",
        "mark_bits",
        "mark_frames",
        "mark_s",
        "mcs",
        "on_done",
        "origin",
        "pass_wire",
        "payload_bytes",
        "piece_bytes",
        "pieces",
        "receiver",
        "reliable",
        "repairs",
        "repairs_before",
        "sent_before",
        "snr_db",
        "t_first_s",
        "t_queued_s",
        "t_sent_s",
        "target",
        "unreachable",
        "use",
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
        use: UseNow,
        drained_bits: float,
        piece_bytes: int,
    ) -> None:
        """Args: `fragments` of the whole sample; `use` of its first link; `drained_bits` what the sender had got through when this was written;
        the rest as in `Air.send`."""
        AirJob.__init__(self, number, sender, deadline_s)
        self.receiver = receiver  # of this hop, as `sender`
        self.origin, self.target = sender, receiver
        self.hops = 1
        self.kind = kind
        self.key = sender, sender, receiver, kind  # sender of this hop, origin, target, kind: a newer one replaces it
        self.payload_bytes = payload_bytes
        self.reliable = reliable
        self.on_done = on_done
        self.t_sent_s = self.t_queued_s = t_sent_s
        self.t_first_s = self.begun_s = nan
        self.fragments = fragments
        self.left = fragments  # fragments of this pass
        self.lost = 0
        self.repairs = 0
        self.repairs_before = 0  # on earlier hops
        self.piece_bytes = piece_bytes  # 0: it is of use as a whole only
        self.keeps_frames = piece_bytes > 0
        self.pieces: IntArray | None = np.arange(fragments) if piece_bytes else None  # of this pass, in their order
        self.arrived: list[IntArray] = []  # pieces at the end of this hop
        self.mcs = -1
        self.flow, _, self.snr_db, _ = self.use = use
        self.unreachable = ""  # '' or the reason
        self.sent_before = 0  # frames of this pass that were sent before it became so
        self.wire_bytes = 0.0  # of passes that are over
        self.pass_wire = 0.0  # wire bytes of a frame of this pass
        self.full_mbps = 0.0  # payload rate of full A-MPDUs, alone, at the MCS in use
        self.mark_s = t_sent_s  # begin of the goodput measurement
        self.mark_frames = 0  # `arrived_frames` when progress was last booked
        self.mark_bits = 0.0  # acknowledged since mark_s, as goodput counts them
        self.drained_bits = drained_bits

    loss_probability = 0.0
    """Nothing of what has arrived is lost later."""

    @property
    def remaining(self) -> float:
        """Share of this pass that is not at its receiver."""
        return 1.0 - self.arrived_frames / self.frames if self.frames else 1.0

    def end_pass(self) -> int:
        """Take in what this pass has brought; returns how many of its fragments are missing at the receiver."""
        # tries on a link that is dead count as airtime alone
        self.wire_bytes += (self.sent_before if self.unreachable else self.sent_frames) * self.pass_wire
        missing = self.left - self.arrived_frames
        if self.pieces is not None:
            self.arrived.append(self.pieces[self.here])
            self.pieces = np.delete(self.pieces, self.here)
        self.arrived_frames = self.sent_frames = self.sent_before = self.mark_frames = 0
        self.here = NO_FRAMES
        if self.dropped:
            self.lost += len(self.dropped)
            self.dropped = NONE_DROPPED
        return missing

    def forward(self, sender: int, receiver: int, now_s: float, drained_bits: float) -> None:
        """Begin the next hop with what the last one brought."""
        self.sender, self.receiver = sender, receiver
        self.key = sender, self.origin, self.target, self.kind
        self.hops += 1
        self.repairs_before = self.repairs
        self.t_queued_s, self.drained_bits = now_s, drained_bits
        if self.pieces is not None:
            self.pieces = np.sort(np.concatenate(self.arrived))
            self.arrived = []
        self.left = self.fragments if self.pieces is None else len(self.pieces)

    def is_whole(self) -> bool:
        """Whether all that has come is all there is."""
        return self.pieces is None or sum(map(len, self.arrived)) == self.fragments

    def bytes_of(self, pieces: IntArray) -> int:
        """Payload of some of its pieces."""
        short = self.fragments * self.piece_bytes - self.payload_bytes  # by which the last one is shorter
        return len(pieces) * self.piece_bytes - (short if self.fragments - 1 in pieces else 0)

    def row_of(self, status: Status, reason: str, t_done_s: float) -> Transmission:
        """Its row of the record; one that would be lost or expired while pieces of it have come is partial."""
        arrived = self.payload_bytes if status is _DELIVERED else 0
        missing: tuple[int, ...] = ()
        if self.arrived and self.receiver == self.target and status in (Status.LOST, Status.EXPIRED):
            here = np.concatenate(self.arrived)
            if len(here):
                status, arrived = Status.PARTIAL, self.bytes_of(here)
                missing = tuple(np.setdiff1d(np.arange(self.fragments), here).tolist())
        sent_frames = self.sent_before if self.unreachable else self.sent_frames
        wire_bytes = round(self.wire_bytes + sent_frames * self.pass_wire)
        row = (
            self.number,
            self.origin,
            self.target,
            self.kind,
            self.payload_bytes,
            wire_bytes,
            self.t_sent_s,
            self.deadline_s,
            self.t_first_s,
            t_done_s,
            status,
            reason,
            self.fragments,
            self.lost + len(self.dropped),
            self.repairs,
            self.mcs,
            self.snr_db,
            self.granted_s,
            self.hops,
            arrived,
            missing,
        )
        return tuple.__new__(Transmission, row)  # half the time of the constructor


@lru_cache(maxsize=64)
def full_goodputs_mbps(
    bandwidth_mhz: int, standard: StandardName, fragment_bytes: int, max_ampdu_frames: int
) -> tuple[float, ...]:
    """By MCS: payload Mb/s of full A-MPDUs without loss, alone on the channel."""
    each, found = frame_bytes(fragment_bytes, fragmented=True), []
    for rate_mbps in STANDARDS[standard].rates_mbps[bandwidth_mhz]:
        m = ampdu_frames(each, rate_mbps, max_ampdu_frames, STANDARDS[standard])
        exchanges = frames_exchanges(m, each, each, rate_mbps, max_ampdu_frames, standard=STANDARDS[standard])
        found.append(m * fragment_bytes * 8e-6 / exchanges.channel_s(contention(1)))
    return tuple(found)


@lru_cache(maxsize=64)
def _plain_uses(full_mbps: tuple[float, ...]) -> tuple[Use, ...]:
    """How a link is used that has nothing but its MCS; MCS −1, no link, is the last one."""
    by_mcs = [Use(Link(mcs), "", mbps) for mcs, mbps in enumerate(full_mbps)]
    return (*by_mcs, Use(Link(-1, dead=True), "no_link", 0.0))


class Service:
    """How a sender uses a link of a given quality: rate control, traces, bursts, and the frames of a sample."""

    def __init__(self, settings: AirSettings, noise_dbm: float) -> None:
        self._settings = settings
        self._frame_bytes = frame_bytes(settings.fragment_bytes, fragmented=True)
        self._standard = STANDARDS[settings.standard]
        self._table = rate_table(settings.bandwidth_mhz, settings.rician_k_db, self._frame_bytes, settings.standard)
        self._rates = self._standard.rates_mbps[settings.bandwidth_mhz]
        self._full_mbps = full_goodputs_mbps(
            settings.bandwidth_mhz, settings.standard, settings.fragment_bytes, settings.max_ampdu_frames
        )
        self.least_snr_db = settings.preamble_detection_dbm - noise_dbm
        self.minstrel = Minstrel(self._rates) if settings.rate_control == "minstrel" else None
        self._plain = _plain_uses(self._full_mbps)
        self._mbps_at: FloatArray | None = None
        # payloads come in few sizes
        self._equivalents: dict[tuple[int, int, int], float] = {}
        self._passes: dict[tuple[int, int, int, int, bool], tuple[int, int, float]] = {}

    def use(
        self,
        sender: int,
        receiver: int,
        now_s: float,
        known_snr_db: float,
        receiver_gone: bool,
        given: LinkNow | None = None,
    ) -> Use:
        """How a link is used from now on.

        Args:
            sender, receiver: whose link.
            now_s: the time.
            known_snr_db: mean SNR that its sender knows and picks the MCS by.
            receiver_gone: whether nobody is there to answer.
            given: what stands beside the models or in their place; None is nothing.
        """
        mcs = self._ideal_mcs(known_snr_db)
        if self.minstrel is not None and mcs >= 0:
            mcs = self.minstrel.mcs(sender, receiver, now_s)
        if given is None and not receiver_gone:
            return self._plain[mcs]
        rate_mbps, frames, burst_loss, loss = 0.0, 0, 0.0, nan
        if given is not None:
            mcs = self._given_mcs(mcs, given)
            burst_loss, loss = given.burst_loss, given.loss
            if mcs >= 0 and not isnan(given.goodput_mbps):
                rate_mbps, frames = self._rate_of(given.goodput_mbps)
        reason = "receiver_gone" if receiver_gone else "no_link" if mcs < 0 else ""
        link = Link(mcs, bool(reason), rate_mbps, frames, loss, burst_loss)
        full_mbps = 0.0 if reason else given.goodput_mbps if rate_mbps and given is not None else self._full_mbps[mcs]
        return Use(link, reason, full_mbps)

    def _ideal_mcs(self, snr_db: float) -> int:
        return self._table.mcs[snr_index(snr_db)] if snr_db >= self.least_snr_db else -1

    def _given_mcs(self, mcs: int, given: LinkNow) -> int:
        """The slowest MCS that carries a traced goodput (or the fastest); some MCS where a loss alone is traced."""
        if isnan(given.goodput_mbps):
            return mcs if isnan(given.loss) else max(mcs, 0)
        if given.goodput_mbps <= 0.0:
            return -1
        fast = (i for i, mbps in enumerate(self._full_mbps) if mbps >= given.goodput_mbps)
        return next(fast, len(self._full_mbps) - 1)

    def _rate_of(self, goodput_mbps: float) -> tuple[float, int]:
        """The data rate, Mb/s, and the frames an A-MPDU at which full A-MPDUs alone on the channel carry a goodput."""
        c = self._settings
        access = getattr(c.edca, c.payload_class)
        block_ack_s = BLOCK_ACK_S if max(c.block_ack_window, c.max_ampdu_frames) <= 64 else BLOCK_ACK_LONG_S
        around_s = 2 * SIFS_S + block_ack_s + (access.aifsn + access.cw_min / 2) * SLOT_S
        if c.rts:
            around_s += RTS_S + SIFS_S + CTS_S + SIFS_S
        frame_s = c.fragment_bytes * 8e-6 / goodput_mbps
        most = min(c.max_ampdu_frames, self._standard.max_ampdu_frames)
        frames = max(1, min(most, int((MAX_PPDU_S + around_s) / frame_s)))
        body_s = max(frames * frame_s - around_s - self._standard.preamble_s, frames * 1e-6)
        return frames * 8e-6 * (self._frame_bytes + MPDU_DELIMITER) / body_s, frames

    def begin(self, s: Sample, now_s: float, *, fresh: bool = True) -> None:
        """A sample comes to the head of its queue (`fresh`), or its link has changed while it is there."""
        _, use, snr_db, _ = s.use
        if fresh and isnan(s.t_first_s):
            s.t_first_s = now_s
        if fresh:
            s.begun_s = now_s
        mcs = -1 if use.unreachable else use.link.mcs
        if fresh or mcs != s.mcs:
            s.mark_s, s.mark_bits = now_s, 0.0
        if use.unreachable and not s.unreachable:
            s.sent_before = 0 if fresh else s.sent_frames
        s.snr_db, s.unreachable, s.mcs, s.full_mbps = snr_db, use.unreachable, mcs, use.full_mbps

    def prepare(self, s: Sample) -> None:
        """Set the frames of a sample's next pass."""
        s.frames = s.left
        key = s.payload_bytes, s.fragments, s.left, s.piece_bytes, s.reliable
        found = self._passes.get(key)
        if found is None:
            if len(self._passes) > _MAX_KEPT:
                self._passes.clear()
            found = self._passes[key] = self._pass(*key)
        s.full_bytes, s.last_bytes, s.pass_wire = found

    def _pass(
        self, payload_bytes: int, fragments: int, left: int, piece_bytes: int, reliable: bool
    ) -> tuple[int, int, float]:
        """Bytes of each frame and of the last one, and wire bytes a frame, where so many of the fragments are left."""
        alone, unit = piece_bytes > 0, piece_bytes or self._settings.fragment_bytes
        split = fragments > 1 and not alone
        payload = payload_bytes if left == fragments else min(payload_bytes, left * unit)
        last = payload - (left - 1) * unit
        full_bytes = frame_bytes(unit if left > 1 else last, fragmented=split)
        last_bytes = frame_bytes(last, fragmented=split) + (repair_wire_bytes(1) if reliable else 0)
        return full_bytes, last_bytes, (payload + left * frame_bytes(0, fragmented=split)) / left

    def bits_of_a_frame(self, s: Sample) -> float:
        """What goodput counts for each frame that arrives: its time alone × the payload rate of full A-MPDUs."""
        if s.mcs < 0 or not s.full_mbps:
            return 0.0
        c = self._settings
        key = (s.frames * (s.piece_bytes or c.fragment_bytes), s.mcs, s.piece_bytes)
        found = self._equivalents.get(key)
        if found is None:
            if len(self._equivalents) > _MAX_KEPT:
                self._equivalents.clear()
            whole = sample_exchanges(
                key[0],
                s.piece_bytes or c.fragment_bytes,
                self._rates[s.mcs],
                c.max_ampdu_frames,
                self._standard,
                s.piece_bytes > 0,
            )
            alone_s = whole.channel_s(contention(1))
            found = self._equivalents[key] = alone_s * self._full_mbps[s.mcs] * 1e6 / s.frames
        return found

    def link_mbps(self, snr_db: FloatArray, loss: FloatArray | None = None) -> FloatArray:
        """Payload rate of full A-MPDUs alone on the channel at a mean SNR, losses paid; 0 where there is no link or NaN.

        Args: `loss` of a try, in place of the PER, where it is not NaN; such a link is there whatever its SNR (`use`).
        """
        if self._mbps_at is None:
            table = self._table
            self._mbps_at = np.array(
                [self._mbps(mcs, table.all_per[mcs][i]) if mcs >= 0 else 0.0 for i, mcs in enumerate(table.mcs)]
            )
        known = np.nan_to_num(snr_db, nan=-1e9)
        at = np.array([self._table.index(snr) for snr in known.ravel().tolist()], np.intp)
        mbps = np.where(known >= self.least_snr_db, self._mbps_at[at].reshape(snr_db.shape), 0.0)
        if loss is not None:
            for link in zip(*np.nonzero(~np.isnan(loss)), strict=True):
                mbps[link] = self._mbps(max(0, self._ideal_mcs(snr_db[link])), float(loss[link]))
        return mbps

    def _mbps(self, mcs: int, per: float) -> float:
        limit = self._settings.retry_limit
        return self._full_mbps[mcs] / tries(per, limit) * (1.0 - residual_loss(per, limit))
