"""Steering: commands are flown within speed and acceleration, end where they say, and break no bound of place."""

from __future__ import annotations

import math
import tracemalloc
from pathlib import Path
from typing import Any

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
    area_m,
    nearest_m,
    refusal,
    steer,
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


def test_a_place_is_reached_as_fast_as_the_bounds_allow() -> None:
    """At cruise speed, and half of each change of velocity; where there is no cruise, twice a root."""
    for command, takes_s in (
        (GoTo(200.0, 0.0), 200 / 8 + 2.25 * 8 / 2),
        (GoTo(3.0, 4.0), 2 * math.sqrt(2.25 * 5 / 2)),  # 5 m at 2 m/s²
        (GoTo(0.0, 0.0, 90.0), 30 / 3 + 2.25 * 3 / 2),  # climbs
        (GoTo(80.0, 0.0, None, 4.0), 80 / 4 + 2.25 * 4 / 2),
    ):
        last = steer(STILL, command, 0.0, LIMITS).changes[-1]
        assert last.begin_s + last.width_s == pytest.approx(takes_s, rel=1e-4), command


def test_a_velocity_lasts_two_seconds_and_ends_at_rest() -> None:
    way = steer(STILL, Velocity(0.2, 0.0), 0.0, LIMITS)
    first_s = 2.25 * 0.2 / 2
    place, speed, _ = way.at(np.array([1.0, VELOCITY_LASTS_S + first_s + 1e-6]))
    np.testing.assert_allclose(speed, [(0.2, 0, 0), (0, 0, 0)], atol=1e-9)
    assert place[1, 0] == pytest.approx(0.2 * VELOCITY_LASTS_S)
    fast = steer(STILL, Velocity(60.0, 80.0, 1.0), 0.0, LIMITS).changes[0].by_mps
    assert math.hypot(*fast[:2]) == pytest.approx(8.0)
    assert fast[0] / fast[1] == pytest.approx(0.75)


def test_a_share_of_a_command_is_a_share_of_its_way_or_of_its_velocity() -> None:
    still = SteeredWay(0.0, (0.0, 0.0, 60.0), (0.0, 0.0, 0.0))
    for share in (1.0, 0.5):
        np.testing.assert_allclose(
            steer(still, GoTo(40.0, 0.0), 0.0, Steering(), share).end_m, (40.0 * share, 0, 60), atol=1e-6
        )
        fast = steer(still, Velocity(0.0, 6.0), 0.0, Steering(), share)
        assert fast.at(np.arange(0.0, 20.0, 0.01))[1][:, 1].max() == pytest.approx(6.0 * share)
    slow = Steering(acceleration_mps2=0.5)
    long = steer(still, Velocity(0.0, 6.0), 0.0, slow)  # it takes 27 s to get so fast, and then as long to rest
    velocity = long.at(np.arange(0.0, 80.0, 0.01))[1][:, 1]
    assert velocity.max() == pytest.approx(6.0)
    assert velocity.min() >= -1e-9
    assert steer(long, Hold(), 5.0, slow).until(5.0)[1] == pytest.approx(27.0)


Place = tuple[float, float, float]


def refused(place: Place, command: GoTo | Velocity, **limits: Any) -> str:
    """Why a drone that is at this place may not fly so; it began at (0, 0, 60). Its jitter is half a metre."""
    fleet = Fleet.model_validate({"steering": limits, "motion": {"pose_jitter_m": 0.5}})
    way = steer(SteeredWay(0.0, place, (0.0, 0.0, 0.0)), command, 0.0, fleet.steering)
    return refusal(way, 0.0, np.array((0.0, 0.0, 60.0)), fleet)


HERE: Place = (0.0, 0.0, 60.0)
REACH, FENCE = "would leave its reach of 200 m", "would leave the fence"
HEIGHTS = "would leave the altitudes of 10 to 120 m"
BOUNDS: list[tuple[Place, GoTo | Velocity, str]] = [
    (HERE, GoTo(190, 0), ""),
    (HERE, GoTo(201, 0), REACH),
    ((230, 0, 60), GoTo(220, 0), ""),  # who is beyond a bound may come nearer
    ((230, 0, 60), GoTo(240, 0), REACH),
    (HERE, GoTo(0, 0, 121), HEIGHTS),
    (HERE, GoTo(0, 0, 9), HEIGHTS),
    ((0, 0, 5), GoTo(0, 0, 8), ""),
    ((0, 0, 5), GoTo(0, 0, 4), HEIGHTS),
    ((0, 0, 130), GoTo(0, 0, 125), ""),
    ((0, 0, 130), GoTo(0, 0, 135), HEIGHTS),
]
WITHIN_A_FENCE: list[tuple[Place, GoTo | Velocity, str]] = [
    (HERE, GoTo(47, 0), ""),
    (HERE, GoTo(48, 0), FENCE),  # five jitters
    (HERE, GoTo(0, -48), FENCE),
    (HERE, Velocity(0, 2), ""),
    (HERE, Velocity(0, 20), FENCE),
    ((60, 0, 60), GoTo(55, 0), ""),
    ((60, 0, 60), GoTo(65, 0), FENCE),
]


def test_ways_keep_within_reach_altitudes_and_fence() -> None:
    fence = {"fence_m": (-50.0, -50.0, 50.0, 50.0)}
    free = {row[:2]: refused(*row[:2]) for row in BOUNDS}
    fenced = {row[:2]: refused(*row[:2], **fence) for row in WITHIN_A_FENCE}
    assert free == {row[:2]: row[2] for row in BOUNDS}
    assert fenced == {row[:2]: row[2] for row in WITHIN_A_FENCE}


def test_the_nearest_approach_is_found_between_frames() -> None:
    """Two drones cross between two frames, by hand; and one flies past that is nearest at any part of a frame."""
    ours = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    others = np.array([[[2.0, 1.0, 0.0], [9.0, 0.0, 0.0]], [[0.0, 1.0, 0.0], [9.0, 0.0, 0.0]]])
    np.testing.assert_allclose(nearest_m(ours, others), [1.0, 7.0])
    for at in (0.1, 0.5, 0.9):
        passing = np.zeros((3, 1, 3))
        passing[:, 0, 0] = np.array([0.0, 10.0, 20.0]) - 10.0 * at
        passing[:, 0, 1] = 2.0
        assert nearest_m(np.zeros((3, 3)), passing) == pytest.approx([2.0])


def test_planners_may_fly_where_their_reach_and_the_fence_both_allow(tmp_path: Path) -> None:
    """About where each of them begins: of the formation, of groups, or of both, as they have one."""
    (tmp_path / "own.py").write_text("class Plans:\n    def command(self, view): ...\n")
    plans, fence = {"mobility": f"{tmp_path / 'own.py'}:Plans"}, {"fence_m": (-60.0, -500.0, 700.0, 90.0)}
    rows: list[tuple[dict[str, str], dict[str, str], dict[str, object], tuple[float, ...]]] = [
        (plans, plans, {}, (-100.0, -100.0, 600.0, 130.0)),
        (plans, {}, {}, (-100.0, -100.0, 100.0, 130.0)),
        ({}, plans, {}, (0.0, -100.0, 600.0, 100.0)),
        (plans, plans, fence, (-60.0, -100.0, 600.0, 90.0)),
        ({}, {}, {}, (0.0, 0.0, 1.0, 1.0)),
    ]
    for formation, group, steering, area in rows:
        groups = ({"drones": [2], "route": {"waypoints_m": [[500.0, 0.0]]}, **group},)
        of = {"drones": 3, "formation": {"shape": "line", "spacing_m": 30.0}, "groups": groups, **formation}
        fleet = Fleet.model_validate({**of, "steering": {"reach_m": 100.0, **steering}})
        assert area_m(fleet, (0.0, 0.0, 1.0, 1.0)) == pytest.approx(area), (formation, group, steering)
