"""The air between the drones: broadcasts, unicast samples, silenced drones, and the outcome of each sample.

`Air` puts the parts together: `channel` says how good each link is in this frame, `rates` which MCS that
allows (the sender knows the SNR of the frame before, so a sudden drop costs it a frame), `airtime` how much of the `medium` a sample then needs, and `goodput` what the sender learns of it.

Transport. *Best effort*: a sample with one lost fragment is lost. *Reliable, keep-last-1*: the writer's
heartbeat and the reader's NACK bring lost fragments back, `heartbeat_s + nack_delay_s` after the pass in
which they were lost, until all are through or the deadline passes. A sample of *pieces* is of use in part: what of it
came, also by a deadline that cut it short, is `partial`. In all, a newer sample of the same
sender, receiver and kind replaces an older one that is not through (history depth 1).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise, repeat
from math import nan
from typing import Final, cast

import numpy as np
import simpy
from numpy.typing import ArrayLike, NDArray

from sortie.radio.channel.earshot import LinkList
from sortie.radio.channel.flight import Flight, flight_of
from sortie.radio.channel.snr import SQUARE, Channel, FloatArray, Jammer, linear
from sortie.radio.channel.traces import read_links
from sortie.radio.counters import Counters
from sortie.radio.goodput import Goodput
from sortie.radio.mac.airtime import fragments, repair_wire_bytes
from sortie.radio.mac.broadcasts import Broadcast, Broadcasts, OnHeard
from sortie.radio.mac.jobs import End
from sortie.radio.mac.medium import Medium
from sortie.radio.overrides import Overrides
from sortie.radio.relay import Routes
from sortie.radio.sample import UNUSED, Sample, Service, UseNow
from sortie.radio.settings import AirSettings
from sortie.radio.transmission import Status, Transmission
from sortie.scenarios.link_state import SILENT_MBPS, WAITING_MBPS
from sortie.scenarios.plain_sum import plain_sum

# an enumeration's member costs a quarter of a microsecond to look up, and each sample needs some ten look-ups
_DEADLINE_QUEUED: Final = End.DEADLINE_QUEUED
_DEADLINE_IN_SERVICE: Final = End.DEADLINE_IN_SERVICE
_UNREACHABLE: Final = End.UNREACHABLE
_DELIVERED: Final = Status.DELIVERED
_LOST: Final = Status.LOST
_EXPIRED: Final = Status.EXPIRED
HEARD_DB = 40.0
"""SNR with which a link that is traced by its loss or goodput is heard, and its answers."""
_WINDOW_S: Final = 1e-3
"""A goodput measurement that is still going on counts once it is this old."""


class Air:
    """The channel that a fleet shares: takes bytes and positions, returns what happened to each sample.

    Args:
        env: the clock; on an `EventLoop` (`sortie.radio.event_loop`) it is fastest.
        settings: see `sortie.radio.settings.AirSettings`.
        positions_m: [T, N, 3], ENU: where each drone will be in each frame; ids are 0 … N − 1.
        seed, replication: as in `sortie.scenarios.streams.stream`.
        frame_s: time between two calls of `advance`.
        publish_spread: the drones' clocks are not in step, so a drone's broadcasts reach its radio a fixed time
            after the call, drawn once per drone, uniform in [0, publish_spread · frame_s). 0 hands them over at
            once: then drones that call at the same instant contend, and collide in 1 of 16 pairings.
        up: [T, N, 3], ENU: the unit vector along each airframe's z axis, for the antennas; None is level flight.

    `advance` must be called before the first `broadcast` or `send`.

    Example, two drones 20 m apart for ten frames:

    >>> import numpy as np, simpy
    >>> from sortie.radio import Air, AirSettings
    >>> env = simpy.Environment()
    >>> positions_m = np.broadcast_to([[0.0, 0.0, 60.0], [20.0, 0.0, 60.0]], (10, 2, 3))
    >>> air = Air(env, AirSettings(bandwidth_mhz=20), positions_m, seed=1, frame_s=0.1)
    >>> air.advance()
    >>> rows = []
    >>> number = air.send(0, 1, 13_120, kind="features", reliable=False, deadline_s=0.065, on_done=rows.append)
    >>> env.run(until=0.1)
    >>> rows[0].status.name
    'DELIVERED'
    """

    def __init__(
        self,
        env: simpy.Environment,
        settings: AirSettings,
        positions_m: ArrayLike | Flight,
        *,
        seed: int,
        frame_s: float,
        replication: int = 0,
        publish_spread: float = 0.8,
        up: ArrayLike | None = None,
    ) -> None:
        if not 0.0 <= publish_spread <= 1.0:
            raise ValueError(f"publish_spread is {publish_spread!r}, must be in [0, 1]")
        self._env = env
        self._settings = settings
        flight = flight_of(positions_m, up)
        trace = None if settings.trace is None else read_links(settings.trace, flight.drones)
        traced = set() if trace is None else {(min(link), max(link)) for link in trace.links}
        self.channel = Channel(settings, flight, seed, replication, frame_s, always=sorted(traced))
        self._n = n_drones = self.channel.n
        self.counters = Counters()
        self._gone: set[int] = set()
        self._overrides: Overrides | None = None
        if Overrides.wanted(settings):
            self._overrides = Overrides(settings, trace, n_drones, seed=seed, replication=replication, frame_s=frame_s)
        self._broadcasts = Broadcasts(
            settings.group_rate_mbps,
            n_drones,
            self.counters,
            self._gone,
            seed=seed,
            replication=replication,
            frame_s=frame_s,
            publish_spread=publish_spread,
            as_lists=n_drones <= SQUARE,
        )
        self._service = Service(settings, self.channel.noise_dbm)
        self.medium = Medium[Sample, Broadcast](
            env,
            settings,
            n_drones,
            seed,
            replication,
            self.channel.noise_dbm,
            self._service.begin,
            self._end,
            self._broadcasts.end,
        )
        self._links: LinkList | None = None
        self._link_lists: tuple[NDArray[np.int64], NDArray[np.int64]]
        self._uses: dict[tuple[int, int], UseNow] = {}  # of links with unicast traffic
        self._uses_since = 0  # earlier ones are out of date
        self._rows_db: tuple[list[list[float]], list[list[float]]] | None = None  # of this frame, made at first use
        self._goodput = Goodput(n_drones)
        self._drained_bits = [0.0] * n_drones
        self._in_flight: dict[int, Sample] = {}
        self._latest: dict[tuple[int, int, int, str], Sample] = {}
        self._routes = Routes(settings.relay_max_hops) if settings.relay_max_hops > 1 else None
        self._numbers = 0

    # --- once a frame ----------------------------------------------------------------------------

    def advance(self, extra_loss_db: ArrayLike | None = None, jammers: Sequence[Jammer] = ()) -> None:
        """Move the links on by one frame (arguments as in `Channel.advance`); samples in service feel it at once."""
        self.channel.advance(extra_loss_db, jammers)
        self._rows_db = None
        if self._overrides is not None:
            self._overrides.advance(extra_loss_db, self.channel.noise_rise_db(jammers) if jammers else None)
        if self._routes is not None:
            self._routes.renew(self.link_mbps())
        self._book_all()  # what has arrived so far went over the links as they were
        self._retune()
        self._set_links()

    def _set_links(self) -> None:
        """Tell the medium how strong everybody is at everybody else."""
        links, given = self.channel.links, self._overrides
        if links is not self._links:
            self._links = links
            begin = np.asarray(links.begin, np.int64)
            self._link_lists = begin, np.ascontiguousarray(links.receiver, np.int64)
        extra = None
        if given is None:
            gain = self.channel.now.gain
        else:
            sender, receiver = links.sender, links.receiver
            square_db, traced, loss = given.snr_db(self.channel.snr_db), given.traced, given.group_loss()
            answers = traced.T & ~traced  # the way back of a traced link carries answers, and descriptors by its SNR
            loss[answers & (square_db < self._service.least_snr_db)] = 1.0
            gain = linear(np.where(traced | answers, HEARD_DB, square_db)[sender, receiver])
            extra = loss[sender, receiver]
        self.medium.set_links(*self._link_lists, gain, frame=self.channel.frame, extra=extra)

    def _retune(self) -> None:
        """The links, or who is there, have changed: find out anew how those with traffic are used."""
        self._uses_since += 1
        for queue in self.medium.queues():
            for s in queue:
                s.use = self._use(s.sender, s.receiver)
            self._service.begin(queue[0], self._env.now, fresh=False)

    def _use(self, sender: int, receiver: int) -> UseNow:
        """How a link is used in this frame."""
        ends = sender, receiver
        found = self._uses.get(ends)
        if found is None or found[3] != self._uses_since:
            now_s, medium = self._env.now, self.medium
            flow = medium.flow(sender, receiver) if found is None else found[0]
            minstrel = self._service.minstrel
            if minstrel is not None:
                minstrel.sent(sender, receiver, now_s, medium.learned(flow).tolist())
            given = None if self._overrides is None else self._overrides.link(sender, receiver)
            known_db, snr_db = self._snr_of(sender, receiver)
            use = self._service.use(sender, receiver, now_s, known_db, receiver in self._gone, given)
            medium.tune(flow, use.link)
            found = self._uses[ends] = flow, use, snr_db, self._uses_since
        return found

    def reroute(self, positions_m: ArrayLike | Flight, up: ArrayLike | None = None) -> None:
        """From the next frame on the fleet flies another way (see `Channel.reroute`)."""
        self.channel.reroute(positions_m, up)

    def link_mbps(self) -> FloatArray:
        """[N, N]: payload rate of each link alone on the channel as senders know it, from the frame before; 0: no link.

        Silenced drones have none: their neighbours hear that they are gone.
        """
        known_db, given = self.channel.before.square_db, self._overrides
        if given is None:
            mbps = self._service.link_mbps(known_db)
        else:
            mbps = given.mbps(self._service.link_mbps(given.known_snr_db(known_db), given.loss))
        gone = sorted(self._gone)
        mbps[gone], mbps[:, gone] = 0.0, 0.0
        return mbps

    @property
    def snr_db(self) -> FloatArray:
        """[N, N], sender by receiver: mean SNR in this frame, dB; NaN on the diagonal."""
        snr_db = self.channel.snr_db
        return snr_db if self._overrides is None else self._overrides.snr_db(snr_db)

    def in_earshot(self) -> NDArray[np.bool_]:
        """[N, N]: links of which the receiver hears a frame's begin in this frame."""
        return self.usable(self._service.least_snr_db)

    def usable(self, least_snr_db: float) -> NDArray[np.bool_]:
        """[N, N]: links of at least this mean SNR in this frame; of those with a traced loss or goodput, the ones that
        carry anything."""
        usable = self.snr_db >= least_snr_db
        if self._overrides is not None and (traced := self._overrides.traced).any():
            usable = np.where(traced, self.link_mbps() > 0.0, usable)
        return usable

    # --- context ---------------------------------------------------------------------------------

    def broadcast(self, sender: int, payload_bytes: int, on_heard: OnHeard, in_s: float | None = None) -> None:
        """Put one group-addressed frame on the air: no ack, no retry, basic rate.

        Args:
            sender: who; nothing happens if it has been silenced.
            payload_bytes: 1 … 2200.
            on_heard: called once, at the frame's end, with the ids of the drones that received it, ascending
                (none if it collided).
            in_s: time until it reaches the radio, ≥ 0; None is the drone's own phase (see `publish_spread`).

        Raises:
            ValueError: if an argument is out of its bounds.
        """
        if sender in self._gone:
            return
        if in_s is not None and not in_s >= 0.0:
            raise ValueError(f"in_s is {in_s!r}, must be at least 0")
        frame = self._broadcasts.frame(sender, payload_bytes, on_heard)
        self.medium.announce(frame, self._broadcasts.phase_s[sender] if in_s is None else in_s)

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
        piece_bytes: int | None = None,
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
            piece_bytes: the sample is made of pieces of so many bytes (the last may be shorter), most important first,
                each a fragment of its own and of use without the others; None: it is of use as a whole only.

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
        if piece_bytes is not None and piece_bytes < 1:
            raise ValueError(f"piece_bytes is {piece_bytes}, must be at least 1")
        now = self._env.now
        number = self._numbers
        self._numbers = number + 1
        hop = receiver if self._routes is None else self._routes.next_hop(sender, receiver, self._routes.max_hops)
        drained_bits, gone = self._drained(sender, now), sender in self._gone
        use = (-1, UNUSED, self._snr_of(sender, hop)[1], -1) if gone else self._use(sender, hop)
        s = self._in_flight[number] = Sample(
            number,
            sender,
            receiver,
            kind,
            payload_bytes,
            reliable,
            now,
            now + deadline_s,
            on_done,
            fragments(payload_bytes, piece_bytes or self._settings.fragment_bytes),
            use,
            drained_bits,
            piece_bytes or 0,
        )
        s.receiver = hop
        self.counters.data_sent_bytes += payload_bytes
        if gone:
            s.live = False
            self._env.timeout(0.0, s).callbacks.append(self._refuse)
        else:
            self._queue(s)
        return number

    def _queue(self, s: Sample) -> None:
        """Hand a sample to its sender's queue; there the newest of its kind stands for an older one."""
        self._service.prepare(s)
        old = self._latest.get(s.key)
        if old is not None and old.number > s.number:  # it came over a longer way
            self._close(s, _EXPIRED, "replaced", self._env.now)
            return
        self._latest[s.key] = s
        if old is None:
            self.medium.submit(s)
        elif old.live:
            served = self.medium.in_service(s.sender) is old
            self._book(old)
            self.medium.replace(old, s)
            self._measure(old, served, self._env.now)
            self._close(old, _EXPIRED, "replaced", self._env.now)
        else:  # it waits for its repair, outside the medium
            self.medium.submit(s)
            self._close(old, _EXPIRED, "replaced", self._env.now)

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
                self._close(s, _LOST, "sender_gone", self._env.now)
        self._others_changed()

    def wake(self, drone: int) -> None:
        """A silenced drone is back: it sends and hears again."""
        self._gone.discard(drone)
        self._others_changed()

    def _others_changed(self) -> None:
        if self.channel.frame >= 0:
            self.medium.sync()
            self._book_all()  # what has been sent so far went to who was there
            self._retune()
            self.medium.replan()

    def _refuse(self, event: simpy.Event) -> None:
        s = cast(Sample, event.value)
        if s.number in self._in_flight:
            self._close(s, _LOST, "sender_gone", self._env.now)

    def _snr_of(self, sender: int, receiver: int) -> tuple[float, float]:
        """Mean SNR of a link as its sender knows it, from the frame before, and as it is."""
        rows = self._rows_db
        if rows is None:
            rows = self._rows_db = self.channel.before.rows_db, self.channel.now.rows_db
        known_db, now_db = rows[0][sender][receiver], rows[1][sender][receiver]
        if self._overrides is None:
            return known_db, now_db
        return self._overrides.snr_of(sender, receiver, known_db, now_db)

    def _end(self, s: Sample, how: End, now_s: float) -> None:
        """The medium is through with a sample's pass, or its deadline has passed."""
        self._measure(s, how is not _DEADLINE_QUEUED, now_s)
        if how is _DEADLINE_QUEUED or how is _DEADLINE_IN_SERVICE:
            queued = how is _DEADLINE_QUEUED and s.repairs == s.repairs_before
            if queued and s.hops == 1:  # it may have come to the head at this very instant
                s.t_first_s = nan
            self._close(s, _EXPIRED, "deadline_queued" if queued else "deadline_in_service", now_s)
            return
        if how is _UNREACHABLE:
            self._close(s, _LOST, s.unreachable or "no_link", now_s)
            return
        if s.reliable:
            s.wire_bytes += repair_wire_bytes(s.left)
        lost = s.end_pass()
        if lost and s.reliable:
            s.left = lost
            wait_s = self._settings.heartbeat_s + self._settings.nack_delay_s
            wait_s = max(0.0, min(wait_s, s.deadline_s - now_s))
            self._env.timeout(wait_s, s).callbacks.append(self._repair)
        elif s.receiver != s.target and (lost == 0 or any(map(len, s.arrived))):
            self._forward(s, now_s)
        elif lost == 0 and s.is_whole():
            self._close(s, _DELIVERED, "", now_s)
        else:
            self._close(s, _LOST, "fragment_lost", now_s)

    def _forward(self, s: Sample, now_s: float) -> None:
        """A relay has it: on to the next hop, as the links are now."""
        assert self._routes is not None  # noqa: S101 (nothing else sends it to another than its target)
        self._forget(s)
        here = s.receiver
        hop = self._routes.next_hop(here, s.target, self._routes.max_hops - s.hops)
        s.forward(here, hop, now_s, self._drained(here, now_s))
        s.use = self._use(here, hop)
        s.flow = s.use[0]
        self._queue(s)

    def _forget(self, s: Sample) -> None:
        if self._latest.get(s.key) is s:
            del self._latest[s.key]

    def _repair(self, event: simpy.Event) -> None:
        s = cast(Sample, event.value)
        if s.number not in self._in_flight:
            return  # replaced or silenced meanwhile
        if self._env.now >= s.deadline_s - 1e-12:
            self._close(s, _EXPIRED, "deadline_in_service", self._env.now)
            return
        s.repairs += 1
        s.use = self._use(s.sender, s.receiver)
        self._service.prepare(s)
        self.medium.submit(s)

    def _close(self, s: Sample, status: Status, reason: str, now_s: float) -> None:
        del self._in_flight[s.number]
        self._forget(s)
        if s.pieces is not None and s.arrived_frames:  # cut short: its first pieces are there
            s.end_pass()
        row = s.row_of(status, reason, now_s)
        c = self.counters
        c.data_wire_bytes += row.wire_bytes
        c.data_delivered_bytes += row.arrived_bytes
        rest_bytes = s.payload_bytes - row.arrived_bytes
        if status is _LOST:
            c.data_lost_bytes += rest_bytes
        elif status is _EXPIRED:
            c.data_expired_bytes += rest_bytes
        s.on_done(row)

    # --- what senders know -----------------------------------------------------------------------

    def goodput_mbps(self, sender: int, to: Sequence[int] | None = None) -> tuple[float, ...]:
        """Goodput to some drones, as the sender measured it; see `sortie.radio.goodput`.

        Args: `to`: the drones; None for every other one, by ascending id.

        0 to a drone to which nothing was measured in the last `MEASURED_FOR_S`; at least `SILENT_MBPS` to any other.
        Samples that are still in service or queued lower it already by how little has got through so far. Where a
        payload would go over others, it is the goodput of its hops in sequence.
        """
        known = self._known_mbps(sender)
        targets = (*range(sender), *range(sender + 1, self._n)) if to is None else to
        if self._routes is not None:
            rows: dict[int, dict[int, float]] = {sender: known.copy()}
            for target in targets:
                path = self._routes.path(sender, target)
                if len(path) > 2:
                    hops = [rows.setdefault(a, self._known_mbps(a)).get(b, 0.0) for a, b in pairwise(path)]
                    known[target] = 1.0 / plain_sum(1.0 / mbps for mbps in hops) if min(hops) > 0.0 else 0.0
        if not known:
            return (0.0,) * len(targets)
        return tuple(map(known.get, targets, repeat(0.0)))

    def _known_mbps(self, sender: int) -> dict[int, float]:
        """Goodput over the direct link, by receiver, where something was measured lately."""
        known = self._goodput.read(sender, self._env.now)
        head = self.medium.in_service(sender)
        if head is not None:
            self._book(head)
            drained, now = self._drained_bits[sender], self._env.now
            for s in self.medium.queued(sender):
                if s is head and now - s.mark_s >= _WINDOW_S:
                    since, bits = s.mark_s, s.mark_bits
                else:
                    since, bits = s.t_queued_s, drained - s.drained_bits
                if now - since >= _WINDOW_S and s.receiver in known:
                    least_mbps = SILENT_MBPS if s is head else WAITING_MBPS
                    known[s.receiver] = min(known[s.receiver], max(bits / (now - since) * 1e-6, least_mbps))
        return known

    def _book(self, s: Sample) -> None:
        """Count what was acknowledged since the last time."""
        done = s.arrived_frames - s.mark_frames
        if done > 0:
            s.mark_frames = s.arrived_frames
            bits = done * self._service.bits_of_a_frame(s)
            s.mark_bits += bits
            self._drained_bits[s.sender] += bits

    def _book_all(self) -> None:
        for head in self.medium.heads():
            self._book(head)

    def _drained(self, sender: int, now_s: float) -> float:
        """What the sender has got through so far, bits as goodput counts them."""
        queue = self.medium.queued(sender)
        if queue:
            head = queue[0]
            if self._service.minstrel is not None:  # what it learns is read next
                self.medium.sync()
            if head.begun_s < now_s:  # else it cannot have got through anything
                self.medium.sync()
                self.medium.read(head)
                self._book(head)
        return self._drained_bits[sender]

    def _measure(self, s: Sample, served: bool, now_s: float) -> None:
        """Learn from a sample whose service, or whose wait for it, is over."""
        if served:
            self._book(s)
            window = now_s - s.mark_s
            if window >= _WINDOW_S or (window > 0.0 and s.mark_s == s.begun_s):
                mbps = s.mark_bits / window * 1e-6
                if mbps > s.full_mbps:  # a lone frame is acknowledged later than it arrives
                    mbps = s.full_mbps
                self._goodput.measured(s.sender, s.receiver, mbps, now_s)
        else:
            waited = now_s - s.t_queued_s
            if s.repairs == s.repairs_before and waited >= _WINDOW_S:
                rate = (self._drained(s.sender, now_s) - s.drained_bits) / waited * 1e-6
                self._goodput.bounded(s.sender, s.receiver, rate)

    # --- accounts --------------------------------------------------------------------------------

    @property
    def airtime_s(self) -> list[float]:
        """Seconds each drone has transmitted so far: data with retries and collisions, answers, and context frames."""
        return self.medium.transmit_s

    @property
    def utilisation(self) -> float:
        """Fraction of the time so far in which something was on the air."""
        return self.medium.utilisation

    @property
    def data_in_flight_bytes(self) -> int:
        """Payload of the samples whose fate is open."""
        return sum(s.payload_bytes for s in self._in_flight.values())

    def finish(self) -> list[Transmission]:
        """What is still in flight at the end, by number; call it once, when the clock has stopped."""
        self._book_all()
        return [s.row_of(Status.IN_FLIGHT, "", nan) for _, s in sorted(self._in_flight.items())]
