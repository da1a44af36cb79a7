"""Clocks: how they run, and what a receiver finds out about them from lags alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sortie.fleet.clock import WINDOW, Clock, PeerClocks, oscillators
from sortie.scenarios.schema import Clocks

FRAME_S = 0.1


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
    assert drawn[0].at_start(gnss=True).error_s(60.0) == drawn[0].offset_s
    assert all(o.at_start(gnss=True).error_s(9.0) == 0.0 for o in oscillators(Clocks(), 5, 1, 0))


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


def test_the_own_clock_is_off_where_it_is_off_against_most() -> None:
    clocks = PeerClocks(FRAME_S)
    for _ in range(WINDOW):
        clocks.heard(3, 0.3)
    assert clocks.own_offset_s([1, 2, 3, 4]) == 0.0, "one peer's clock is wrong"
    for peer in (1, 2):
        for _ in range(WINDOW):
            clocks.heard(peer, 0.3)
    assert clocks.own_offset_s([1, 2, 3, 4]) == pytest.approx(0.25)
