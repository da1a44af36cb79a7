"""The air as the fleet sees it: broadcast, send, silence, and what each sample came to.

`Air` puts the parts together: `channel` says how good each link is in this frame, `rates` which MCS that
allows (the sender knows the SNR of the frame before, so a sudden drop costs it a frame), `airtime` what a sample then asks of the `medium`, and `goodput` what the sender learns of it.

Transport. *Best effort*: a sample with one lost fragment is lost. *Reliable, keep-last-1*: the writer's
heartbeat and the reader's NACK bring lost fragments back, `heartbeat_s + nack_delay_s` after the pass in
which they were lost, until all are through or the deadline passes. In both, a newer sample of the same
sender, receiver and kind replaces an older one that is not through (history depth 1).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isnan, nan
from typing import cast

import numpy as np
import simpy
from numpy.typing import ArrayLike, NDArray

from radio.airtime import (
    ACK_S,
    Exchanges,
    ampdu_frames,
    fragments,
    frame_bytes,
    frames_exchanges,
    group_frame_s,
    repair_wire_bytes,
    residual_loss,
    sample_exchanges,
    sample_wire_bytes,
    tries,
)
from radio.channel import Channel, FloatArray, Jammer, SampleLuck
from radio.contention import contention
from radio.goodput import Goodput
from radio.medium import CW_CONTEXT, End, GroupFrame, Job, Medium
from radio.rates import RATES_MBPS, rate_table, rescale
from radio.transmission import Status, Transmission, losses
from scenarios.schema import Radio
from scenarios.streams import stream

Ids = NDArray[np.intp]
MAX_GROUP_PAYLOAD_BYTES = 2200
"""A group-addressed sample is one 802.11 frame."""
_WINDOW_S = 1e-3
"""A goodput measurement that is still going on counts once it is this old."""
_GOLDEN = 0.6180339887498949


class _Sample(Job):
    """A unicast sample on its way."""

    __slots__ = (
        "drained_bits",
        "fragments",
        "full_mbps",
        "kind",
        "left",
        "loss_probability",
        "loss_share",
        "lost",
        "luck",
        "mark_bits",
        "mark_left",
        "mark_s",
        "mcs",
        "on_done",
        "pass_bytes",
        "payload_bytes",
        "receiver",
        "reliable",
        "repairs",
        "snr_db",
        "t_first_s",
        "t_sent_s",
        "unreachable",
        "wire_bytes",
    )
    receiver: int
    kind: str
    payload_bytes: int
    reliable: bool
    on_done: Callable[[Transmission], None]
    t_sent_s: float
    t_first_s: float
    fragments: int
    left: int  # fragments of this pass
    pass_bytes: int  # on the wire in this pass
    lost: int
    repairs: int
    luck: list[float]
    mcs: int
    snr_db: float
    loss_probability: float  # of a fragment, after all MAC retries
    loss_share: float  # loss_probability so far, weighted by the part of the pass that it held for
    unreachable: str  # '' or the reason
    wire_bytes: float
    full_mbps: float  # payload rate of full A-MPDUs, alone, at the MCS in use
    mark_s: float  # begin of the goodput measurement
    mark_left: float  # `remaining` when progress was last booked
    mark_bits: float  # acknowledged since mark_s, as goodput counts them
    drained_bits: float  # what the sender had got through when this was written


class _Broadcast(GroupFrame):
    """A context frame with its length and who wants to know."""

    __slots__ = ("mpdu_bytes", "on_heard", "residual")
    mpdu_bytes: int
    on_heard: Callable[[Ids], None]
    residual: float


@dataclass(slots=True)
class Counters:
    """Totals so far. Data bytes are payload: sent = delivered + lost + expired + in flight."""

    data_sent_bytes: int = 0
    data_delivered_bytes: int = 0
    data_lost_bytes: int = 0
    data_expired_bytes: int = 0
    data_wire_bytes: int = 0
    context_sent_bytes: int = 0
    context_wire_bytes: int = 0
    broadcasts: int = 0
    receptions: int = 0
    """Broadcasts heard, counted per receiver."""
    missed: int = 0
    """Broadcasts that a living drone did not hear."""
    collided: int = 0
    """Broadcasts lost to a collision with another."""


class Air:
    """Bytes and positions in, fates out.

    Args:
        env: the clock.
        config: the scenario's radio section.
        n_drones: ids are 0 … n_drones − 1.
        seed, replication: as in `scenarios.streams.stream`.
        frame_s: time between two calls of `advance`.
        publish_spread: the drones' clocks are not in step, so a drone's broadcasts reach its radio a fixed time
            after the call, drawn once per drone, uniform in [0, publish_spread · frame_s). 0 hands them over at
            once: then drones that call at the same instant contend, and collide in 1 of 16 pairings.

    `advance` must be called before the first `broadcast` or `send`.
    """

    def __init__(
        self,
        env: simpy.Environment,
        config: Radio,
        n_drones: int,
        *,
        seed: int,
        replication: int = 0,
        frame_s: float,
        publish_spread: float = 0.8,
    ) -> None:
        if not 0.0 <= publish_spread <= 1.0:
            raise ValueError(f"publish_spread is {publish_spread!r}, must be in [0, 1]")
        self._env = env
        self._config = config
        self._n = n_drones
        self.channel = Channel(config, n_drones, seed, replication, frame_s)
        self.medium = Medium(env, n_drones, self._begin, self._end, self._group_end)
        self.counters = Counters()
        self._frame_bytes = frame_bytes(config.fragment_bytes, fragmented=True)
        self._table = rate_table(config.bandwidth_mhz, config.rician_k_db, self._frame_bytes)
        self._full_mbps = tuple(self._full_goodput(rate) for rate in RATES_MBPS[config.bandwidth_mhz])
        lowest = RATES_MBPS[config.bandwidth_mhz][0]
        probe = frames_exchanges(1, self._frame_bytes, self._frame_bytes, lowest, 1, ACK_S)
        self._probe = probe.scaled(config.retry_limit + 1.0)
        self._demands: dict[tuple[int, int, bool], Exchanges] = {}
        self._luck = SampleLuck(seed, replication)
        self._goodput = Goodput(n_drones)
        self._drained_bits = [0.0] * n_drones
        self._snr_rows: list[list[float]] = []
        self._known_rows: list[list[float]] = []
        self._gone: set[int] = set()
        self._in_flight: dict[int, _Sample] = {}
        self._latest: dict[tuple[int, int, str], _Sample] = {}
        self._numbers = 0
        self._access_streams = [stream(seed, replication, i, "access") for i in range(n_drones)]
        self._access: list[list[list[float]]] = [[] for _ in range(n_drones)]
        self._phase_s = [
            float(stream(seed, replication, i, "publish phase").random()) * publish_spread * frame_s
            for i in range(n_drones)
        ]
        self._heard_frame = [(-1, 0)] * n_drones

    # --- once a frame ----------------------------------------------------------------------------

    def advance(
        self,
        positions_m: ArrayLike,
        extra_loss_db: ArrayLike | None = None,
        jammers: Sequence[Jammer] = (),
    ) -> None:
        """Move the links on by one frame (arguments as in `Channel.advance`); samples in service feel it at once."""
        before = self._snr_rows
        self._snr_rows = self.channel.advance(positions_m, extra_loss_db, jammers).tolist()
        self._known_rows = before or self._snr_rows
        self.medium.retune()

    @property
    def snr_db(self) -> FloatArray:
        """[N, N], sender by receiver: mean SNR in this frame, dB; NaN on the diagonal."""
        return self.channel.snr_db

    # --- context ---------------------------------------------------------------------------------

    def broadcast(self, sender: int, payload_bytes: int, on_heard: Callable[[Ids], None]) -> None:
        """Put one group-addressed frame on the air: no ack, no retry, basic rate.

        Args:
            sender: who; nothing happens if it has been silenced.
            payload_bytes: 1 … 2200.
            on_heard: called once, at the frame's end, with the ids of the drones that received it, ascending
                (none if it collided).

        Raises:
            ValueError: if an argument is out of its bounds.
        """
        if not 0 <= sender < self._n:
            raise ValueError(f"sender is {sender}, must be in [0, {self._n - 1}]")
        if not 1 <= payload_bytes <= MAX_GROUP_PAYLOAD_BYTES:
            raise ValueError(f"payload_bytes is {payload_bytes}, must be in [1, {MAX_GROUP_PAYLOAD_BYTES}]")
        if sender in self._gone:
            return
        ready = self._access[sender]
        if not ready:
            ready.extend(self._access_streams[sender].random((256, 2)).tolist()[::-1])
        slot_u, residual = ready.pop()
        airtime_s = group_frame_s(payload_bytes, self._config.group_rate_mbps)
        frame = _Broadcast(sender, airtime_s, int(slot_u * (CW_CONTEXT + 1)))
        frame.mpdu_bytes = frame_bytes(payload_bytes, unicast=False)
        frame.on_heard = on_heard
        frame.residual = residual
        self.counters.broadcasts += 1
        self.counters.context_sent_bytes += payload_bytes
        phase_s = self._phase_s[sender]
        if phase_s > 0.0:
            self._env.timeout(phase_s, frame).callbacks.append(self._announce)
        else:
            self.medium.announce(frame, residual)

    def _announce(self, event: simpy.Event) -> None:
        frame = cast(_Broadcast, event.value)
        if frame.sender not in self._gone:
            self.medium.announce(frame, frame.residual)

    def _group_end(self, frame: GroupFrame, collided: bool) -> None:
        frame = cast(_Broadcast, frame)
        counters, sender = self.counters, frame.sender
        counters.context_wire_bytes += frame.mpdu_bytes
        living = self._n - 1 - len(self._gone - {sender})
        if collided:
            counters.collided += 1
            counters.missed += living
            frame.on_heard(_NOBODY)
            return
        index = self.channel.frame
        seen, times = self._heard_frame[sender]
        times = times + 1 if seen == index else 0
        self._heard_frame[sender] = (index, times)
        reach = self.channel.group_reach_bytes[sender] if times == 0 else self.channel.reach_again(sender, times)
        heard = (reach >= frame.mpdu_bytes).nonzero()[0]
        if self._gone:
            heard = heard[[int(i) not in self._gone for i in heard]]
        counters.receptions += len(heard)
        counters.missed += living - len(heard)
        frame.on_heard(heard)

    # --- data ------------------------------------------------------------------------------------

    def send(
        self,
        sender: int,
        receiver: int,
        payload_bytes: int,
        *,
        kind: str,
        reliable: bool,
        deadline_s: float,
        on_done: Callable[[Transmission], None],
    ) -> int:
        """Write one unicast sample.

        Args:
            sender, receiver: two different drones.
            payload_bytes: ≥ 1.
            kind: samples of one sender, receiver and kind replace one another.
            reliable: repair lost fragments until the deadline.
            deadline_s: from now, ≥ 0.
            on_done: called once with the sample's fate, always from the clock's loop, except that a replaced
                sample's is called from within the `send` of its successor, and that of a silenced drone's
                samples from within `silence`. Not called for what is in flight at the end.

        Returns:
            The sample's number.

        Raises:
            ValueError: if an argument is out of its bounds.
        """
        if not (0 <= sender < self._n and 0 <= receiver < self._n and sender != receiver):
            raise ValueError(f"sender is {sender} and receiver {receiver}, must be two drones in [0, {self._n - 1}]")
        if payload_bytes < 1:
            raise ValueError(f"payload_bytes is {payload_bytes}, must be at least 1")
        if not deadline_s >= 0.0:
            raise ValueError(f"deadline_s is {deadline_s!r}, must be at least 0")
        now = self._env.now
        number = self._numbers
        self._numbers = number + 1
        s = _Sample(number, sender, now + deadline_s)
        s.receiver, s.kind, s.payload_bytes, s.reliable, s.on_done = receiver, kind, payload_bytes, reliable, on_done
        s.t_sent_s, s.t_first_s, s.mark_s = now, nan, now
        s.fragments = s.left = fragments(payload_bytes, self._config.fragment_bytes)
        s.pass_bytes = sample_wire_bytes(payload_bytes, self._config.fragment_bytes)
        s.lost = s.repairs = 0
        s.luck = self._luck.next(sender, receiver)
        s.mcs, s.snr_db = -1, self._snr_rows[sender][receiver]
        s.loss_probability, s.unreachable, s.full_mbps = 1.0, "", 0.0
        s.wire_bytes, s.mark_left, s.mark_bits, s.loss_share = 0.0, 1.0, 0.0, 0.0
        s.drained_bits = self._drained(sender)
        self._in_flight[number] = s
        self.counters.data_sent_bytes += payload_bytes
        if sender in self._gone:
            s.live = False
            self._env.timeout(0.0, s).callbacks.append(self._refuse)
            return number
        key = (sender, receiver, kind)
        old = self._latest.get(key)
        self._latest[key] = s
        if old is None:
            self.medium.submit(s)
        elif old.live:
            served = self.medium.in_service(sender) is old
            self.medium.replace(old, s)
            self._measure(old, served)
            self._close(old, Status.EXPIRED, "replaced")
        else:  # it waits for its repair, outside the medium
            self.medium.submit(s)
            self._close(old, Status.EXPIRED, "replaced")
        return number

    def silence(self, drone: int) -> None:
        """A drone is lost or has landed: its queue is dropped, and nothing reaches it from now on.

        Nobody tells the others. Their MAC tries a first frame in vain and gives each sample up (`receiver_gone`).
        """
        if drone in self._gone:
            return
        self._gone.add(drone)
        self.medium.drop_context(drone)
        for s in [s for s in self._in_flight.values() if s.sender == drone]:
            if s.number in self._in_flight:  # no earlier one's callback has settled it
                if s.live:
                    self.medium.withdraw(s)
                self._close(s, Status.LOST, "sender_gone")
        self.medium.retune()

    def _refuse(self, event: simpy.Event) -> None:
        s = cast(_Sample, event.value)
        if s.number in self._in_flight:
            self._close(s, Status.LOST, "sender_gone")

    def _begin(self, job: Job) -> None:
        """A sample comes to the head of its queue, or its link has changed while it is there."""
        s = cast(_Sample, job)
        now = self._env.now
        self._book(s)
        fresh = s.t_start_s == now
        if isnan(s.t_first_s):
            s.t_first_s = now
        s.snr_db = snr_db = self._snr_rows[s.sender][s.receiver]
        mcs = self._table.mcs[self._table.index(self._known_rows[s.sender][s.receiver])]
        reason = "receiver_gone" if s.receiver in self._gone else "no_link" if mcs < 0 else ""
        if fresh or (-1 if reason else mcs) != s.mcs:
            s.mark_s, s.mark_bits = now, 0.0
        if reason:
            if fresh or not s.unreachable:
                self._restart(s)
                s.demand(self._probe)
                s.full_mbps = 0.0
            s.unreachable, s.mcs = reason, -1
            return
        if s.unreachable:
            s.unreachable = ""
            self._restart(s)
        s.mcs = mcs
        limit = self._config.retry_limit
        payload = s.payload_bytes if s.left == s.fragments else self._repair_payload(s)
        per = self._table.all_per[mcs][self._table.index(snr_db)]
        if s.fragments == 1:
            per = rescale(per, frame_bytes(payload) / self._frame_bytes)
        mean_tries = tries(per, limit)
        s.loss_probability = residual_loss(per, limit)
        s.full_mbps = self._full_mbps[mcs] / mean_tries * (1.0 - s.loss_probability)
        key = (payload, mcs, s.reliable)
        demand = self._demands.get(key)
        if demand is None:
            if len(self._demands) > 20_000:
                self._demands.clear()
            demand = self._demands[key] = self._demand(payload, mcs, s.reliable)
        s.demand(demand, mean_tries)

    def _demand(self, payload_bytes: int, mcs: int, reliable: bool) -> Exchanges:
        c = self._config
        rate = RATES_MBPS[c.bandwidth_mhz][mcs]
        demand = sample_exchanges(payload_bytes, c.fragment_bytes, rate, c.max_ampdu_frames)
        if reliable:  # heartbeat and ACKNACK, each an exchange of its own
            length = repair_wire_bytes(1) // 2
            demand = demand + frames_exchanges(1, length, length, rate, 1, ACK_S).scaled(2.0)
        return demand

    def _full_goodput(self, rate_mbps: float) -> float:
        """Payload Mb/s of full A-MPDUs without loss, alone on the channel."""
        c = self._config
        m = ampdu_frames(self._frame_bytes, rate_mbps, c.max_ampdu_frames)
        exchanges = frames_exchanges(m, self._frame_bytes, self._frame_bytes, rate_mbps, c.max_ampdu_frames)
        return m * c.fragment_bytes * 8e-6 / exchanges.channel_s(contention(1))

    def _end(self, job: Job, how: End) -> None:
        """The medium is through with a sample's pass, or its deadline has passed."""
        s = cast(_Sample, job)
        self._measure(s, how is not End.DEADLINE_QUEUED)
        if how is not End.SERVED:
            queued = how is End.DEADLINE_QUEUED and s.repairs == 0
            if queued:
                s.t_first_s = nan
            self._close(s, Status.EXPIRED, "deadline_queued" if queued else "deadline_in_service")
            return
        if s.unreachable:
            self._close(s, Status.LOST, s.unreachable)
            return
        if s.reliable:
            s.wire_bytes += repair_wire_bytes(s.left)
        lost = losses(self._round_luck(s), s.left, s.loss_share)
        s.lost += lost
        if lost == 0:
            self._close(s, Status.DELIVERED, "")
        elif not s.reliable:
            self._close(s, Status.LOST, "fragment_lost")
        else:
            s.left = lost
            wait_s = self._config.heartbeat_s + self._config.nack_delay_s
            wait_s = max(0.0, min(wait_s, s.deadline_s - self._env.now))
            self._env.timeout(wait_s, s).callbacks.append(self._repair)

    @staticmethod
    def _round_luck(s: _Sample) -> float:
        extra = s.repairs - len(s.luck) + 1
        return s.luck[s.repairs] if extra <= 0 else (s.luck[-1] + extra * _GOLDEN) % 1.0

    def _repair(self, event: simpy.Event) -> None:
        s = cast(_Sample, event.value)
        if s.number not in self._in_flight:
            return  # replaced or silenced meanwhile
        if self._env.now >= s.deadline_s - 1e-12:
            self._close(s, Status.EXPIRED, "deadline_in_service")
            return
        s.repairs += 1
        self._restart(s)
        s.pass_bytes = self._repair_payload(s) + s.left * frame_bytes(0, fragmented=s.fragments > 1)
        s.live = True
        self.medium.submit(s)

    @staticmethod
    def _restart(s: _Sample) -> None:
        s.remaining = s.mark_left = 1.0
        s.loss_share = 0.0

    def _repair_payload(self, s: _Sample) -> int:
        return min(s.payload_bytes, s.left * self._config.fragment_bytes)

    def _close(self, s: _Sample, status: Status, reason: str) -> None:
        del self._in_flight[s.number]
        key = (s.sender, s.receiver, s.kind)
        if self._latest.get(key) is s:
            del self._latest[key]
        row = self._row(s, status, reason, self._env.now)
        c = self.counters
        c.data_wire_bytes += row.wire_bytes
        if status is Status.DELIVERED:
            c.data_delivered_bytes += s.payload_bytes
        elif status is Status.LOST:
            c.data_lost_bytes += s.payload_bytes
        else:
            c.data_expired_bytes += s.payload_bytes
        s.on_done(row)

    @staticmethod
    def _row(s: _Sample, status: Status, reason: str, t_done_s: float) -> Transmission:
        return Transmission(
            s.number, s.sender, s.receiver, s.kind, s.payload_bytes, round(s.wire_bytes), s.t_sent_s, s.deadline_s,
            s.t_first_s, t_done_s, status, reason, s.fragments, s.lost, s.repairs, s.mcs, s.snr_db, s.granted_s,
        )  # fmt: skip

    # --- what senders know -----------------------------------------------------------------------

    def goodput_mbps(self, sender: int) -> tuple[float, ...]:
        """Goodput to every other drone, ascending by id, as the sender measured it; see `radio.goodput`.

        Samples that are still in service or queued lower it already by how little has got through so far.
        """
        known = self._goodput.read(sender)
        if self.medium.in_service(sender) is not None:
            drained = self._drained(sender)
            now = self._env.now
            for job in self.medium.queued(sender):
                s = cast(_Sample, job)
                if job is self.medium.in_service(sender) and now - s.mark_s >= _WINDOW_S:
                    since, bits = s.mark_s, s.mark_bits
                else:
                    since, bits = s.t_sent_s, drained - s.drained_bits
                if now - since >= _WINDOW_S:
                    known[s.receiver] = min(known[s.receiver], bits / (now - since) * 1e-6)
        del known[sender]
        return tuple(known)

    def _book(self, s: _Sample) -> None:
        """Count what was acknowledged since the last time."""
        done = s.mark_left - s.remaining
        if done > 0.0:
            bits = done * s.alone_s * s.full_mbps * 1e6
            s.mark_bits += bits
            self._drained_bits[s.sender] += bits
            s.wire_bytes += done * s.pass_bytes if not s.unreachable else 0.0
            s.loss_share += done * s.loss_probability
            s.mark_left = s.remaining

    def _drained(self, sender: int) -> float:
        """What the sender has got through so far, bits as goodput counts them."""
        head = self.medium.in_service(sender)
        if head is not None:
            self.medium.sync()
            self._book(cast(_Sample, head))
        return self._drained_bits[sender]

    def _measure(self, s: _Sample, served: bool) -> None:
        """Learn from a sample whose service, or whose wait for it, is over."""
        now = self._env.now
        if not served:
            waited = now - s.t_sent_s
            if s.repairs == 0 and waited >= _WINDOW_S:
                rate = (self._drained(s.sender) - s.drained_bits) / waited * 1e-6
                self._goodput.bounded(s.sender, s.receiver, rate)
            return
        self._book(s)
        window = now - s.mark_s
        if window >= _WINDOW_S or (window > 0.0 and s.mark_s == s.t_start_s):
            self._goodput.measured(s.sender, s.receiver, s.mark_bits / window * 1e-6)

    # --- accounts --------------------------------------------------------------------------------

    @property
    def airtime_s(self) -> list[float]:
        """Seconds each drone has transmitted so far: data with retries and collisions, and context frames."""
        self.medium.sync()
        return self.medium.transmit_s

    @property
    def utilisation(self) -> float:
        """Fraction of the time so far in which the channel was claimed."""
        return self.medium.utilisation

    @property
    def data_in_flight_bytes(self) -> int:
        """Payload of the samples whose fate is open."""
        return sum(s.payload_bytes for s in self._in_flight.values())

    def finish(self) -> list[Transmission]:
        """What is still in flight at the end, by number; call it once, when the clock has stopped."""
        self.medium.sync()
        for s in self._in_flight.values():
            self._book(s)
        return [self._row(s, Status.IN_FLIGHT, "", nan) for _, s in sorted(self._in_flight.items())]


_NOBODY: Ids = np.empty(0, dtype=np.intp)
