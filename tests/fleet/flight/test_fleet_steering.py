"""Steering: commands are flown within speed and acceleration, end where they say, and break no bound of place."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sortie.fleet.flight.steering import (
    VELOCITY_LASTS_S,
    GoTo,
    Hold,
    SteeredWay,
    Velocity,
    nearest_m,
    refusal,
    steer,
    steered_area_m,
)
from sortie.scenarios.schema import Fleet, Steering

STILL = SteeredWay(0.0, (0.0, 0.0, 60.0), (0.0, 0.0, 0.0))
LIMITS = Steering()

places = st.tuples(st.floats(-150, 150), st.floats(-150, 150), st.floats(20, 110))
commands = st.one_of(
    st.builds(lambda p, v: GoTo(*p, v), places, st.none() | st.floats(0.5, 20)),
    st.builds(Velocity, st.floats(-12, 12), st.floats(-12, 12), st.floats(-6, 6)),
    st.just(Hold()),
)


def test_a_command_of_a_crawl_is_judged_at_few_instants() -> None:
    """A way of 100,000 s is straight but for its begin and its end; a million instants of it would take 100 MB."""
    crawl = steer(STILL, GoTo(100.0, 0.0, 60.0, 1e-3), 0.0, LIMITS)
    assert crawl.rests_s > 99_000.0
    tracemalloc.start()
    try:
        assert refusal(crawl, 0.0, np.array(STILL.place_m), Fleet()) == ""
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(commands, st.floats(0, 30)), min_size=1, max_size=5))
def test_whatever_is_commanded_is_within_the_bounds(given_commands: list[tuple[GoTo | Velocity | Hold, float]]) -> None:
    """Every 0.02 s, through commands that come at any time, within changes of velocity too."""
    way, now_s = STILL, 0.0
    for command, later_s in given_commands:
        before = way.at(np.array([now_s]))
        way = steer(way, command, now_s, LIMITS)
        after = way.at(np.array([now_s]))
        for was, is_now in zip(before, after, strict=True):  # place, velocity and acceleration do not jump
            np.testing.assert_allclose(was, is_now, atol=1e-6)
        time_s = np.arange(now_s, now_s + 60, 0.02)
        place, speed, push = way.at(time_s)
        assert np.hypot(speed[:, 0], speed[:, 1]).max() <= 8.0 + 1e-6
        assert np.abs(speed[:, 2]).max() <= 3.0 + 1e-6
        assert np.linalg.norm(push, axis=-1).max() <= 2.0 + 1e-6
        numeric = np.diff(place, axis=0) / 0.02
        np.testing.assert_allclose(numeric, (speed[1:] + speed[:-1]) / 2, atol=2e-3)
        now_s += later_s
    end = way.at(np.array([now_s + 1000.0, now_s + 1100.0]))
    np.testing.assert_allclose(end[0][0], end[0][1], atol=1e-6)  # it ends at rest
    if isinstance(given_commands[-1][0], GoTo):
        np.testing.assert_allclose(end[0][1], given_commands[-1][0][:3], atol=1e-6)


@pytest.mark.parametrize(
    ("command", "takes_s"),
    [
        (GoTo(200.0, 0.0), 200 / 8 + 2.25 * 8 / 2),  # cruise, and half of each change
        (GoTo(3.0, 4.0), 2 * math.sqrt(2.25 * 5 / 2)),  # no cruise: twice the root of 2.25 · 5 m / 2 m/s²
        (GoTo(0.0, 0.0, 90.0), 30 / 3 + 2.25 * 3 / 2),  # climbs
        (GoTo(80.0, 0.0, None, 4.0), 80 / 4 + 2.25 * 4 / 2),
    ],
)
def test_a_place_is_reached_as_fast_as_the_bounds_allow(command: GoTo, takes_s: float) -> None:
    last = steer(STILL, command, 0.0, LIMITS).changes[-1]
    assert last.begin_s + last.width_s == pytest.approx(takes_s, rel=1e-4)


def test_a_velocity_lasts_two_seconds_and_ends_at_rest() -> None:
    way = steer(STILL, Velocity(0.2, 0.0), 0.0, LIMITS)
    first_s = 2.25 * 0.2 / 2
    place, speed, _ = way.at(np.array([1.0, VELOCITY_LASTS_S + first_s + 1e-6]))
    np.testing.assert_allclose(speed, [(0.2, 0, 0), (0, 0, 0)], atol=1e-9)
    assert place[1, 0] == pytest.approx(0.2 * VELOCITY_LASTS_S)
    fast = steer(STILL, Velocity(60.0, 80.0, 1.0), 0.0, LIMITS).changes[0].by_mps
    assert math.hypot(*fast[:2]) == pytest.approx(8.0)
    assert fast[0] / fast[1] == pytest.approx(0.75)


@pytest.mark.parametrize(
    ("command", "changes", "said"),
    [
        (GoTo(100.0, 0.0), {}, ""),
        (GoTo(201.0, 0.0), {}, "would leave its reach of 200 m"),
        (GoTo(0.0, 0.0, 121.0), {}, "would leave the altitudes of 10 to 120 m"),
        (GoTo(0.0, 0.0, 9.0), {}, "would leave the altitudes of 10 to 120 m"),
        (GoTo(60.0, 0.0), {"fence_m": [-50, -50, 50, 50]}, "would leave the fence"),
        (GoTo(49.0, 0.0), {"fence_m": [-50, -50, 50, 50]}, "would leave the fence"),  # the jitter needs room
        (GoTo(47.0, 0.0), {"fence_m": [-50, -50, 50, 50]}, ""),
        (Velocity(0.0, 8.0), {"fence_m": [-50, -50, 50, 20]}, "would leave the fence"),
    ],
)
def test_ways_keep_within_reach_altitudes_and_fence(
    command: GoTo | Velocity, changes: dict[str, list[float]], said: str
) -> None:
    fleet = Fleet.model_validate({"steering": changes})
    way = steer(STILL, command, 0.0, fleet.steering)
    assert refusal(way, 0.0, np.array(STILL.place_m), fleet) == said


def test_who_is_outside_may_come_back() -> None:
    fleet = Fleet.model_validate({"steering": {"reach_m": 20, "fence_m": [-9, -9, 9, 9]}})
    outside = SteeredWay(0.0, (30.0, 0.0, 60.0), (0.0, 0.0, 0.0))
    start = np.array(STILL.place_m)
    assert not refusal(steer(outside, GoTo(0.0, 0.0), 0.0, fleet.steering), 0.0, start, fleet)
    assert refusal(steer(outside, GoTo(31.0, 0.0), 0.0, fleet.steering), 0.0, start, fleet)


def test_the_nearest_approach_is_found_between_frames() -> None:
    """Two drones cross between two frames: by hand."""
    ours = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    others = np.array([[[2.0, 1.0, 0.0], [9.0, 0.0, 0.0]], [[0.0, 1.0, 0.0], [9.0, 0.0, 0.0]]])
    np.testing.assert_allclose(nearest_m(ours, others), [1.0, 7.0])


def test_the_area_of_planners_is_their_reach_within_the_fence() -> None:
    fleet = Fleet.model_validate({"drones": 2, "formation": {"spacing_m": 20}, "steering": {"reach_m": 100, "fence_m": [-60, -500, 500, 500]}})  # fmt: skip
    assert steered_area_m(fleet, lambda group: True) == (-60, -100, 120, 100)
    assert steered_area_m(fleet, lambda group: False) is None
