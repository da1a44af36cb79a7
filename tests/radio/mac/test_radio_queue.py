"""A station's queue: order, deadlines, replacements and block-ack requests; and laws that hold for any traffic."""

from __future__ import annotations

from math import inf, isnan

import numpy as np
import pytest
import simpy
from hypothesis import given, settings
from hypothesis import strategies as st
from radio_bench import AIFS_S, Bench, exchange_s
from wrong_rows import wrong_rows

from sortie.radio.mac import edca
from sortie.radio.mac.contention import SIFS_S
from sortie.radio.mac.jobs import End
from sortie.radio.mac.medium import Link


def test_a_senders_jobs_go_one_after_another_and_deadlines_take_them_out() -> None:
    b = Bench(-50.0)
    b.submit(0, 640, deadline_s=5e-3)
    b.submit(0, 64, deadline_s=2e-3)
    b.submit(0, 64)
    b.submit(1, 4, deadline_s=0.0)
    b.run()
    assert [(k, how) for _, k, how in b.log] == [
        (3, End.DEADLINE_QUEUED),
        (1, End.DEADLINE_QUEUED),
        (0, End.DEADLINE_IN_SERVICE),
        (2, End.ARRIVED),
    ]
    assert [t for t, _, _ in b.log[:3]] == pytest.approx([0.0, 2e-3, 5e-3], abs=1e-9)


def test_a_replacement_keeps_a_queued_place_and_leaves_the_head() -> None:
    b = Bench(-50.0)
    b.submit(0)
    old = b.submit(0)
    b.submit(0)
    b.medium.replace(old, b.job(0))
    b.run()
    assert [k for _, k, _ in b.log] == [0, 3, 2]

    b = Bench(-50.0)
    old = b.submit(0, 64)
    b.submit(0)
    b.run(exchange_s(64) / 2)
    b.medium.replace(old, b.job(0))
    b.run()
    assert [k for _, k, _ in b.log] == [1, 2]


FAINT_DBM, DEAF_DBM = -72.0, -95.0
"""Too weak for MCS 7, though not for control frames; and too weak for any frame."""


def link_of(power_dbm: float) -> Bench:
    """Three stations: 0 and 1 hear each other with that power, and all others well."""
    power = np.full((3, 3), -50.0)
    power[0, 1] = power[1, 0] = power_dbm
    return Bench(power)


def cut_short(power_dbm: float) -> Bench:
    """A sample of 64 fragments to station 1; its deadline passes while they are on the air for the first time."""
    b = link_of(power_dbm)
    b.submit(0, 64, deadline_s=exchange_s(64) / 2, to=1)
    return b


def test_a_sample_cut_short_by_its_deadline_leaves_a_block_ack_request_before_the_next_sample() -> None:
    b = cut_short(FAINT_DBM)
    b.submit(0, 1, to=2)
    b.run()
    assert [(k, how) for _, k, how in b.log] == [(0, End.DEADLINE_IN_SERVICE), (1, End.ARRIVED)]
    assert b.medium.transmit_s[0] == pytest.approx(exchange_s(64) + 32e-6 + exchange_s(1), abs=1e-8)
    assert b.medium.transmit_s[1:] == pytest.approx([32e-6, 28e-6], abs=1e-8)
    without_s = AIFS_S["best_effort"] + exchange_s(64) + exchange_s(1)
    assert b.log[1][0] > without_s + 2 * 32e-6 + SIFS_S + AIFS_S["best_effort"]


def test_a_sample_that_is_cut_short_while_its_request_waits_takes_two_answers() -> None:
    """The first answer says that nothing has arrived; the second one, that the receiver no longer waits for it."""
    b = link_of(FAINT_DBM)
    no_answer_s = SIFS_S + 9e-6 + 20e-6
    b.submit(0, 64, deadline_s=AIFS_S["best_effort"] + exchange_s(64) + no_answer_s + 10e-6, to=1)
    b.submit(0, 1, to=2)
    b.run()
    assert [(k, how) for _, k, how in b.log] == [(0, End.DEADLINE_IN_SERVICE), (1, End.ARRIVED)]
    assert b.medium.transmit_s[0] == pytest.approx(exchange_s(64) + 2 * 32e-6 + exchange_s(1), abs=1e-8)
    assert b.medium.transmit_s[1] == pytest.approx(2 * 32e-6, abs=1e-8)


def test_a_block_ack_request_is_repeated_while_there_is_more_for_that_receiver_and_delays_what_others_get() -> None:
    b = cut_short(DEAF_DBM)
    b.submit(0, 1, to=2)
    b.submit(0, 1, deadline_s=0.3, to=1)
    b.run()
    assert [(k, how) for _, k, how in b.log] == [
        (0, End.DEADLINE_IN_SERVICE),
        (2, End.DEADLINE_QUEUED),
        (1, End.ARRIVED),
    ]
    assert b.log[2][0] > 0.3
    requests = (b.medium.transmit_s[0] - exchange_s(64) - exchange_s(1)) / 32e-6
    assert requests == pytest.approx(round(requests), abs=1e-3)
    assert requests > 16, "no limit of tries"


def test_how_a_sample_ends_decides_on_its_block_ack_request() -> None:
    """A receiver that cannot be heard is asked once; who withdraws, waits or is silenced asks nobody."""

    def sent_s(power_dbm: float, ends: str) -> float:
        b = link_of(power_dbm)
        if ends == "waits":
            b.submit(0, 64, to=2)
        deadline_s = exchange_s(64) / 2 if ends in ("deadline", "silenced", "waits") else inf
        old = b.submit(0, 64, deadline_s=deadline_s, to=1)
        if ends in ("replaced", "withdrawn", "silenced"):
            b.run(exchange_s(64) * (0.75 if ends == "silenced" else 0.5))
        if ends == "replaced":
            b.medium.replace(old, b.job(0, 1, to=2))
        elif ends == "withdrawn":
            b.medium.withdraw(old)
        elif ends == "silenced":
            b.medium.drop_context(0)
        b.run()
        return b.medium.transmit_s[0] - exchange_s(64)

    wanted = {
        (DEAF_DBM, "deadline"): 32e-6,
        (FAINT_DBM, "replaced"): 32e-6 + exchange_s(1),
        (FAINT_DBM, "withdrawn"): 0.0,
        (FAINT_DBM, "waits"): 0.0,
        (FAINT_DBM, "silenced"): 0.0,
    }
    assert {how: sent_s(*how) for how in wanted} == pytest.approx(wanted, abs=1e-8)


def test_nobody_there_is_found_out_by_one_frame() -> None:
    b = Bench(-50.0)
    job = b.job(0, 500)
    b.medium.tune(job.flow, Link(-1, dead=True))
    b.medium.submit(job)
    b.run()
    assert [(k, how) for _, k, how in b.log] == [(0, End.UNREACHABLE)]
    assert b.medium.transmit_s[0] == pytest.approx(8 * exchange_s(1, 0), abs=1e-8)
    assert job.arrived_frames == 0


def test_frames_are_lost_at_the_power_of_their_tries() -> None:
    def check(loss: float) -> None:
        b = Bench(-50.0, retry_limit=1)
        job = b.job(0, 20_000)
        b.medium.tune(job.flow, Link(7, loss=loss))
        b.medium.submit(job)
        b.run(30.0)
        assert b.log[0][2] is End.OVER
        assert len(job.dropped) == 20_000 - job.arrived_frames
        assert len(job.dropped) / 20_000 == pytest.approx(loss**2, rel=0.1)

    assert wrong_rows([0.1, 0.5], check) == {}


def test_a_dropped_context_frame_frees_the_air() -> None:
    b = Bench(-50.0)
    b.announce(0, 1e-3)
    b.announce(1, 1.1e-3)
    b.medium.drop_context(0)
    b.run(1.3e-3)
    b.medium.drop_context(1)  # on the air by now: it ends
    b.run()
    assert [s for _, s, _ in b.heard] == [1]


def test_what_a_sender_learned_of_a_link_counts_once() -> None:
    b = Bench(-50.0, rate_control="minstrel")
    flow = b.submit(0, 4).flow
    b.run(1.0)
    b.medium.sync()
    assert b.medium.learned(flow).sum(axis=0).tolist() == [4, 4]
    assert not b.medium.learned(flow).any()
    b.submit(0, 3)
    b.run(2.0)
    b.medium.sync()
    assert b.medium.learned(flow).sum(axis=0).tolist() == [3, 3]


def test_a_job_that_never_came_to_the_head_has_no_begin() -> None:
    b = Bench(-50.0)
    first, second = b.submit(0, 3000), b.submit(0, 4, deadline_s=1e-3)
    b.run()
    assert first.t_start_s == 0.0
    assert isnan(second.t_start_s)


def test_a_frame_that_comes_after_the_plan_is_sent_also_where_somebody_looks_before() -> None:
    b = Bench(-50.0)
    b.submit(0, 600)
    b.run(1e-3)
    b.announce(1, in_s=1.0)
    b.run(2e-3)
    b.medium.sync()
    b.run()
    assert [(round(t, 2), sender) for t, sender, _ in b.heard] == [(1.0, 1)]


# --- laws ----------------------------------------------------------------------------------------------


arrivals = st.lists(
    st.tuples(
        st.integers(0, 20_000).map(lambda us: us * 1e-6),  # when
        st.integers(0, 3),  # who
        st.integers(1, 200),  # frames
        st.sampled_from([inf, 2e-3, 8e-3]),  # deadline
        st.booleans(),  # context instead
    ),
    min_size=1,
    max_size=25,
)


POWERS = st.sampled_from([-50.0, -70.0, -84.0])


def _play(b: Bench, traffic: list, looks: list[float]) -> None:
    """Bring traffic in, and look at the medium at other times as well."""
    events = sorted([(t, 1, k) for k, (t, *_) in enumerate(traffic)] + [(t, 0, 0) for t in looks])

    def act() -> simpy.events.ProcessGenerator:
        for t, is_traffic, k in events:
            yield b.env.timeout(max(0.0, t - b.env.now))
            if not is_traffic:
                b.medium.sync()
                continue
            _, who, frames, deadline_s, context = traffic[k]
            if context:
                b.announce(who)
            else:
                b.submit(who, frames, deadline_s)

    b.env.process(act())
    b.run(5.0)


@settings(max_examples=60, deadline=None)
@given(arrivals, st.lists(st.floats(0.0, 0.05), max_size=20), st.tuples(POWERS, POWERS, POWERS), st.booleans())
def test_what_is_run_in_many_steps_is_what_is_run_in_one(
    traffic: list, looks: list[float], powers: tuple[float, float, float], rts: bool
) -> None:
    logs = []
    for steps in ([], looks):
        power = np.full((4, 4), powers[0])
        power[:2, 2:], power[2:, :2] = powers[1], powers[2]
        b = Bench(power, rts=rts)
        _play(b, traffic, steps)
        logs.append((b.log, b.heard, b.medium.transmit_s))
        assert sorted(k for _, k, _ in b.log) == list(range(b.jobs)) or -84.0 in powers
        assert len(b.heard) == sum(c for *_, c in traffic)
    assert logs[0] == logs[1]


@settings(max_examples=40, deadline=None)
@given(arrivals, st.sampled_from([-50.0, -70.0]))
def test_nobody_begins_to_send_on_a_medium_that_it_senses_busy(traffic: list, power_dbm: float) -> None:
    """Every event by itself; answers and a station that begins within the 4 µs that sensing takes are exempt."""
    b = Bench(power_dbm, 4)
    _play(b, traffic, [])
    for _, who, frames, deadline_s, context in traffic:  # once more, at one instant, and event by event
        b.announce(who) if context else b.submit(who, frames, deadline_s)
    b.medium._take_in()
    arrays, table = b.medium._settled.arrays, b.medium._make_table()
    stations = arrays[0]
    busy_since = np.full(4, 10**18)
    for _ in range(3000):
        t = int(arrays[1][edca.NEXT_AT].min())
        if t == edca.FAR:
            break
        before = stations.copy()
        edca.ahead(table, -1, t, t - 1)
        begun = (stations[:, edca.TX_BEGIN] == t) & (stations[:, edca.TX_END] != edca.FAR)
        own = np.isin(stations[:, edca.TX_KIND], (edca.GROUP, edca.BLOCK_REQUEST, edca.RTS, edca.DATA))
        for s in np.flatnonzero(begun & own & (before[:, edca.AWAITS] == edca.NOTHING)):
            assert before[s, edca.IS_BUSY] == 0 or t - busy_since[s] <= edca.CCA
            assert before[s, edca.NAV] <= t
        for s in range(4):
            if stations[s, edca.IS_BUSY] and not before[s, edca.IS_BUSY]:
                busy_since[s] = t
        assert ((arrays[2] >= 0.0) & (arrays[2] < 1e9)).all()


def test_accounts_of_who_is_on_the_air_are_those_of_the_stations() -> None:
    """Event by event: who sends, and how many and how strong they are at each station. The last power is faint."""

    def check(power_dbm: float) -> None:
        b, most = Bench(power_dbm, 6), 0
        for i in range(6):
            b.announce(i, in_s=1e-4 * (6 - i))
        b.submit(2, 100)
        b.medium._take_in()
        arrays, table = b.medium._settled.arrays, b.medium._make_table()
        stations, next_at, power, received, totals = arrays[0], arrays[1], arrays[2], arrays[3].reshape(6, 6), arrays[5]
        for _ in range(400):  # a payload that nobody hears is sent again and again
            t = int(next_at[edca.NEXT_AT].min())
            if t == edca.FAR:
                break
            edca.ahead(table, -1, t, t - 1)
            senders = np.flatnonzero(stations[:, edca.TX_END] != edca.FAR)
            assert totals[edca.G_FIRST :][: totals[edca.G_SENDERS]].tolist() == senders.tolist()
            from_others = (np.arange(6) != senders[:, None]).astype(float)
            assert next_at[edca.INCIDENT].tolist() == from_others.sum(axis=0).tolist()
            np.testing.assert_allclose(
                power, (from_others * received[senders]).sum(axis=0), rtol=1e-12, atol=1e-12 * received.max()
            )
            most = max(most, len(senders))
        assert most > (1 if power_dbm == -50.0 else 3)

    assert wrong_rows([-50.0, -89.0, -100.0], check) == {}
