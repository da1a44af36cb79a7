"""Clocks: how they run, what a receiver finds out about them from lags alone, and what it reports."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from agent_rig import Rig, capture, descriptor, memory, payload
from hypothesis import given
from hypothesis import strategies as st

from sortie.fleet.clock import WINDOW, Clock, PeerClocks, oscillators
from sortie.fleet.memory import PeerMemory, Received, hear
from sortie.fleet.messages.auth import Opened
from sortie.fleet.peers import PeerTable
from sortie.fleet.plane import DroneStatus, FleetRules
from sortie.policies.contract import Directive, Representation
from sortie.scenarios.schema import (
    Clocks,
)

FRAME_S = 0.1


FEATURES = Directive(0, 1, Representation.FEATURES, 1.0, None, 10.0, 0.1, 1.0)


# --- how clocks run ---------------------------------------------------------------------------------------


@given(st.floats(-1, 1), st.floats(-1e5, 1e5), st.floats(-1e5, 1e5), st.floats(0, 100), st.floats(0, 100))
def test_a_clock_told_anew_runs_on_as_it_was(
    offset_s: float, rate_ppm: float, growth: float, first_s: float, more_s: float
) -> None:
    clock = Clock(offset_s, 5.0, rate_ppm, growth)
    then_s = 5.0 + first_s + more_s
    assert clock.at(5.0 + first_s).error_s(then_s) == pytest.approx(clock.error_s(then_s), abs=1e-6)


def test_rate_and_growth_are_per_million_and_per_minute() -> None:
    assert Clock(0.5, 10.0, 20.0).error_s(110.0) == pytest.approx(0.5 + 100 * 20e-6)
    assert Clock(rate_ppm=20.0, growth_ppm_per_min=6.0).error_s(60.0) == pytest.approx(60 * (20 + 3) * 1e-6)


def test_oscillators_are_drawn_drone_by_drone() -> None:
    drawn = oscillators(Clocks(offset_s=0.2, drift_ppm=50.0, drift_growth_ppm_per_min=3.0), 400, 1, 0)
    assert np.std(drawn, axis=0) == pytest.approx([0.2, 50.0, 3.0], rel=0.15)
    assert oscillators(Clocks(offset_s=0.2), 3, 1, 0)[0] == oscillators(Clocks(offset_s=0.2), 9, 1, 0)[0]
    assert all(o.at_start(gnss=True).error_s(9.0) == 0.0 for o in oscillators(Clocks(), 5, 1, 0))
    for gnss in (True, False):
        clock = drawn[0].at_start(gnss)
        assert clock.error_s(0.0) == drawn[0].offset_s
        assert (clock.error_s(600.0) == drawn[0].offset_s) is gnss, "it drifts without GNSS alone"


def test_clocks_draw_offset_rate_and_growth_each_for_every_drone() -> None:
    config = Clocks(offset_s=1.0, drift_ppm=1.0, drift_growth_ppm_per_min=1.0)
    drawn = np.array([oscillators(config, 400, seed, 0) for seed in (1, 2)])
    assert len(np.unique(drawn)) == drawn.size
    correlation = np.corrcoef(drawn.transpose(0, 2, 1).reshape(6, -1))
    np.fill_diagonal(correlation, 0.0)
    assert np.abs(correlation).max() < 0.2
    assert len(np.unique([oscillators(config, 3, 1, r) for r in range(3)])) == 27


# --- what lags show ---------------------------------------------------------------------------------------


delays = st.lists(st.floats(0.001, FRAME_S), min_size=WINDOW, max_size=3 * WINDOW)


@given(st.floats(-2, 2), delays)
def test_corrected_ages_agree_with_truth_within_the_spread_of_delays(offset_s: float, delays_s: list[float]) -> None:
    """Whatever the offset and however delays fall: to half a frame where it shows, and to a frame where it does not."""
    clocks = PeerClocks(FRAME_S)
    for delay_s in delays_s:
        clocks.heard(1, offset_s + delay_s)
    known_s = clocks.offset_s.get(1)
    if known_s is None:
        assert abs(offset_s) <= 2 * FRAME_S
    else:
        assert abs(known_s - offset_s) <= FRAME_S / 2 + 1e-9
    age_error_s = abs(offset_s - (known_s or 0.0))
    assert age_error_s <= FRAME_S + 1e-9 or min(offset_s + d for d in delays_s) <= FRAME_S


@given(delays)
def test_clocks_that_agree_are_left_alone(delays_s: list[float]) -> None:
    clocks = PeerClocks(FRAME_S)
    for delay_s in delays_s:
        clocks.heard(1, delay_s)
    assert clocks.offset_s == {}


def test_a_few_late_descriptors_are_no_offset_and_a_clock_that_comes_back_is_believed_at_once() -> None:
    clocks = PeerClocks(FRAME_S)
    for lag_s in [0.04, *[0.3] * (WINDOW - 1), 0.04]:
        clocks.heard(1, lag_s)
    assert clocks.offset_s == {}
    for _ in range(WINDOW):
        clocks.heard(1, 0.29)
    assert clocks.offset_s[1] == pytest.approx(0.24)
    clocks.heard(1, 0.04)
    assert clocks.offset_s == {}


def test_a_clock_that_agrees_again_is_no_longer_watched() -> None:
    watched = np.zeros(256, np.uint8)
    clocks = PeerClocks(0.1, np.zeros(256), watched)
    for _ in range(WINDOW):
        clocks.heard(4, 1.5)
    assert (clocks.offset_s[4], watched[4]) == (pytest.approx(1.45), 1)
    clocks.heard(4, 0.05)
    assert (clocks.offset_s, watched[4], clocks._ahead_s[4]) == ({}, 0, 0.0)


def test_the_smallest_lag_tells_the_offset_and_only_peers_that_are_asked_for_count() -> None:
    clocks = PeerClocks(0.1)
    for k in range(WINDOW):
        clocks.heard(1, 2.0 + 0.09 * (k % 2) + 0.1 * (k == 3))
        clocks.heard(2, 5.0)
    assert clocks.offset_s == {1: pytest.approx(1.95), 2: pytest.approx(4.95)}
    assert clocks.own_offset_s([1]) == pytest.approx(1.95 / 2)  # the median of it and of none
    assert clocks.own_offset_s([1, 2]) == pytest.approx(1.95)
    assert clocks.own_offset_s([3]) == 0.0


def test_ages_are_true_whoever_s_clock_is_off() -> None:
    """Of descriptors and payloads, once a peer's clock is known: to half a frame; at least the time since they came."""
    for mine_s, theirs_s in product((0.0, 3.0, -2.0), (0.0, 5.0, -4.0)):
        mine = memory()
        mine.status.clock_skew_s = mine_s
        for k in range(WINDOW + 2):
            t_s = 0.1 * k
            d = descriptor(1, t_s + theirs_s)
            mine.clocks.heard(1, t_s + 0.03 + mine_s - d.stamp_ns * 1e-9)
            mine.hold(d, t_s + 0.03)
        last_s = 0.1 * (WINDOW + 1)
        now_s = last_s + 0.4
        assert mine.ages_s(now_s)[1] == pytest.approx(0.4, abs=0.051)
        assert mine.ages_s(now_s)[1] >= 0.37 - 1e-9
        assert mine.ages_s(last_s + 0.03)[1] >= 0.0
        assert mine.in_own_time(1, last_s + theirs_s) == pytest.approx(last_s, abs=0.051)
        came = Received(capture(1, last_s), payload(), last_s + 0.06, last_s + theirs_s)
        assert mine.payload_age_s(came, now_s) == pytest.approx(0.4, abs=0.051)
        assert mine.payload_age_s(came, now_s) >= 0.34 - 1e-9
        late = Received(capture(1, last_s), payload(), now_s, last_s + 100.0)  # a stamp of the future
        assert mine.payload_age_s(late, now_s + 0.2) == pytest.approx(0.2)


def test_an_offset_shows_by_the_listener_s_own_clock() -> None:
    """Of datagrams as they come in, at two listeners of one table whose clocks differ."""
    for mine_s, theirs_s in product((0.0, 3.0, -2.0), (0.0, 5.0)):
        table = PeerTable(2, 10, 0)
        rules = FleetRules(0.1, 100, 3.0, 10.0, 0.3, 0.2, 0.04)
        listeners = [PeerMemory(i, rules, DroneStatus(clock_skew_s=s), table) for i, s in enumerate((0.0, mine_s))]
        for k in range(WINDOW + 2):
            now_s = 20 + 0.1 * k
            assert hear(listeners, Opened(descriptor(3, now_s + theirs_s), None, 0), now_s + 0.03) == []
        for mine, skew_s in zip(listeners, (0.0, mine_s), strict=True):
            assert mine.clocks.offset_s.get(3, 0.0) == pytest.approx(skew_s - theirs_s, abs=0.051)
            assert (3 in mine.clocks.offset_s) == (skew_s != theirs_s)
            assert mine.ages_s(now_s + 0.4)[3] == pytest.approx(0.4, abs=0.051)


def test_a_listener_s_clock_that_goes_wrong_in_flight_shows_too() -> None:
    """Its peers' stamps and arrivals are as before; its own clock is what makes their lags unusual."""
    for begins in (3, 15):
        mine = memory()
        for k in range(begins + WINDOW + 2):
            now_s = 20 + 0.1 * k
            mine.status.clock_skew_s = 2.0 if k >= begins else 0.0
            assert mine.hear(Opened(descriptor(3, now_s), None, 0), now_s + 0.03) is None
            if k == begins - 1:
                assert mine.clocks.offset_s == {}
        assert mine.clocks.offset_s == {3: pytest.approx(2.0, abs=0.051)}
        assert mine.ages_s(now_s + 0.4)[3] == pytest.approx(0.4, abs=0.051)


def test_a_stamp_of_the_future_makes_no_descriptor_younger_than_it_is() -> None:
    """Also where offsets of other peers are known."""
    mine = memory()
    for k in range(WINDOW):
        mine.clocks.heard(2, 0.1 * k + 0.5 - 0.1 * k)
    assert 2 in mine.clocks.offset_s
    mine.hold(descriptor(2, 0.0), 0.0)
    mine.hold(descriptor(1, 50.0), 1.0)
    assert mine.ages_s(1.7)[1] == pytest.approx(0.7)


# --- what is reported -------------------------------------------------------------------------------------


class Reports(Rig):
    """Keeps its events: when, and the text."""

    def __init__(self, *given: Any, **rules: Any) -> None:
        self.reported: list[tuple[float, str]] = []
        super().__init__(*given, dwell_s=0.0, **rules)

    def event(self, t_s: float, drone: int, kind: str, text: str) -> None:
        assert (drone, kind) == (0, "clock")
        self.reported.append((round(t_s, 2), text))


AGREES = "clock agrees with the fleet's again"


def off(way: str) -> str:
    return f"clock {way} the fleet's, ± 0.05 s: ages are corrected for it"


OFFSETS: list[tuple[list[float], dict[int, str]]] = [
    # an offset is known to half a frame: up to 0.05 s on either side is no fault
    ([0.0, 0.05, -0.05, 0.049], {}),
    ([0.06], {0: off("0.06 s ahead of")}),
    ([-0.06], {0: off("0.06 s behind")}),
    # it is reported again once it has changed by more than that, and not before
    ([0.06, 0.1, 0.11, 0.12, 0.12], {0: off("0.06 s ahead of"), 3: off("0.12 s ahead of")}),
    ([-0.2, -0.16, -0.24, -0.26], {0: off("0.20 s behind"), 3: off("0.26 s behind")}),
    ([0.06, -0.06, 0.0], {0: off("0.06 s ahead of"), 1: off("0.06 s behind"), 2: AGREES}),
    # its end is reported, and then the begin of the next fault
    ([3.0, 0.0, 0.0, 0.05, 0.06], {0: off("3.00 s ahead of"), 1: AGREES, 4: off("0.06 s ahead of")}),
]
"""The offset that three peers show in each second, and what is reported in which second."""


def test_a_drone_reports_its_clock_once_it_is_off_by_more_than_can_be_measured() -> None:
    wrong = {}
    for offsets_s, reported in OFFSETS:
        rig = Reports(lambda view: [])
        for second, offset_s in enumerate(offsets_s):
            rig.hear(1, 2, 3)
            rig.memory.clocks.offset_s = dict.fromkeys((1, 2, 3), offset_s)
            rig.env.run(until=second + 0.95)
        if rig.reported != [(second + 0.01, text) for second, text in reported.items()]:
            wrong[tuple(offsets_s)] = rig.reported
    assert wrong == {}


def test_the_offset_of_a_clock_is_the_median_over_itself_and_its_peers() -> None:
    """It is a second ahead of some of three peers, and agrees with the others and with itself."""
    for peers, offset_s in ((1, 0.0), (2, 0.5), (3, 1.0)):
        rig = Reports(lambda view: [])
        rig.hear(1, 2, 3)
        rig.memory.clocks.offset_s = dict.fromkeys(range(1, peers + 1), 1.0)
        rig.env.run(until=0.5)
        assert rig.reported == [(0.01, off(f"{offset_s:.2f} s ahead of"))] * (offset_s > 0.0)


AGES: list[tuple[list[float], list[int]]] = [
    # a descriptor may take a frame; one that comes older than that, and old enough to reduce the link, is reported
    ([0.0, 0.1, 0.29], []),
    ([0.0, 0.32], [1]),
    ([1.05], [0]),
    # once while it lasts, and again after it was over
    ([0.32, 0.35, 0.4], [0]),
    ([0.32, 0.0, 0.32], [0, 2]),
    # stamps of the future make nothing old
    ([-0.5, -3.0], []),
]
"""How old a peer's descriptors are by their stamps when they come, frame by frame, and which of them are reported."""


def test_a_link_that_a_faulty_clock_reduces_is_reported_once() -> None:
    """A link that silence reduces is not reported."""
    for stamps_s, reported in AGES:
        rig = Reports(lambda view: [FEATURES] if 1 in view.peers else [])
        for k, late_s in enumerate(stamps_s):
            rig.env.run(until=0.1 * k + 0.004)
            rig.memory.hold(descriptor(1, rig.env.now - late_s), rig.env.now)
        rig.env.run(until=0.1 * len(stamps_s))
        of_clocks = len(rig.reported)
        if stamps_s[-1] <= 0.1:  # else age adds to what its clock makes of it
            rig.env.run(until=3.0)
            assert len(rig.reported) == of_clocks, stamps_s
        wanted = []
        for k in reported:
            link, old_s = "detached" if stamps_s[k] > 1.0 else "degraded", stamps_s[k] + 0.006
            came = f"link to 1 {link}: its descriptor came 0.01 s ago and is {old_s:.2f} s old by its stamp: "
            wanted.append((round(0.1 * k + 0.01, 2), f"{came}a clock is wrong, or it waited for the channel"))
        assert rig.reported[:of_clocks] == wanted, stamps_s
