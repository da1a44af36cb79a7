"""The shared medium on the SimPy clock: who may use the air, and when a sample is through.

Two classes of traffic.

**Data** is a fluid. Each sender has a first-in-first-out queue; while n senders are backlogged each is given
1/n of the channel's time, and of that its own exchanges, its idle slots and its part of the collisions are
paid (Bianchi's model for n). So a sample with exchanges X needs n · X.channel_s(n) seconds while n stays.

**Context** (group-addressed frames) goes first. A frame that finds data on the air waits for the rest of that
exchange (uniform), then all waiting context frames count down backoff slots; the lowest counter sends, equal
ones collide, the others freeze. Data stand still from the countdown to the end of the last waiting frame.

Events: one timer for the data (next completion or deadline, never per fragment) and one for the frame on the
air. A timer that turns out to be early because others joined is set anew; it never polls.
"""

from __future__ import annotations

from bisect import insort
from collections import deque
from collections.abc import Callable, Iterable
from heapq import heappop, heappush
from math import inf, nextafter
from typing import Generic, TypeVar

import simpy

from sortie.radio.mac.contention import SIFS_S, SLOT_S, contention
from sortie.radio.mac.jobs import AirJob, End, GroupFrame

AIFS_CONTEXT_S = SIFS_S + 2 * SLOT_S
CW_CONTEXT = 15
_EPS_S = 1e-10
_SERVED = End.SERVED  # members of an enumeration are slow to look up

J = TypeVar("J", bound=AirJob)
F = TypeVar("F", bound=GroupFrame)


class Medium(Generic[J, F]):
    """One channel that everybody hears.

    Args:
        env: the clock.
        n_drones: senders are 0 … n_drones − 1.
        on_begin: called with a job and the time when it comes to the head of its queue, and again by `retune` while
            it is there; must call `job.demand`.
        on_end: called with a job, how it ended and the time, once it is through or its deadline has passed, after
            the medium has moved on.
        on_group_end: called at a context frame's end with the frame and whether it collided.
    """

    def __init__(
        self,
        env: simpy.Environment,
        n_drones: int,
        on_begin: Callable[[J, float], None],
        on_end: Callable[[J, End, float], None],
        on_group_end: Callable[[F, bool], None],
    ) -> None:
        self._env = env
        self._on_begin, self._on_end, self._on_group_end = on_begin, on_end, on_group_end
        self._queues: list[deque[J]] = [deque() for _ in range(n_drones)]
        self._heads: dict[int, J] = {}
        self._deadlines: list[tuple[float, int, int, J]] = []
        self._pushes = 0
        table = [contention(max(1, k)) for k in range(n_drones + 1)]
        self._idle_s = [c.idle_s for c in table]
        self._collisions = [c.collisions for c in table]
        self._sends = [c.sends_per_success for c in table]
        self._last_s = env.now
        self._begin_s = env.now
        self._due_s = inf
        self._timer: simpy.Event | None = None
        self._waiting: list[F] = []
        self._context_from_s = inf
        self._context_until_s = -inf
        self._context_fire_s = inf
        self._context_target_s = inf  # when the frame that is to win ends, as the clock will say it
        self._context_due_s = inf
        self._context_timer: simpy.Event | None = None
        self._coming: list[tuple[float, int, float, F, float]] = []  # the next to contend comes last
        self.transmit_s = [0.0] * n_drones
        """Seconds each drone has transmitted: data with retries and collisions, and context frames."""
        self.data_busy_s = 0.0
        self.context_busy_s = 0.0

    # --- data ------------------------------------------------------------------------------------

    def submit(self, job: J) -> None:
        """Queue a job behind its sender's others."""
        queue = self._queues[job.sender]
        queue.append(job)
        self._expect(job)
        if len(queue) == 1:
            now = self.sync()
            self._serve(job, now)
            self._arm(now)
        elif job.deadline_s < self._due_s:
            now = self._env.now
            self._set_timer(max(job.deadline_s, now), now)

    def replace(self, old: J, new: J) -> None:
        """Drop `old` (queued or in service) for `new`.

        A queued job's place is kept. One in service is cut short and the new one goes to the tail, so that
        the sender's other samples are not starved by a link that is slower than its samples come.
        """
        if self._heads.get(old.sender) is old:
            self.withdraw(old)
            self.submit(new)
            return
        old.live = False
        queue = self._queues[old.sender]
        queue[queue.index(old)] = new
        self._expect(new)
        if new.deadline_s < self._due_s:
            now = self._env.now
            self._set_timer(max(new.deadline_s, now), now)

    def withdraw(self, job: J) -> None:
        """Take a job out without a word; the next in its queue begins."""
        now = self.sync()
        self._remove(job, now)
        self._arm(now)

    def retune(self) -> None:
        """Let every job in service set its demand anew (the links have changed)."""
        if self._heads:
            now = self.sync()
            for job in self._heads.values():
                self._on_begin(job, now)
            self._arm(now)

    def in_service(self, sender: int) -> J | None:
        """The job at the head of a sender's queue."""
        return self._heads.get(sender)

    def queued(self, sender: int) -> Iterable[J]:
        """A sender's jobs, the one in service first."""
        return self._queues[sender]

    def _expect(self, job: J) -> None:
        """Remember a job's deadline; of equal ones the older job's comes first."""
        self._pushes += 1
        heappush(self._deadlines, (job.deadline_s, job.number, self._pushes, job))

    def _serve(self, job: J, now_s: float) -> None:
        self._heads[job.sender] = job
        job.t_start_s = now_s
        self._on_begin(job, now_s)

    def _remove(self, job: J, now_s: float) -> None:
        job.live = False
        queue = self._queues[job.sender]
        if queue[0] is job:
            queue.popleft()
            if queue:
                self._serve(queue[0], now_s)
            else:
                del self._heads[job.sender]
        else:
            queue.remove(job)

    def sync(self) -> float:
        """Bring every account up to now, and return it; frames whose time has come contend."""
        now: float = self._env.now
        coming = self._coming
        if coming and -coming[-1][0] <= now:
            self._admit(now)
        if now > self._last_s:
            self._account(now)
        return now

    def _admit(self, now: float) -> None:
        """Let the frames contend whose time has come."""
        coming = self._coming
        while coming and -coming[-1][0] <= now:
            minus_at_s, _, _, frame, residual = coming.pop()
            self._join(frame, residual, -minus_at_s)

    def _account(self, now: float) -> None:
        dt = now - self._last_s
        if dt <= 0.0:
            return
        heads = self._heads
        if not heads and not self._waiting:
            self._last_s = now
            return
        if self._waiting:
            blocked = min(now, self._context_until_s) - max(self._last_s, self._context_from_s)
            if blocked > 0.0:
                self.context_busy_s += blocked
                dt -= blocked
        self._last_s = now
        n = len(heads)
        if n == 0 or dt <= 0.0:
            return
        self.data_busy_s += dt
        share, sends, transmit_s = dt / n, self._sends[n], self.transmit_s
        for sender, job in heads.items():
            left, need = job.remaining, job.need_s
            done = share / need if need * left > share else left
            job.remaining = left - done
            job.granted_s += share
            transmit_s[sender] += done * job.ppdu_s * sends

    def _arm(self, now: float) -> None:
        """Who is served has changed, or at what cost: set the timer to the earliest thing that can happen."""
        deadlines, heads = self._deadlines, self._heads
        while deadlines and not deadlines[0][3].live:
            heappop(deadlines)
        due = inf
        n = len(heads)
        if n:
            idle, collisions = self._idle_s[n], self._collisions[n]
            soonest = inf
            for job in heads.values():
                job.need_s = need = job.clean_s + job.count * idle + collisions * job.collided_s
                left = job.remaining * need
                if left < soonest:
                    soonest = left
            soonest *= n
            if now + soonest > self._context_from_s:
                soonest += self._context_until_s - max(now, self._context_from_s)
            due = now + soonest
        if deadlines and deadlines[0][0] < due:
            due = max(deadlines[0][0], now)
        if due < self._due_s:
            self._set_timer(due, now)

    def _set_timer(self, due_s: float, now_s: float) -> None:
        self._due_s = due_s
        self._timer = timer = self._env.timeout(max(0.0, due_s - now_s))
        timer.callbacks.append(self._on_timer)

    def _on_timer(self, event: simpy.Event) -> None:
        if event is not self._timer:
            return  # an earlier time was set meanwhile
        self._due_s = inf
        now = self.sync()
        heads, deadlines = self._heads, self._deadlines
        n = len(heads)
        through = [job for job in heads.values() if n * job.remaining * job.need_s <= _EPS_S]
        if len(through) > 1:
            through.sort(key=_number)
        ended = [(job, _SERVED) for job in through]
        for job in through:
            job.remaining = 0.0
            self._remove(job, now)
        while deadlines and (not deadlines[0][3].live or deadlines[0][0] <= now + _EPS_S):
            job = heappop(deadlines)[3]
            if job.live:
                served = heads.get(job.sender) is job and job.t_start_s < now
                self._remove(job, now)
                ended.append((job, End.DEADLINE_IN_SERVICE if served else End.DEADLINE_QUEUED))
        self._arm(now)
        for job, how in ended:
            self._on_end(job, how, now)

    # --- context ---------------------------------------------------------------------------------

    def announce(self, frame: F, residual: float, in_s: float = 0.0) -> None:
        """Contend for the air with a context frame.

        Args:
            frame: its `slots` drawn, 0 … CW_CONTEXT.
            residual: uniform in [0, 1): how much of a running data exchange is still to come.
            in_s: how long from now, ≥ 0. No event of its own marks the begin: it is looked back at from the next one,
                which is at the latest the end that the frame would have if nothing held it up.
        """
        if in_s <= 0.0:
            now = self.sync()
            self._join(frame, residual, now)
            self._aim(now)
            return
        now = self._env.now
        at_s = now + in_s
        until = at_s + AIFS_CONTEXT_S + frame.slots * SLOT_S + frame.airtime_s
        end_s = at_s + (until - at_s)
        self._pushes += 1
        insort(self._coming, (-at_s, -self._pushes, end_s, frame, residual))
        if end_s < self._context_due_s:
            self._aim(now)

    def _join(self, frame: F, residual: float, now: float) -> None:
        """A frame begins to contend."""
        waiting = self._waiting
        if waiting:
            self._account(now)
        elif self._heads:
            self._account(now)
            self._context_from_s = now + residual * self._mean_exchange_s()
        else:  # nothing else goes on: it is its own plan
            self._last_s = self._context_from_s = now
            waiting.append(frame)
            self._context_fire_s = frame.fire_s = fire = now + AIFS_CONTEXT_S + frame.slots * SLOT_S
            self._context_until_s = until = fire + frame.airtime_s
            self._context_target_s = now + (until - now)
            return
        waiting.append(frame)
        if now >= self._context_fire_s:
            return  # heard the frame that is on the air; counts down after it
        frame.fire_s = max(now, self._context_from_s) + AIFS_CONTEXT_S + frame.slots * SLOT_S
        self._plan_context(now)

    def drop_context(self, sender: int) -> None:
        """Forget a drone's context frames, waiting or to come; one that is on the air ends."""
        now = self.sync()
        self._coming = [entry for entry in self._coming if entry[3].sender != sender]
        kept = [
            f
            for f in self._waiting
            if f.sender != sender or (self._context_fire_s <= now and f.fire_s <= self._context_fire_s + SLOT_S / 2)
        ]
        if len(kept) == len(self._waiting):
            return
        self._waiting = kept
        if now < self._context_fire_s:
            self._plan_context(now)
            self._aim(now)
            self._arm(now)

    def _mean_exchange_s(self) -> float:
        if not self._heads:
            return 0.0
        jobs = [j for j in self._heads.values() if j.count > 0.0]
        return sum(j.ppdu_s / j.count for j in jobs) / len(jobs) if jobs else 0.0

    def _plan_context(self, now: float) -> None:
        """Who of the waiting frames is to win, and when its turn is over."""
        waiting = self._waiting
        if not waiting:
            self._context_from_s, self._context_until_s = inf, -inf
            self._context_fire_s = self._context_target_s = inf
            return
        if len(waiting) == 1:
            fire, longest_s = waiting[0].fire_s, waiting[0].airtime_s
        else:
            fire = min([f.fire_s for f in waiting])
            longest_s = max([f.airtime_s for f in waiting if f.fire_s <= fire + SLOT_S / 2])
        until = fire + longest_s
        self._context_fire_s = fire
        if until != self._context_until_s:
            self._context_until_s = until
            self._context_target_s = now + max(0.0, until - now)

    def _aim(self, now: float) -> None:
        """Set the timer to the earliest end of a context frame."""
        due = self._context_target_s
        for minus_at_s, _, end_s, _, _ in reversed(self._coming):
            if -minus_at_s >= due:
                break
            if end_s < due:
                due = end_s
        if due == self._context_due_s or due == inf:
            return
        delay = due - now
        if now + delay != due:  # so that the clock says it to the last digit
            near = (nextafter(delay, inf), nextafter(delay, -inf))
            delay = next((d for d in near if now + d == due), delay)
        self._context_due_s = due
        self._context_timer = timer = simpy.Timeout(self._env, max(0.0, delay))
        timer.callbacks.append(self._on_context_timer)

    def _on_context_timer(self, event: simpy.Event) -> None:
        if event is not self._context_timer:
            return
        self._context_due_s = inf
        now: float = self._env.now
        coming = self._coming
        if coming and -coming[-1][0] <= now:
            minus_at_s, _, end_s, frame, _ = coming[-1]
            if end_s <= now and not (self._waiting or self._heads) and (len(coming) == 1 or -coming[-2][0] > now):
                coming.pop()
                self._end_alone(frame, -minus_at_s, now)
                return
            self._admit(now)
        if now < self._context_target_s:  # something holds it up
            self._aim(now)
            return
        self._account(now)
        fire, sent = self._context_fire_s, self._waiting
        if len(sent) == 1:
            self._waiting = []
            self._context_from_s, self._context_until_s = inf, -inf
            self._context_fire_s = self._context_target_s = inf
            self._aim(now)
            (frame,) = sent
            self.transmit_s[frame.sender] += frame.airtime_s
            self._on_group_end(frame, False)
            return
        self._waiting = [f for f in sent if f.fire_s > fire + SLOT_S / 2]
        sent = [f for f in sent if f.fire_s <= fire + SLOT_S / 2]
        for f in self._waiting:
            if f.fire_s < inf:  # it had counted down to the moment the winner sent, if its AIFS was over by then
                f.slots = min(f.slots, max(1, round((f.fire_s - fire) / SLOT_S)))
            f.fire_s = now + AIFS_CONTEXT_S + f.slots * SLOT_S
            self._context_from_s = now
        self._plan_context(now)
        self._aim(now)
        for f in sent:
            self.transmit_s[f.sender] += f.airtime_s
            self._on_group_end(f, len(sent) > 1)

    def _end_alone(self, frame: F, at_s: float, now: float) -> None:
        """A frame had the channel to itself since it began to contend: `_join`, `_account` and the rest in one go."""
        until = at_s + AIFS_CONTEXT_S + frame.slots * SLOT_S + frame.airtime_s
        self.context_busy_s += min(now, until) - at_s
        self._last_s = now
        self._aim(now)
        self.transmit_s[frame.sender] += frame.airtime_s
        self._on_group_end(frame, False)

    # --- accounts --------------------------------------------------------------------------------

    @property
    def utilisation(self) -> float:
        """Fraction of the time so far in which the channel was claimed, contention included."""
        elapsed = self.sync() - self._begin_s
        return (self.data_busy_s + self.context_busy_s) / elapsed if elapsed > 0 else 0.0


def _number(job: AirJob) -> int:
    return job.number
