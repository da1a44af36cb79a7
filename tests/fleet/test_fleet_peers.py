"""What drones heard of each other, as arrays: as the words say, bit by bit, and untouched where nothing was heard."""

from __future__ import annotations

import numpy as np
import pytest
from agent_rig import descriptor, memory
from hypothesis import given, settings
from hypothesis import strategies as st

from sortie.fleet.memory import PeerMemory, hear
from sortie.fleet.messages.auth import Opened
from sortie.fleet.peers import PeerTable, loops
from sortie.fleet.plane import DroneStatus, FleetRules
from sortie.policies.contract import FleetView
from sortie.policies.geometry import note_circles, peers_by_overlap
from sortie.policies.staleness import LinkHealth, health
from sortie.radio.goodput import Goodput
from sortie.scenarios.link_state import MEASURED_FOR_S, SILENT_MBPS, LinkState, heard_share, probed_mbps, state_of

PERIOD_S = 0.1


def fleet(drones: int, periods: float = 10.0) -> list[PeerMemory]:
    rules = FleetRules(PERIOD_S, 1000, 3.0, periods, 0.3, 0.2, 0.04)
    table = PeerTable(drones, max(1, round(periods)))
    return [PeerMemory(i, rules, DroneStatus(), table) for i in range(drones)]


@settings(max_examples=60)
@given(
    st.sampled_from([1, 2, 10, 63, 64, 65, 130]),
    st.lists(st.tuples(st.integers(1, 80), st.integers(1, 80)), min_size=1, max_size=4),
    st.integers(0, 140),
)
def test_probes_are_a_row_of_bits_however_far_they_look_back(
    periods: int, series: list[tuple[int, int]], later: int
) -> None:
    """Held against whole numbers of any size, as the words of `sortie.fleet.probes` have it."""
    (mine,), bits, frame = fleet(1, periods), 0, 0
    for gap in [gap for run, missed in series for gap in (*[1] * run, missed)]:
        frame += gap
        hear([mine], Opened(descriptor(1, frame * PERIOD_S), None, 0), frame * PERIOD_S)
        bits = (bits << min(gap, periods) | 1) & ((1 << periods) - 1)
    now_s = (frame + later + 0.6) * PERIOD_S
    arrived = (bits << min(later, periods) & ((1 << periods) - 1)).bit_count()
    assert mine.probes.fill(np.array([1]), (0.0,), now_s) == (probed_mbps(arrived / periods),)


def filled(mine: PeerMemory, goodput_mbps: tuple[float, ...], now_s: float) -> tuple[float, ...]:
    peers = [i for i in range(len(goodput_mbps) + 1) if i != mine.drone]
    return mine.probes.fill(np.array(peers), goodput_mbps, now_s)


def heard(mine: PeerMemory, peer: int, t_s: float) -> None:
    """A descriptor of this time arrives at once."""
    assert mine.hear(Opened(descriptor(peer, t_s), None, 0), t_s) is None


def test_probes_count_the_descriptors_heard_and_missed() -> None:
    mine = memory()
    for k in range(30):
        if k % 5:  # every fifth is missed
            heard(mine, 1, 0.003 * (k % 2) + 0.1 * k)

    def share(now_s: float) -> float | None:
        return heard_share(filled(mine, (0.0, 0.0), now_s)[0])

    assert share(2.93) == pytest.approx(0.8)
    assert share(3.42) == pytest.approx(0.5)  # 3.0 and four more are missed by now
    assert filled(mine, (0.0, 0.0), 3.98) == (SILENT_MBPS, 0.0) == filled(mine, (0.0, 0.0), 1e6)


def test_probes_stand_where_nothing_was_measured_and_have_no_rate() -> None:
    """Whoever one is: a slot is of the peer that it is of."""
    for me in range(5):
        often, seldom, measured = ((me + k) % 5 for k in (1, 2, 3))
        mine = memory(me)
        for k in range(10):
            heard(mine, often, 0.1 * k)
            if k < 5:
                heard(mine, seldom, 0.1 * k)
        peers = [i for i in range(5) if i != me]
        links = tuple(40.0 * (i == measured) for i in peers)
        known = dict(zip(peers, filled(mine, links, 0.95), strict=True))
        states = {often: LinkState.PROBED, seldom: LinkState.PROBED, measured: LinkState.MEASURED}
        assert {i: state_of(mbps) for i, mbps in known.items()} == dict.fromkeys(peers, LinkState.UNKNOWN) | states
        shares = {i: heard_share(mbps) for i, mbps in known.items()}
        assert shares == dict.fromkeys(peers) | {often: pytest.approx(1.0), seldom: pytest.approx(0.5)}
        later = dict(zip(peers, filled(mine, links, 3.0), strict=True))
        assert later == dict.fromkeys(peers, 0.0) | {often: SILENT_MBPS, seldom: SILENT_MBPS, measured: 40.0}


def test_a_measurement_expires_and_the_next_one_is_taken_as_it_is() -> None:
    links = Goodput(2)
    links.measured(0, 1, 70.0, 1.0)
    assert links.read(0, 1.0 + MEASURED_FOR_S) == {1: 70.0}
    assert links.read(0, 1.01 + MEASURED_FOR_S) == {}
    links.measured(0, 1, 90.0, 10.0)
    assert links.read(0, 10.0) == {1: 90.0}


def test_one_datagram_is_one_object_at_all_that_hear_it() -> None:
    memories = fleet(40)
    opened = Opened(descriptor(7, 0.5), 1, 1)
    assert hear(memories, opened, 0.55) == []
    assert all(m.view(0.6).descriptors[7] is opened.descriptor for m in memories if m.drone != 7)
    assert 7 not in memories[7].view(0.6).descriptors, "nobody hears itself"


def test_replays_and_ages_are_each_receiver_s_own() -> None:
    """Also where one heard the datagram later than another, by another clock."""
    one, two, three = fleet(4)[:3]
    two.status.clock_skew_s = 0.02
    first, second = (Opened(descriptor(3, 0.1 * k), 1, k) for k in (1, 2))
    assert hear([one, two], second, 0.25) == []
    assert [drone for drone, _ in hear([one, two, three], first, 0.3)] == [0, 1]
    assert hear([three], second, 0.35) == []
    ages = [m.ages_s(0.5)[3] for m in (one, two, three)]
    assert ages == [0.5 - 0.2, 0.5 + 0.02 - 0.2, 0.5 - 0.2]
    assert [m.heard_ago_s(3, 0.5) for m in (one, two, three)] == pytest.approx([0.25, 0.25, 0.15])


def test_who_hears_nothing_of_a_drone_has_nothing_to_do_with_it() -> None:
    memories = fleet(6)
    for k in range(1, 20):
        hear(memories[:3], Opened(descriptor(0, 0.1 * k), 1, k), 0.1 * k + 0.01)
        hear(memories[3:], Opened(descriptor(5, 0.1 * k), 1, k), 0.1 * k + 0.01)
    table = memories[0].table
    assert [m.ids.tolist() for m in memories] == [[], [0], [0], [5], [5], []]
    heard = np.zeros(table.heard_s.shape, bool)
    heard[1:3, 0] = heard[3:5, 5] = True
    for array in (table.heard_s, table.stamps_s, table.bits[..., 0]):
        assert (array != 0).tolist() == heard.tolist()


@settings(max_examples=60)
@given(st.data())
def test_links_are_looked_at_where_age_or_a_clock_can_change_them(data: st.DataObject) -> None:
    n, now_s, delay_s, me = 8, 20.0, 0.1, 3
    flags = st.lists(st.booleans(), min_size=n, max_size=n)
    busy, at_rest, blamed = (np.array(data.draw(flags), np.uint8) for _ in range(3))
    stamp_ages = np.array(data.draw(st.lists(st.floats(0.0, 2.0) | st.just(0.3), min_size=n, max_size=n)))
    heard_s = now_s - np.array(data.draw(st.lists(st.floats(0.0, 2.0), min_size=n, max_size=n)))
    ids = np.arange(n)
    ages = loops().ages(now_s, now_s, ids, heard_s, now_s - stamp_ages, np.zeros(n))
    expected = []
    for i in range(n):
        age_s = max(now_s - (now_s - stamp_ages[i]), now_s - heard_s[i])
        assert ages[i] == age_s
        is_aged = age_s > PERIOD_S * 3.0
        is_stale = health(age_s, PERIOD_S, 3.0, 10.0) != LinkHealth.FRESH
        is_blamed = is_stale and age_s - (now_s - heard_s[i]) > delay_s
        if i != me and (busy[i] or (is_aged and not at_rest[i]) or is_blamed != bool(blamed[i])):
            expected.append(i)
    found = np.empty(len(ids), np.int64)
    count = loops().overdue(
        me, now_s, PERIOD_S * 3.0, PERIOD_S, 3.0, delay_s, ids, ages, heard_s, busy, at_rest, blamed, found
    )
    assert found[:count].tolist() == expected


@settings(max_examples=60)
@given(st.lists(st.tuples(*[st.sampled_from([-30.0, -10.0, 0.0, 9.5, 10.0, 10.5, 30.0])] * 2), min_size=1, max_size=9))
def test_claims_are_near_within_a_square_its_edge_included(places: list[tuple[float, float]]) -> None:
    circles = np.array([(x_m, y_m, 1.0) for x_m, y_m in places])
    ids = np.arange(len(places))[::2]
    expected = [k for k, i in enumerate(ids) if max(abs(places[i][0]), abs(places[i][1] - 0.5)) <= 10.0]
    assert loops().near(ids, circles, 0.0, 0.5, 10.0).tolist() == expected


def test_peers_are_ranked_by_the_noted_array_only_where_all_descriptors_are_those_that_it_is_of() -> None:
    known = {i: descriptor(i, 0.0, position_m=(10.0 * i, 0.0, 60.0)) for i in range(4)}
    view = FleetView(0, 0.1, known, dict.fromkeys(known, 0.0))
    part = view._replace(descriptors={i: known[i] for i in (0, 1, 3)})
    moved = view._replace(descriptors={**known, 3: known[3]._replace(position_m=(0.0, 0.0, 60.0))})
    by_descriptors = [peers_by_overlap(v) for v in (view, part, moved)]
    assert by_descriptors == [[1, 2, 3], [1, 3], [3, 1, 2]]
    backwards = np.array([(0.0, 0.0, 42.0), (60.0, 0.0, 42.0), (40.0, 0.0, 42.0), (20.0, 0.0, 42.0)])
    note_circles(known, np.arange(4), backwards)
    assert [peers_by_overlap(v) for v in (view, part, moved)] == [[3, 2, 1], [3, 1], [3, 1, 2]]
    note_circles({}, np.arange(0), np.zeros((0, 3)))


@pytest.mark.parametrize("doubted", [False, True])
def test_a_view_is_ranked_as_its_descriptors_say(doubted: bool) -> None:
    (mine,), rng = fleet(1), np.random.default_rng(5)
    for second in range(3):
        for i in range(6):
            at = (*rng.uniform(-60.0, 60.0, 2), 60.0)
            claim = descriptor(i, second + 0.01 * i, position_m=at, footprint_radius_m=float(rng.uniform(20.0, 60.0)))
            _ = mine.hold(claim, float(second)) if i == 0 else mine.hear(Opened(claim, None, 0), float(second) + 0.05)
        mine._doubted = frozenset({2} if doubted else ())
        view = mine.view(float(second))
        ranked = peers_by_overlap(view)
        note_circles({}, np.arange(0), np.zeros((0, 3)))
        assert ranked == peers_by_overlap(view)
