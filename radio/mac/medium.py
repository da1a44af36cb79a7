"""The shared medium on the SimPy clock: exchange by exchange as 802.11's EDCA, without an event for each exchange.

`sortie.radio.mac.edca` simulates the stations. This file brings it onto the clock. It keeps two copies of the stations'
state. The *settled* one is at the last moment at which something came from outside: a job, a withdrawal, a change of the
links. From it the *planned* one is run ahead to the next moment at which somebody outside must hear something: a sample
is through or given up, a group frame is over, a deadline passes. One timer is set there, and when it fires the plan
becomes the settled state. If something comes from outside earlier, the plan is thrown away. The random numbers are
counted by station, so what is run again draws the same, and the result does not depend on how often that happens.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import cache
from heapq import heappop, heappush
from math import inf, nan
from struct import Struct
from typing import Any, Final, Generic, NamedTuple, TypeVar

import numpy as np
import simpy
from numpy.typing import NDArray
from simpy.events import NORMAL, EventPriority

from sortie.radio.channel.draws import fade_table
from sortie.radio.event_loop import EventLoop
from sortie.radio.mac.airtime import CONTROL_MBPS, ampdu_frames, frame_bytes
from sortie.radio.mac.jobs import NONE_DROPPED, AirJob, End, GroupFrame
from sortie.radio.rates import CURVES, LEGACY_CURVES, STANDARDS, group_curve
from sortie.radio.settings import AirSettings, EdcaSettings
from sortie.scenarios.plain_sum import plain_sum
from sortie.scenarios.streams import stream

J = TypeVar("J", bound=AirJob)
F = TypeVar("F", bound=GroupFrame)
IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]

PREAMBLE_SINR_DB = 4.0
"""Below this ratio of signal to interference and noise, a preamble is not detected."""
ENERGY_OVER_PREAMBLE_DB = 20.0
"""A frame of which a station has missed the begin is sensed by its energy, if it is so much above the weakest preamble."""
FAINT_DB = 3.0
"""A link is faint if its highest fade stays so far below the weakest preamble."""
_NS: Final = 1e-9
_AHEAD_NS: Final = 100_000_000
"""A plan goes no further than this; frames of the flight change the links as often."""
_LAST: Final = EventPriority(2)
"""After everything else of the same instant."""


@cache
def _edca() -> Any:
    """The compiled stations, imported at their first use: numba takes half a second."""
    from sortie.radio.mac import edca

    return edca


class Link(NamedTuple):
    """How a sender uses a link to one receiver at present."""

    mcs: int
    dead: bool = False
    """Whether nobody is there to answer."""
    rate_mbps: float = 0.0
    """In place of the MCS's, with `frames` in an A-MPDU; 0 is the MCS's own."""
    frames: int = 0
    loss: float = nan
    """Probability that a try is lost, in place of the packet error rate."""
    burst_loss: float = 0.0
    """Probability that a try is lost besides the packet error rate."""


def _addresses(arrays: tuple[NDArray[Any], ...]) -> list[int]:
    """Where arrays begin; addresses know no strides."""
    assert all(each.flags.c_contiguous for each in arrays)  # noqa: S101
    return [each.ctypes.data for each in arrays]


class _State:
    """Everything about the stations that a run changes, in arrays; `now_ns` is how far they have been run.

    `rows`, `drops` and `fates` are the numbers of three of the arrays, one after another: few numbers are read faster this way.
    """

    __slots__ = ("addresses", "arrays", "drops", "entered", "fates", "jobs", "now_ns", "rows", "table")

    def __init__(self, arrays: tuple[NDArray[Any], ...], jobs: int, now_ns: int, entered: int = -1) -> None:
        self.arrays, self.jobs, self.now_ns = arrays, jobs, now_ns
        self.addresses = _addresses(arrays)
        self.entered = entered
        """Row of the latest job that the stations have yet to take in (see `edca.enter`); −1 is none."""
        self.rows, self.drops, self.fates = (memoryview(arrays[k].reshape(-1).data) for k in (_J, _DROPS, _WHY))
        self.table: IntArray | None = None
        """Sizes and addresses for `edca.ahead`; None when one of the arrays has become another."""

    def open(
        self,
        row: int,
        kind: int,
        station: int,
        flow: int,
        frames: tuple[int, int, int],
        access: int,
        at_ns: int,
        air_ns: int,
    ) -> None:
        """Write a new job's row, which names the one that entered before it; it is due at its station at `at_ns`.

        Args: `frames`: how many, the bytes of each, and of the last one.
        """
        count, full_bytes, last_bytes = frames
        _write_row(
            self.rows,
            row * _ROW_BYTES,
            kind,
            station,
            flow,
            self.entered,
            count,
            full_bytes,
            last_bytes,
            0,
            1,
            access,
            at_ns,
            0,
            0,
            0,
            0,
            0,
            0,
            air_ns,
            -1,
        )

    def copy(self) -> _State:
        """Another one that is equal."""
        return _State(tuple(a.copy() for a in self.arrays), self.jobs, self.now_ns)


_S, _N, _P, _W, _WHY, _G, _J, _M, _T, _SEG_AT, _SEG, _LS, _DROPS = range(13)
_JOBS, _FLOWS = 64, 32
_DROPS_KEPT = 512
"""Given up fragments that a run keeps before they must be read, at the least."""


class Medium(Generic[J, F]):
    """The air between stations that hear one another as far as the links allow.

    Args:
        env: the clock.
        settings: see `sortie.radio.settings.AirSettings`.
        n_drones: stations are 0 … n_drones − 1.
        seed, replication: as in `sortie.scenarios.streams.stream`.
        noise_dbm: of the whole channel.
        on_begin: called with a job and the time when it comes to the head of its sender's queue.
        on_end: called with a job, how it ended and the time, after the medium has moved on.
        on_group_end: called at a group frame's end with the frame, the ids of those within its reach and what became of
            it at each (`edca.HEARD` or a cause).

    `set_links` must be called before the first job.
    """

    def __init__(
        self,
        env: simpy.Environment,
        settings: AirSettings,
        n_drones: int,
        seed: int,
        replication: int,
        noise_dbm: float,
        on_begin: Callable[[J, float], None],
        on_end: Callable[[J, End, float], None],
        on_group_end: Callable[[F, IntArray, bytes], None],
    ) -> None:
        self._env = env
        self._on_begin, self._on_end, self._on_group_end = on_begin, on_end, on_group_end
        self._n = n = n_drones
        self._queues: list[deque[J]] = [deque() for _ in range(n)]
        self._deadlines: list[tuple[int, int, int, J]] = []
        self._pushes = 0
        self._e = e = _edca()
        self._ahead = e.ahead
        self._begin_s = env.now
        self._timer: simpy.Event | None = None
        self._skip_to = env.skip_to if isinstance(env, EventLoop) else None
        self._is_replanning = False
        self._last = self._event()
        self._on_last: list[Callable[[simpy.Event], None]] = [self._replan]
        self._on_time: list[Callable[[simpy.Event], None]] = [self._on_timer]
        self._told: list[int] = []  # kinds and rows by turns
        self._is_telling = False
        self._free = list(range(_JOBS))[::-1]
        self._finished: list[int] = []
        self._at_row: dict[int, J | F] = {}
        self._flows: dict[tuple[int, int], int] = {}
        self._tuned: list[Link | None] = []  # by flow
        self._settings = settings
        s, order = _tables(e, settings, n, noise_dbm)
        self._ints, self._floats, self._rates, self._limits = s
        self._group_access, self._payload_access = order
        keys = [stream(seed, replication, i, "channel access").bit_generator.random_raw() for i in range(n)]
        self._keys = np.array(keys, np.uint64)
        self._fade = fade_table(settings.rician_k_db)
        self._curves = _curves(settings.group_rate_mbps)
        self._window = window = int(self._ints[e.C_BLOCK])
        stations = np.zeros((n, e.STATION_COLUMNS), np.int64)
        for column in (e.TX_END, e.RESPONSE_AT, e.TIMEOUT_AT, e.GRANT, e.GRANT_LOW, e.ARRIVE_AT):
            stations[:, column] = e.FAR
        for column in (e.LOCK, e.CANDIDATE, e.HEAD, e.HEAD_LOW, e.TAIL, e.TAIL_LOW, e.COMING, e.TX_JOB):
            stations[:, column] = -1
        idle_ns = self._ns(env.now) - 10**9
        stations[:, e.IDLE_AT] = stations[:, e.CANDIDATE_AT] = stations[:, e.TX_BEGIN] = idle_ns
        for a in range(2):
            stations[:, e.BEGIN + a] = idle_ns + e.SIFS + self._ints[e.C_AIFSN + a] * e.SLOT
            stations[:, e.WINDOW + a] = self._ints[e.C_WINDOW + a]
        mcs = len(self._rates)
        self._settled = _State(
            (
                stations,
                np.vstack([np.full(n, e.FAR), np.zeros(n, np.int64)]),
                np.zeros(n),
                np.zeros(0),
                np.zeros(0, np.uint8),
                np.zeros(e.G_FIRST + n, np.int64),
                np.zeros((_JOBS, e.JOB_COLUMNS), np.int64),
                np.zeros((n, window), np.uint8),
                np.zeros((n, window), np.int32),
                np.zeros((n, e.OVERLAPS), np.int64),
                np.zeros((n, e.OVERLAPS)),
                np.zeros((_FLOWS, mcs + 1, 2), np.int64),
                np.zeros((_DROPS_KEPT + n * window, 2), np.int64),
            ),
            _JOBS,
            self._ns(env.now) - 1,
        )
        self._settled.arrays[_G][e.G_SINCE] = self._ns(env.now)
        self._planned = self._settled.copy()
        self._differing = np.zeros(2 * n + 1, np.int64)
        self._flow_ints = np.zeros((_FLOWS, e.FLOW_COLUMNS), np.int64)
        self._flow_floats = np.zeros((_FLOWS, 3))
        self._orders = np.zeros((_FLOWS, mcs), np.int64)
        self._out = np.zeros((2 * n + 8, 2), np.int64)
        self._out_rows = memoryview(self._out.reshape(-1).data)
        self._first: list[int] = []  # as `_begin`, in a list
        self._touch = np.zeros(3 * (n + 1), np.int64)
        self._begin: IntArray = np.zeros(n + 1, np.int64)
        self._receiver: IntArray = np.zeros(0, np.int64)
        self._gain: FloatArray = np.zeros(0)
        self._extra = np.zeros(1)
        self._shared_addresses: list[int] = []
        self._share()

    @staticmethod
    def _ns(t_s: float) -> int:
        return round(t_s * 1e9)

    # --- the links -------------------------------------------------------------------------------

    def set_links(
        self,
        begin: IntArray,
        receiver: IntArray,
        gain: FloatArray,
        *,
        frame: int,
        extra: FloatArray | None = None,
    ) -> None:
        """A new frame's links: how strong each station is at each other.

        Args:
            begin: [N + 1]: the links of station i are begin[i] … begin[i + 1] − 1.
            receiver: [L], rising within a station's links.
            gain: [L]: mean received power over the noise of the whole channel, linear.
            frame: its number.
            extra: [L]: probability that a group frame is lost besides; None is none.
        """
        e, ints = self._e, self._ints
        self.sync()
        settled = self._settled
        is_same = receiver is self._receiver
        old = self._begin, self._receiver, settled.arrays[_WHY]
        ints[e.C_FRAME], ints[e.C_EXTRA] = frame, extra is not None
        if extra is not None and len(extra) == len(self._extra):
            self._extra[:] = extra
        elif extra is not None:
            self._extra = extra.copy()
            self._share()
        if is_same:
            self._gain[:] = gain
        else:
            self._begin, self._receiver, self._gain = begin, receiver, gain.copy()
            self._first = begin.tolist()
            self._share()
            if len(settled.arrays[_W]) != len(receiver):
                sized = {_W: len(receiver), _WHY: len(receiver)}
                self._settled, self._planned = (_sized(x, sized) for x in (settled, self._planned))
                settled = self._settled
            a = settled.arrays
            if len(old[1]):
                e.relink(
                    a[_S],
                    a[_N],
                    self._differing,
                    a[_P],
                    a[_W],
                    a[_WHY],
                    old[0],
                    old[1],
                    old[2].copy(),
                    begin,
                    receiver,
                    gain,
                    self._fade,
                    self._keys,
                    ints,
                )
        self.replan()

    def _share(self) -> None:
        self._shared_addresses = _addresses(
            (
                self._differing,
                self._flow_ints,
                self._flow_floats,
                self._out,
                self._touch,
                self._begin,
                self._receiver,
                self._gain,
                self._extra,
                self._fade,
                self._keys,
                self._rates,
                self._limits,
                self._orders,
                self._ints,
                self._floats,
                self._curves,
            )
        )
        self._settled.table = self._planned.table = None

    def _make_table(self) -> IntArray:
        """Sizes and addresses of the settled state's arrays, the planned one's, and those that they share."""
        a = self._settled.arrays
        sizes = (
            self._n,
            len(self._receiver),
            len(a[_J]),
            self._window,
            len(a[_LS]),
            len(self._rates),
            len(a[_DROPS]),
            len(self._extra),
        )
        addresses = (*self._settled.addresses, *self._planned.addresses, *self._shared_addresses)
        self._settled.table = table = np.array([*sizes, *addresses], np.int64)
        return table

    def flow(self, sender: int, receiver: int) -> int:
        """The number of an ordered link that carries unicast frames."""
        found = self._flows.get((sender, receiver))
        if found is None:
            found = self._flows[sender, receiver] = len(self._flows)
            self._tuned.append(None)
            if found == len(self._flow_floats):
                more = 2 * found
                self._settled, self._planned = (_sized(x, {_LS: more}) for x in (self._settled, self._planned))
                self._flow_ints = _longer(self._flow_ints, more)
                self._flow_floats = _longer(self._flow_floats, more)
                self._orders = _longer(self._orders, more)
                self._share()
            e = self._e
            self._flow_ints[found, e.FLOW_TO] = receiver
            if self._ints[e.C_LEARNS]:
                self._orders[found] = np.roll(np.arange(len(self._rates)), 5 * sender + receiver)
        return found

    def tune(self, flow: int, link: Link) -> None:
        """From now on a sender uses a link like this."""
        if link == self._tuned[flow]:
            return
        self.sync()  # what has been sent so far was sent as before
        self._tuned[flow] = link
        self._flow_ints[flow, self._e.FLOW_MCS :] = max(0, link.mcs), link.frames, link.dead
        loss = -1.0 if link.loss != link.loss else link.loss
        self._flow_floats[flow] = link.rate_mbps * 1e-3, loss, link.burst_loss

    def learned(self, flow: int) -> IntArray:
        """[MCS, 2]: frames of a link that were sent and that were acknowledged since the last call."""
        row = self._settled.arrays[_LS][flow, :-1]  # without its counts of exchanges and of probes
        found: IntArray = row.copy()
        row[:] = 0
        return found

    # --- jobs ------------------------------------------------------------------------------------

    def submit(self, job: J) -> None:
        """Queue a job behind its sender's others; its `flow`, `frames`, `full_bytes` and `last_bytes` are set."""
        now_s, queue = self._env.now, self._queues[job.sender]
        self._open(job, now_s)
        self._settled.entered = job.row
        queue.append(job)
        if len(queue) == 1:
            self._on_begin(job, now_s)
        self.replan()

    def replace(self, old: J, new: J) -> None:
        """Drop `old` (queued or in service) for `new`.

        A queued job's place is kept. One in service is cut short and the new one goes to the tail, so that
        the sender's other samples are not starved by a link that is slower than its samples come.
        """
        self.sync()
        now_s, queue = self._env.now, self._queues[old.sender]
        if queue[0] is not old:
            self.read(old)
            self._take_in()
            self._open(new, now_s)
            a = self._settled.arrays
            if self._e.substitute(old.row, new.row, a[_S], self._differing, a[_J]):
                queue[queue.index(old)] = new
                self._leave(old, now_s)
                self.replan()
                return
            self._free.append(new.row)
            del self._at_row[new.row]
        self._take(old, requests=True)
        self.submit(new)

    def _open(self, job: J, now_s: float) -> None:
        """Open a row for a job."""
        job.row = row = self._free.pop() if self._free else self._new_row()
        self._at_row[row] = job
        job.live = True
        job.arrived_frames = job.sent_frames = 0
        job.dropped = NONE_DROPPED
        job.pass_granted_s = 0.0
        job.t_start_s = nan
        self._pushes += 1
        if job.deadline_s < inf:
            heappush(self._deadlines, (round(job.deadline_s * 1e9), job.number, self._pushes, job))
        lengths = job.frames, job.full_bytes, job.last_bytes
        self._settled.open(row, _DATA, job.sender, job.flow, lengths, self._payload_access, round(now_s * 1e9), 0)

    def _new_row(self) -> int:
        """A row for a job when none is free: one of those that are finished, or a row more."""
        live, told = self._settled.arrays[_J][:, self._e.IS_LIVE].tolist(), set(self._told[1::2])
        self._free = [row for row in self._finished if not live[row] and row not in told]  # it may be its turn yet
        self._finished = [row for row in self._finished if live[row] or row in told]
        if not self._free:
            n = self._settled.jobs
            self._settled, self._planned = (_sized(state, {_J: 2 * n}) for state in (self._settled, self._planned))
            self._free = list(range(n, 2 * n))[::-1]
        return self._free.pop()

    def withdraw(self, job: J) -> None:
        """Take a job out without a word; the next in its queue begins."""
        self.sync()
        self._take(job, requests=False)
        self.replan()

    def _take(self, job: J, *, requests: bool) -> None:
        self.read(job)
        self._take_in()
        a, now_s = self._settled.arrays, self._env.now
        self._e.cancel(job.row, round(now_s * 1e9), a[_S], a[_N], self._differing, a[_J], requests)
        self._leave(job, now_s)

    def _leave(self, job: J, now_s: float) -> None:
        """A job is no longer the sender's concern here; the stations may still owe it an answer."""
        job.live = False
        self._finished.append(job.row)
        del self._at_row[job.row]
        job.row = -1
        queue = self._queues[job.sender]
        if queue and queue[0] is job:
            queue.popleft()
            if queue:
                self._on_begin(queue[0], now_s)
        elif job in queue:
            queue.remove(job)

    def read(self, job: J) -> None:
        """Bring a job's figures up to the settled state (see `sync`)."""
        settled = self._settled
        if settled.drops[0]:
            self._drain()
        first = job.row * _ROW_BYTES + _FIGURES_AT
        low, high, arrived, air_ns, head_at = _read_figures(settled.rows, first)
        job.arrived_frames, job.sent_frames = arrived, high
        granted_s = air_ns * _NS
        job.granted_s += granted_s - job.pass_granted_s
        job.pass_granted_s = granted_s
        job.t_start_s = head_at * _NS if head_at >= 0 else nan
        if job.keeps_frames:
            waiting = np.arange(low, high)
            here = waiting[(settled.arrays[_M][job.sender, waiting % self._window] & 64) > 0]
            job.here = np.concatenate([np.setdiff1d(np.arange(low), list(job.dropped)), here])

    def _drain(self) -> None:
        """Give the jobs what the settled state has dropped. The plan may tell the same again: a set takes it once."""
        drops = self._settled.arrays[_DROPS]
        for row, index in drops[1 : drops[0, 0] + 1].tolist():
            job: Any = self._at_row.get(row)
            if job is not None:
                if not job.dropped:
                    job.dropped = set()
                job.dropped.add(index)
        drops[0, 0] = 0

    def in_service(self, sender: int) -> J | None:
        """The job at the head of a sender's queue, its figures brought up to now."""
        queue = self._queues[sender]
        if not queue:
            return None
        self.sync()
        self.read(queue[0])
        return queue[0]

    def queued(self, sender: int) -> Sequence[J]:
        """A sender's jobs, the one in service first."""
        return self._queues[sender]

    def queues(self) -> list[Sequence[J]]:
        """The jobs of every sender that has any, the one in service first."""
        return [queue for queue in self._queues if queue]

    def heads(self) -> list[J]:
        """The job in service of every sender that has one, its figures brought up to now."""
        heads = [queue[0] for queue in self._queues if queue]
        if heads:
            self.sync()
        for job in heads:
            self.read(job)
        return heads

    # --- group frames ----------------------------------------------------------------------------

    def announce(self, frame: F, in_s: float = 0.0) -> None:
        """A group frame comes to its station's queue, `in_s` from now."""
        frame.row = row = self._free.pop() if self._free else self._new_row()
        self._at_row[row] = frame
        length, at_ns, air_ns = frame.wire_bytes, round((self._env.now + in_s) * 1e9), round(frame.airtime_s * 1e9)
        stands = self._timer is not None and at_ns > self._planned.now_ns and not self._is_telling
        for state in (self._settled, self._planned) if stands else (self._settled,):
            state.open(row, _GROUP, frame.sender, 0, (1, length, length), self._group_access, at_ns, air_ns)
            state.entered = row
        if not stands:  # else the plan ends before the frame comes
            self.replan()

    def drop_context(self, sender: int) -> None:
        """Forget a drone's group frames and its block-ack requests, waiting or to come; a frame on the air ends."""
        self.sync()
        self._take_in()
        a, e = self._settled.arrays, self._e
        rows = a[_J]
        is_request = (rows[:, e.IS_LIVE] == 1) & (rows[:, e.STATION] == sender) & (rows[:, e.KIND] == e.BLOCK_REQUEST)
        for row in np.flatnonzero(is_request).tolist():
            e.cancel(row, self._ns(self._env.now), a[_S], a[_N], self._differing, rows, False)
        for row, frame in list(self._at_row.items()):
            if isinstance(frame, GroupFrame) and frame.sender == sender and a[_S][sender, e.TX_JOB] != row:
                e.cancel(row, self._ns(self._env.now), a[_S], a[_N], self._differing, a[_J], False)
                self._finished.append(row)
                del self._at_row[row]
        self.replan()

    # --- the clock -------------------------------------------------------------------------------

    def sync(self) -> None:
        """Bring the settled state up to now; what happens at this very instant is still to come."""
        until, settled = round(self._env.now * 1e9) - 1, self._settled
        while settled.now_ns < until:
            table = self._make_table() if settled.table is None else settled.table
            settled.now_ns, told = self._e.ahead(table, settled.entered, until, until - 1)
            settled.entered = -1
            if told < 0:
                self._drain()

    def _take_in(self) -> None:
        """Have the stations take in what has entered, before one of their jobs is taken out or replaced."""
        settled = self._settled
        if settled.entered >= 0:
            table = self._make_table() if settled.table is None else settled.table
            self._e.ahead(table, settled.entered, -1, -2)  # and no more
            settled.entered = -1

    def replan(self) -> None:
        """Something has come from outside: plan anew when all that comes at this instant has come."""
        self._timer = None
        if not (self._is_replanning or self._is_telling):
            self._is_replanning = True
            self._last.callbacks = self._on_last
            self._env.schedule(self._last, _LAST)

    def _event(self) -> simpy.Event:
        """An event to schedule again and again, with callbacks set anew: half the work of a timeout each time."""
        event = simpy.Event(self._env)
        event._ok, event._value = True, None
        return event

    def _replan(self, _: simpy.Event) -> None:
        self._is_replanning = False
        self._go_on(None, max(round(self._env.now * 1e9) - 1, self._settled.now_ns))

    def _on_timer(self, event: simpy.Event) -> None:
        if event is self._timer:  # else something came earlier
            self._tell()
            self._go_on(event, self._settled.now_ns)

    def _go_on(self, timer: simpy.Event | None, since: int) -> None:
        """Plan from `since`, and tell what comes of it at its time; a timer is set only if others have something to do first."""
        env, skip_to = self._env, self._skip_to
        self._timer = None
        while self._at_row:
            now_s = env.now
            delay_s = self._plan(since) * _NS - now_s
            if delay_s < 0.0:
                delay_s = 0.0
            if skip_to is None or not skip_to(now_s + delay_s):
                self._timer = timer = timer or self._event()
                timer.callbacks = self._on_time
                env.schedule(timer, NORMAL, delay_s)
                return
            self._tell()
            self._timer = None
            since = self._settled.now_ns

    def _plan(self, since: int) -> int:
        """Bring the settled state up to `since`, and run a copy ahead to whatever must be told next; returns when that is."""
        settled, deadlines = self._settled, self._deadlines
        while deadlines and not deadlines[0][3].live:
            heappop(deadlines)
        until = since + _AHEAD_NS
        if deadlines and deadlines[0][0] < until:
            until = deadlines[0][0] if deadlines[0][0] > since else since
        ahead = self._ahead
        table = self._make_table() if settled.table is None else settled.table
        reached, told = ahead(table, settled.entered, since, until)
        settled.entered = self._planned.entered = -1
        while reached < since:
            self._drain()
            reached, told = ahead(table, -1, since, until)
        settled.now_ns, self._planned.now_ns = since, reached
        self._told = self._out_rows[: 2 * told].tolist() if told > 0 else []
        found: int = reached
        return found

    def _tell(self) -> None:
        """The plan has come about: it is the settled state now, and who waits for a part of it is called."""
        self._settled, self._planned = self._planned, self._settled
        now, settled = self._env.now, self._settled
        if settled.drops[0]:
            self._drain()
        self._is_telling = True
        told = self._told
        for k in range(0, len(told), 2):
            kind, row = told[k], told[k + 1]
            job = self._at_row.get(row)
            if job is None:
                continue  # it was taken out, and what the stations owed it is done
            if kind == _T_GROUP:
                self._end_group(job, row)  # type: ignore[arg-type]
                continue
            self.read(job)  # type: ignore[arg-type]
            self._leave(job, now)  # type: ignore[arg-type]
            self._on_end(job, _ENDS[kind], now)  # type: ignore[arg-type]
        deadlines = self._deadlines
        while deadlines and (not deadlines[0][3].live or deadlines[0][0] <= settled.now_ns):
            job = heappop(deadlines)[3]
            if job.live:
                is_head = self._queues[job.sender][0] is job
                self._take(job, requests=True)
                is_served = is_head and job.t_start_s < now - _NS
                self._on_end(job, End.DEADLINE_IN_SERVICE if is_served else End.DEADLINE_QUEUED, now)
        self._is_telling = False

    def _end_group(self, frame: F, row: int) -> None:
        first, last = self._first[frame.sender : frame.sender + 2]
        receivers, fates = self._receiver[first:last], bytes(self._settled.fates[first:last])
        self._finished.append(row)
        del self._at_row[row]
        frame.row = -1
        self._on_group_end(frame, receivers, fates)

    # --- accounts --------------------------------------------------------------------------------

    @property
    def transmit_s(self) -> list[float]:
        """Seconds that each station has transmitted: data, retries, answers and group frames; a frame counts at its begin."""
        self.sync()
        sent: list[float] = (self._settled.arrays[_S][:, self._e.TRANSMITTED_NS] * _NS).tolist()
        return sent

    @property
    def data_busy_s(self) -> float:
        """Seconds in which unicast frames or their answers were on the air somewhere."""
        return self._busy_s()[1]

    @property
    def context_busy_s(self) -> float:
        """Seconds in which group frames alone were on the air."""
        return self._busy_s()[0]

    def _busy_s(self) -> tuple[float, float]:
        self.sync()
        e, g = self._e, self._settled.arrays[_G].copy()
        e.account(max(self._ns(self._env.now), int(g[e.G_SINCE])), g)
        return float(g[e.G_GROUP_NS]) * _NS, float(g[e.G_OTHER_NS]) * _NS

    @property
    def utilisation(self) -> float:
        """Fraction of the time so far in which something was on the air."""
        elapsed = self._env.now - self._begin_s
        return min(1.0, plain_sum(self._busy_s()) / elapsed) if elapsed > 0 else 0.0


_T_GROUP: Final = 0
"""As `edca.T_GROUP`."""
_GROUP: Final = 1
_DATA: Final = 2
"""As in `edca`."""
_write_row: Final = Struct("19q").pack_into
_read_figures: Final = Struct("5q").unpack_from
_ROW_BYTES: Final = 8 * 19
_FIGURES_AT: Final = 8 * 14
"""A row of `edca.JOB_COLUMNS`, and the columns from `edca.LOW` on."""
_ENDS: Final = (None, End.ARRIVED, End.OVER, End.UNREACHABLE)


@cache
def _curves(group_rate_mbps: float) -> FloatArray:
    """The packet error rates as the stations read them."""
    curves = [*CURVES, group_curve(group_rate_mbps), LEGACY_CURVES[CONTROL_MBPS]]
    centre_db, slope, weight = np.array(curves).T
    sure = 10.0 ** ((centre_db + 36.001 / slope) / 10.0)  # the stations' form of the curve is 0 from 36 on
    even = 10.0 ** ((centre_db - np.log(np.expm1(0.7 / weight)) / slope) / 10.0)
    return np.column_stack((centre_db, slope, weight, sure, even))


def _tables(
    e: Any, settings: AirSettings, n: int, noise_dbm: float
) -> tuple[tuple[IntArray, FloatArray, FloatArray, IntArray], tuple[int, int]]:
    """The settings as the stations read them, and the place of group frames and of unicast frames among the classes."""
    standard = STANDARDS[settings.standard]
    rates = standard.rates_mbps[settings.bandwidth_mhz]
    window = max(settings.block_ack_window, settings.max_ampdu_frames)
    full = frame_bytes(settings.fragment_bytes, fragmented=True)
    limits = [ampdu_frames(full, rate, settings.max_ampdu_frames, standard) for rate in rates]
    names = list(EdcaSettings.__dataclass_fields__)
    used = sorted({names.index(settings.context_class), names.index(settings.payload_class)})
    classes = [getattr(settings.edca, names[i]) for i in used]
    first, second = classes[0], classes[-1]
    ints = np.zeros(16, np.int64)
    values = {
        e.C_STATIONS: n,
        e.C_AIFSN: first.aifsn,
        e.C_AIFSN_LOW: second.aifsn,
        e.C_WINDOW: first.cw_min,
        e.C_WINDOW_LOW: second.cw_min,
        e.C_LARGEST: first.cw_max,
        e.C_LARGEST_LOW: second.cw_max,
        e.C_RETRIES: settings.retry_limit,
        e.C_BLOCK: window,
        e.C_RTS: settings.rts,
        e.C_BY_FRAME: settings.fading == "frame",
        e.C_PREAMBLE_NS: round(standard.preamble_s * 1e9),
        e.C_SYMBOL_NS: round(standard.symbol_s * 1e9),
        e.C_LEARNS: settings.rate_control == "minstrel",
    }
    for column, value in values.items():
        ints[column] = value
    legacy_noise = 20.0 / settings.bandwidth_mhz
    over_noise = 10.0 ** ((settings.preamble_detection_dbm - noise_dbm) / 10.0)
    energy = over_noise * 10.0 ** (ENERGY_OVER_PREAMBLE_DB / 10.0)
    faint = over_noise * 10.0 ** (-FAINT_DB / 10.0) / float(fade_table(settings.rician_k_db).max())
    floats = np.array([over_noise, 10.0 ** (PREAMBLE_SINR_DB / 10.0), legacy_noise, energy, faint])
    tables = ints, floats, np.array(rates) * 1e-3, np.array(limits, np.int64)
    return tables, (used.index(names.index(settings.context_class)), used.index(names.index(settings.payload_class)))


def _longer(values: NDArray[Any], length: int) -> NDArray[Any]:
    more = np.zeros((length, *values.shape[1:]), values.dtype)
    kept = min(length, len(values))
    more[:kept] = values[:kept]
    return more


def _sized(state: _State, lengths: dict[int, int]) -> _State:
    """A state with some arrays longer or shorter."""
    arrays = [_longer(a, lengths[k]) if k in lengths else a for k, a in enumerate(state.arrays)]
    return _State(tuple(arrays), lengths.get(_J, state.jobs), state.now_ns, state.entered)
