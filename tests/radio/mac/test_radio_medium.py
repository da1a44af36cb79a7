"""The shared medium against closed forms and conservation laws."""

from __future__ import annotations

from math import inf

import pytest
import simpy
from hypothesis import given, settings
from hypothesis import strategies as st

from sortie.radio.mac.airtime import Exchanges
from sortie.radio.mac.contention import DIFS_S, SLOT_S, contention
from sortie.radio.mac.jobs import AirJob, End, GroupFrame
from sortie.radio.mac.medium import AIFS_CONTEXT_S, Medium

ONE_MS = Exchanges(4, 0.9e-3, 1e-3)


class Bench:
    """A medium whose jobs bring their demand with them, and a log of what ended when."""

    def __init__(self, n_drones: int = 5) -> None:
        self.env = simpy.Environment()
        self.log: list[tuple[float, int, End]] = []
        self.heard: list[tuple[float, int, bool]] = []
        self.demands: dict[int, Exchanges] = {}
        self.medium = Medium(self.env, n_drones, self._begin, self._end, self._group_end)

    def _begin(self, job: AirJob, now_s: float) -> None:
        job.demand(self.demands[job.number])

    def _end(self, job: AirJob, how: End, now_s: float) -> None:
        self.log.append((now_s, job.number, how))

    def _group_end(self, frame: GroupFrame, collided: bool) -> None:
        self.heard.append((self.env.now, frame.sender, collided))

    def job(self, sender: int, demand: Exchanges = ONE_MS, deadline_s: float = inf) -> AirJob:
        job = AirJob(len(self.demands), sender, self.env.now + deadline_s)
        self.demands[job.number] = demand
        return job

    def submit(self, sender: int, demand: Exchanges = ONE_MS, deadline_s: float = inf) -> AirJob:
        job = self.job(sender, demand, deadline_s)
        self.medium.submit(job)
        return job

    def run(self, until: float = 10.0) -> None:
        self.env.run(until=until)

    def at(self, when_s: float) -> None:
        self.env.run(until=when_s)


def test_one_sender_takes_its_airtime() -> None:
    b = Bench()
    job = b.submit(0)
    b.run()
    alone_s = ONE_MS.clean_s + 4 * 7.5 * SLOT_S
    assert b.log == [(pytest.approx(alone_s), 0, End.SERVED)]
    assert job.granted_s == pytest.approx(alone_s)
    assert b.medium.data_busy_s == pytest.approx(alone_s)
    assert b.medium.transmit_s[0] == pytest.approx(ONE_MS.ppdu_s)


@pytest.mark.parametrize("n", [2, 5])
def test_equal_senders_finish_together_at_n_times_their_share(n: int) -> None:
    b = Bench()
    for i in range(n):
        b.submit(i)
    b.run()
    c = contention(n)
    each_s = ONE_MS.clean_s + 4 * c.idle_s + c.collisions * (ONE_MS.ppdu_s + 4 * DIFS_S)
    assert b.log == [(pytest.approx(n * each_s), i, End.SERVED) for i in range(n)]
    assert b.medium.transmit_s[:n] == pytest.approx([ONE_MS.ppdu_s / (1 - c.collision_probability)] * n)


def test_a_latecomer_slows_the_first_one_from_then_on() -> None:
    b = Bench()
    first = ONE_MS.channel_s(contention(1))
    both = ONE_MS.channel_s(contention(2))
    b.submit(0)
    b.at(first / 2)
    b.submit(1)
    b.run()
    end_first = first / 2 + 0.5 * 2 * both
    end_second = end_first + 0.5 * first
    assert [t for t, _, _ in b.log] == pytest.approx([end_first, end_second])


def test_a_senders_jobs_go_one_after_another() -> None:
    b = Bench()
    for _ in range(3):
        b.submit(0)
    b.run()
    one = ONE_MS.channel_s(contention(1))
    assert [(t, k) for t, k, _ in b.log] == [(pytest.approx(one * (i + 1)), i) for i in range(3)]


def test_deadlines_take_jobs_out_wherever_they_are() -> None:
    b = Bench()
    one = ONE_MS.channel_s(contention(1))
    b.submit(0, deadline_s=one / 2)
    b.submit(0, deadline_s=one / 4)
    b.submit(0)
    b.submit(1, deadline_s=0.0)
    b.run()
    assert b.log == [
        (0.0, 3, End.DEADLINE_QUEUED),
        (pytest.approx(one / 4), 1, End.DEADLINE_QUEUED),
        (pytest.approx(one / 2), 0, End.DEADLINE_IN_SERVICE),
        (pytest.approx(1.5 * one), 2, End.SERVED),
    ]


def test_a_job_that_ends_at_its_deadline_is_served() -> None:
    b = Bench()
    b.submit(0, deadline_s=ONE_MS.channel_s(contention(1)))
    b.run()
    assert [how for _, _, how in b.log] == [End.SERVED]


def test_a_replacement_keeps_a_queued_place_and_leaves_the_head() -> None:
    one = ONE_MS.channel_s(contention(1))
    b = Bench()
    b.submit(0)
    old = b.submit(0)
    b.submit(0)
    b.medium.replace(old, b.job(0))
    b.run()
    assert [k for _, k, _ in b.log] == [0, 3, 2]

    b = Bench()
    old = b.submit(0)
    b.submit(0)
    b.at(one / 2)
    b.medium.replace(old, b.job(0))
    b.run()
    assert [(t, k) for t, k, _ in b.log] == [(pytest.approx(1.5 * one), 1), (pytest.approx(2.5 * one), 2)]


def test_a_change_of_the_link_counts_from_then_on() -> None:
    b = Bench()
    b.submit(0)
    one = ONE_MS.channel_s(contention(1))
    b.at(one / 2)
    b.demands[0] = ONE_MS.scaled(3.0)
    b.medium.retune()
    b.run()
    assert b.log == [(pytest.approx(one / 2 + 1.5 * one), 0, End.SERVED)]


# --- context frames ----------------------------------------------------------------------------------


def test_a_context_frame_on_an_idle_medium_takes_aifs_backoff_and_itself() -> None:
    b = Bench()
    b.medium.announce(GroupFrame(0, 432e-6, 3), 0.5)
    b.run()
    assert b.heard == [(pytest.approx(AIFS_CONTEXT_S + 3 * SLOT_S + 432e-6), 0, False)]
    assert b.medium.context_busy_s == pytest.approx(b.heard[0][0])
    assert b.medium.transmit_s[0] == pytest.approx(432e-6)


def test_context_waits_for_the_running_exchange_and_then_holds_the_data_up() -> None:
    b = Bench()
    b.submit(0)
    b.at(0.2e-3)
    b.medium.announce(GroupFrame(1, 432e-6, 0), 0.5)
    b.run()
    residual = 0.5 * ONE_MS.ppdu_s / 4
    blocked = AIFS_CONTEXT_S + 432e-6
    assert b.heard[0][0] == pytest.approx(0.2e-3 + residual + blocked)
    assert b.log[0][0] == pytest.approx(ONE_MS.channel_s(contention(1)) + blocked)
    assert b.medium.data_busy_s == pytest.approx(ONE_MS.channel_s(contention(1)))


def test_the_lowest_counter_goes_first_and_the_others_freeze() -> None:
    b = Bench()
    for sender, slots in ((0, 5), (1, 2), (2, 9)):
        b.medium.announce(GroupFrame(sender, 400e-6, slots), 0.0)
    b.run()
    first = AIFS_CONTEXT_S + 2 * SLOT_S + 400e-6
    second = first + AIFS_CONTEXT_S + 3 * SLOT_S + 400e-6
    third = second + AIFS_CONTEXT_S + 4 * SLOT_S + 400e-6
    assert b.heard == [
        (pytest.approx(first), 1, False),
        (pytest.approx(second), 0, False),
        (pytest.approx(third), 2, False),
    ]


def test_equal_counters_collide() -> None:
    b = Bench()
    for sender, slots in ((0, 4), (1, 4), (2, 6)):
        b.medium.announce(GroupFrame(sender, 400e-6, slots), 0.0)
    b.run()
    assert [(s, c) for _, s, c in b.heard] == [(0, True), (1, True), (2, False)]


@pytest.mark.parametrize("slots", [0, 3])
def test_a_frame_whose_aifs_the_winner_cuts_short_keeps_its_counter(slots: int) -> None:
    """A frame that begins to contend 1 µs before the winner sends is as one that begins 1 µs after."""
    for late_s in (-1e-6, 1e-6):
        b = Bench()
        b.medium.announce(GroupFrame(0, 400e-6, 5), 0.0)
        fires_s = AIFS_CONTEXT_S + 5 * SLOT_S
        b.at(fires_s + late_s)
        b.medium.announce(GroupFrame(1, 400e-6, slots), 0.0)
        b.run()
        first = fires_s + 400e-6
        second = first + AIFS_CONTEXT_S + slots * SLOT_S + 400e-6
        assert b.heard == [(pytest.approx(first), 0, False), (pytest.approx(second), 1, False)]


def test_a_dropped_context_frame_frees_the_air() -> None:
    b = Bench()
    b.medium.announce(GroupFrame(0, 400e-6, 0), 0.0)
    b.medium.announce(GroupFrame(1, 400e-6, 1), 0.0)
    b.medium.drop_context(0)
    b.at(100e-6)
    b.medium.drop_context(1)  # on the air by now: it ends
    b.run()
    assert [s for _, s, _ in b.heard] == [1]


# --- laws --------------------------------------------------------------------------------------------

arrivals = st.lists(
    st.tuples(
        st.floats(0, 20e-3),  # when
        st.integers(0, 4),  # who
        st.floats(1e-4, 5e-3),  # how much
        st.sampled_from([inf, 2e-3, 8e-3]),  # deadline
        st.booleans(),  # context instead
    ),
    min_size=1,
    max_size=30,
)


@settings(max_examples=150, deadline=None)
@given(arrivals, st.floats(1e-3, 60e-3))
def test_work_is_conserved_and_shares_are_equal(traffic: list, stop_s: float) -> None:
    b = Bench()
    jobs: list[AirJob] = []
    granted: list[float] = []

    def play() -> simpy.events.ProcessGenerator:
        for when, who, amount, deadline_s, context in sorted(traffic):
            yield b.env.timeout(max(0.0, when - b.env.now))
            if context:
                b.medium.announce(GroupFrame(who, 300e-6, int(when * 1e6) % 16), 0.3)
            else:
                jobs.append(b.submit(who, Exchanges(2, 0.9 * amount, amount), deadline_s))
            b.medium.sync()
            granted.append(sum(j.granted_s for j in jobs))

    b.env.process(play())
    b.env.run(until=stop_s)
    b.medium.sync()
    assert sum(j.granted_s for j in jobs) == pytest.approx(b.medium.data_busy_s, abs=1e-9)
    assert b.medium.data_busy_s + b.medium.context_busy_s <= stop_s + 1e-9
    assert granted == sorted(granted)
    assert all(0.0 <= j.remaining <= 1.0 for j in jobs)
    for number, when in ((k, t) for t, k, how in b.log if how is End.SERVED):
        assert jobs[number].remaining == 0.0
        assert when <= jobs[number].deadline_s + 1e-9
        assert jobs[number].granted_s >= jobs[number].clean_s * (1 - 1e-9)
    heads = [j for i in range(5) if (j := b.medium.in_service(i))]
    assert all(j.live for j in heads)
    b.env.run(until=5.0)  # nothing is left behind
    assert len(b.log) == len(jobs)
    assert len(b.heard) == sum(c for *_, c in traffic)
    assert b.medium.utilisation < 1.0


def test_it_never_polls() -> None:
    b = Bench()
    for i in range(5):
        for _ in range(10):
            b.submit(i, Exchanges(100, 0.09, 0.1))
    steps = 0
    while b.env.peek() < inf:
        b.env.step()
        steps += 1
    assert len(b.log) == 50
    assert steps < 3 * 50  # about one event a job, however long it lasts


coming = st.lists(
    st.tuples(
        st.integers(0, 4),  # sender
        st.integers(0, 400).map(lambda k: k * 1e-5 + 3e-6),  # when it begins to contend; never with a job's begin
        st.integers(0, 15),
        st.sampled_from([100e-6, 468e-6]),
        st.floats(0.0, 1.0, exclude_max=True),
    ),
    max_size=12,
)
loads = st.lists(st.tuples(st.integers(0, 4), st.integers(0, 300).map(lambda k: k * 1e-5 + 7e-6)), max_size=3)


@settings(max_examples=100, deadline=None)
@given(coming, loads, st.none() | st.tuples(st.integers(0, 4), st.integers(0, 400).map(lambda k: k * 1e-5 + 5e-6)))
def test_frames_to_come_fare_as_those_announced_by_an_event(
    frames: list[tuple[int, float, int, float, float]],
    jobs: list[tuple[int, float]],
    dropped: tuple[int, float] | None,
) -> None:
    """`announce(in_s)` makes no event for the begin; an event that announces at that time must give the same."""
    ends = []
    for by_event in (False, True):
        b = Bench()
        for sender, at_s in jobs:
            b.env.timeout(at_s, sender).callbacks.append(lambda event, b=b: b.submit(event.value))
        gone: set[int] = set()
        for sender, at_s, slots, airtime_s, residual in frames:
            frame = GroupFrame(sender, airtime_s, slots)
            if by_event:

                def announce(
                    _: object, b: Bench = b, frame: GroupFrame = frame, residual: float = residual, gone: set = gone
                ) -> None:
                    if frame.sender not in gone:
                        b.medium.announce(frame, residual)

                b.env.timeout(at_s).callbacks.append(announce)
            else:
                b.medium.announce(frame, residual, at_s)
        if dropped is not None:
            who, at_s = dropped

            def drop(_: object, b: Bench = b, who: int = who, gone: set = gone) -> None:
                gone.add(who)
                b.medium.drop_context(who)

            b.env.timeout(at_s).callbacks.append(drop)
        b.run()
        assert all(0.0 < t <= 10.0 for t, _, _ in b.heard)
        ends.append((b.heard, b.log, b.medium.transmit_s, b.medium.context_busy_s))
    (heard, log, sent_s, busy_s), (heard_2, log_2, sent_2_s, busy_2_s) = ends
    assert [x[1:] for x in sorted(heard)] == [x[1:] for x in sorted(heard_2)]
    assert [t for t, _, _ in sorted(heard)] == pytest.approx([t for t, _, _ in sorted(heard_2)])
    assert [t for t, _, _ in log] == pytest.approx([t for t, _, _ in log_2])
    assert sent_s == pytest.approx(sent_2_s)
    assert busy_s == pytest.approx(busy_2_s)
