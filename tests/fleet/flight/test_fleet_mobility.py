"""The random models against their closed forms, within their fence; and what of a model of one's own is refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sortie.fleet.flight.mobility import (
    MAX_ACCELERATION_MPS2,
    gauss_markov,
    heading_rad,
    is_planner,
    positions_m,
    random_waypoint,
)
from sortie.fleet.flight.motion import fly
from sortie.scenarios.plugins.reference import PluginError
from sortie.scenarios.schema import Fleet

WIDE = {"west_m": -1e5, "south_m": -1e5, "east_m": 1e5, "north_m": 1e5}


def starts(n: int) -> np.ndarray:
    return np.tile([0.0, 0.0, 60.0], (n, 1))


def rng(seed: int = 3) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_random_waypoint_has_its_mean_speed_over_time() -> None:
    """Slow ways last longer: the density of speed over time is ∝ 1/v, so its mean is (b − a) / ln(b / a)."""
    area = {"west_m": -1000, "south_m": -1000, "east_m": 1000, "north_m": 1000}
    times_s = np.arange(10_000, 30_000, 50.0)
    way = [random_waypoint(times_s + dt, starts(60), rng(), **area, slowest_mps=2, fastest_mps=12, turn_time_s=0.1) for dt in (0, 0.2)]  # fmt: skip
    speed = np.linalg.norm(way[1] - way[0], axis=-1) / 0.2
    assert speed.mean() == pytest.approx(10 / math.log(6), rel=0.015)
    # and each speed's share of time is logarithmic in it: half the time below the geometric mean
    assert (speed < math.sqrt(24)).mean() == pytest.approx(0.5, abs=0.015)


def test_random_waypoint_keeps_to_the_middle() -> None:
    """Ways lead across the middle, so drones are there more often than even places would have them: E x² < a²/12."""
    area = {"west_m": -500, "south_m": -500, "east_m": 500, "north_m": 500}
    way = random_waypoint(np.arange(5_000, 40_000, 100.0), starts(60), rng(), **area, slowest_mps=5, fastest_mps=5)
    spread = (way[..., :2] ** 2).mean() / 1000**2
    assert spread < 0.8 / 12
    assert (np.abs(way[..., :2]).max(), way[..., 2].min(), way[..., 2].max()) <= (500.0, 60.0, 60.0)


def test_random_waypoint_rests_as_long_as_it_is_told() -> None:
    """Far places at one speed: share of time at rest = mean pause / (mean pause + mean way)."""
    area = {"west_m": -500, "south_m": -500, "east_m": 500, "north_m": 500}
    options = {**area, "slowest_mps": 10, "fastest_mps": 10, "pause_s": 80, "turn_time_s": 0.1}
    times_s = np.arange(5_000, 30_000, 20.0)
    way = [random_waypoint(times_s + dt, starts(60), rng(), **options) for dt in (0, 0.2)]
    resting = (np.linalg.norm(way[1] - way[0], axis=-1) < 0.2).mean()
    mean_way_s = 0.5214054 * 1000 / 10  # the mean distance of two even places in a unit square
    assert resting == pytest.approx(40 / (40 + mean_way_s), rel=0.03)


@pytest.mark.parametrize("alpha", [0.0, 0.5, 0.85])
def test_gauss_markov_has_its_mean_spread_and_memory(alpha: float) -> None:
    """Speed is an AR(1) process: its correlation over k steps is α^k. It is stationary from the first step on."""
    times_s = np.arange(400) + 0.55  # within each step, far from the changes
    options = {**WIDE, "speed_mps": 9, "speed_sigma_mps": 1.5, "alpha": alpha, "turn_time_s": 0.1, "height_range_m": 90}
    way = [gauss_markov(times_s + dt, starts(150), rng(), **options, climb_sigma_mps=0.1) for dt in (-0.1, 0.1)]
    velocity = (way[1] - way[0]) / 0.2
    speed = np.hypot(velocity[..., 0], velocity[..., 1])
    assert speed.mean() == pytest.approx(9, abs=0.05)
    assert speed.std() == pytest.approx(1.5, rel=0.03)
    assert speed[0].std() == pytest.approx(1.5, rel=0.2)
    for k in (1, 3):
        over_k = np.mean((speed[k:] - 9) * (speed[:-k] - 9)) / 1.5**2
        assert over_k == pytest.approx(alpha**k, abs=0.03)
    assert velocity[..., 2].std() == pytest.approx(0.1, rel=0.05)


def test_gauss_markov_heads_about_its_mean_heading() -> None:
    times_s = np.arange(300) + 0.55
    options = {**WIDE, "heading_sigma_deg": 20, "turn_time_s": 0.1, "speed_sigma_mps": 0}
    way = [gauss_markov(times_s + dt, starts(200), rng(), **options) for dt in (-0.1, 0.1)]
    velocity = (way[1] - way[0]) / 0.2
    course = np.exp(1j * np.arctan2(velocity[..., 1], velocity[..., 0]))
    mean = course.mean(axis=0)
    off = np.angle(course / (mean / np.abs(mean)))
    assert np.degrees(off.std()) == pytest.approx(20, rel=0.05)
    assert np.abs(mean.mean()) < 0.15  # mean headings are drawn evenly


def test_gauss_markov_draws_speed_heading_and_climb_apart() -> None:
    times_s = np.arange(300) + 0.55
    options = {
        **WIDE,
        "speed_sigma_mps": 1.0,
        "heading_sigma_deg": 20,
        "climb_sigma_mps": 0.1,
        "height_range_m": 90,
        "turn_time_s": 0.1,
    }
    way = [gauss_markov(times_s + dt, starts(100), rng(), **options) for dt in (-0.1, 0.1)]
    velocity = (way[1] - way[0]) / 0.2
    course = np.exp(1j * np.arctan2(velocity[..., 1], velocity[..., 0]))
    off = np.angle(course / course.mean(axis=0))
    drawn = np.stack([np.hypot(velocity[..., 0], velocity[..., 1]).ravel(), off.ravel(), velocity[..., 2].ravel()])
    together = np.corrcoef(drawn)[np.triu_indices(3, 1)]
    assert np.abs(together).max() < 0.08


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.floats(60, 400), st.floats(0.5, 9), st.floats(0, 40), st.booleans())
def test_no_random_model_leaves_its_fence(
    seed: int, half_m: float, speed_mps: float, height_m: float, gm: bool
) -> None:
    area = {"west_m": -half_m, "south_m": -half_m, "east_m": half_m, "north_m": half_m, "height_range_m": height_m}
    times_s = np.arange(0, 300, 0.1)
    if gm:
        way = gauss_markov(
            times_s, starts(2), rng(seed), **area, speed_mps=speed_mps, margin_m=20, heading_sigma_deg=60
        )
    else:
        way = random_waypoint(times_s, starts(2), rng(seed), **area, slowest_mps=speed_mps, fastest_mps=2 * speed_mps)
    assert np.abs(way[..., :2]).max() <= half_m + 1e-6
    assert np.abs(way[..., 2] - 60).max() <= height_m / 2 + 1e-6
    push = np.linalg.norm(np.diff(way, n=2, axis=0), axis=-1) / 0.1**2
    assert push.max() < MAX_ACCELERATION_MPS2


@pytest.mark.parametrize("name", ["random_waypoint", "gauss_markov"])
def test_more_drones_and_more_time_change_nothing(name: str) -> None:
    fleet = Fleet(drones=3, mobility=name)
    short, long = fly(fleet, 20.0, 0.1, seed=5), fly(fleet, 40.0, 0.1, seed=5)
    more = fly(fleet.model_copy(update={"drones": 5}), 20.0, 0.1, seed=5)
    for field in ("position_m", "velocity_mps", "orientation_xyzw", "est_position_m", "wind_mps"):
        np.testing.assert_array_equal(getattr(short, field), getattr(long, field)[:200], err_msg=field)
        np.testing.assert_array_equal(getattr(short, field), getattr(more, field)[:, :3], err_msg=field)
    other = fly(fleet, 20.0, 0.1, seed=6)
    assert np.abs(other.position_m - short.position_m).max() > 10
    assert np.abs(short.position_m[0] - fly(Fleet(drones=3), 1.0, 0.1, seed=5).position_m[0]).max() < 1e-9


def test_a_group_moves_at_random_beside_a_formation() -> None:
    group = {"drones": [1, 3], "mobility": "random_waypoint", "mobility_params": {"slowest_mps": 9}}
    mixed, plain = fly(Fleet(drones=4, groups=[group]), 20.0, 0.1, seed=5), fly(Fleet(drones=2), 20.0, 0.1, seed=5)
    np.testing.assert_array_equal(mixed.position_m[:, 0], plain.position_m[:, 0])
    assert (np.ptp(mixed.position_m[:, [1, 3], :2], axis=0).max(axis=-1) > 40).all()


def test_groups_of_one_model_move_apart_and_apart_from_the_fleet() -> None:
    """All three begin at one place; each draws its own way."""
    group = {"mobility": "random_waypoint", "mobility_params": {"slowest_mps": 9}}
    fleet = Fleet(drones=3, groups=[{"drones": [1], **group}, {"drones": [2], **group}], **group)
    place = fly(fleet, 20.0, 0.1, seed=5).position_m
    assert np.ptp(place[0], axis=0).max() < 5
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert np.linalg.norm(place[-1, a] - place[-1, b]) > 20


def test_headings_follow_the_course_and_read_no_future() -> None:
    turn = np.linspace(0, 4 * np.pi, 600)
    velocity = np.stack([5 * np.cos(turn), 5 * np.sin(turn), 0 * turn], axis=-1)[:, None]
    heading = heading_rad(velocity, 0.1)
    np.testing.assert_array_equal(heading[:300], heading_rad(velocity[:300], 0.1))
    lag = turn - heading[:, 0]
    np.testing.assert_allclose(lag[100:], lag[100], atol=1e-6)  # a mean over the past is late by half its length
    assert not heading_rad(np.zeros((50, 2, 3)), 0.1).any()


def hover(times_s: Any, starts_m: Any, rng: Any) -> Any:
    return np.repeat(starts_m[None], len(times_s), axis=0)


def jump(times_s: Any, starts_m: Any, rng: Any) -> Any:
    return hover(times_s, starts_m, rng) + (times_s > 3.05)[:, None, None] * (1, 0, 0)


def below(times_s: Any, starts_m: Any, rng: Any) -> Any:
    return hover(times_s, starts_m, rng) - (0, 0, 61)


def flat(times_s: Any, starts_m: Any, rng: Any) -> Any:
    return hover(times_s, starts_m, rng)[..., :2]


TIMES_S = np.arange(0, 5, 0.1)


@pytest.mark.parametrize(
    ("model", "said"),
    [
        (jump, "mobility jump: drone 0 of its drones accelerates by 100 m/s² at 3 s, must be at most 20"),
        (
            below,
            "mobility below: drone 0 of its drones is at (0.0, 0.0, -1.0) at 0 s, must be within ±20000 m, at or above the ground",
        ),
        (flat, "mobility flat: returns shape (50, 2, 2), must be (50, 2, 3)"),
    ],
)
def test_what_cannot_be_flown_is_refused(model: Any, said: str) -> None:
    assert positions_m(hover, TIMES_S, starts(2), rng()).shape == (50, 2, 3)
    with pytest.raises(PluginError) as refused:
        positions_m(model, TIMES_S, starts(2), rng())
    assert str(refused.value) == said


@pytest.mark.parametrize(
    ("model", "options", "said"),
    [
        (
            random_waypoint,
            {"west_m": 200},
            "(200, -150.0, 150.0, 150.0), must be west_m < east_m and south_m < north_m",
        ),
        (random_waypoint, {"west_m": 20}, "a drone begins at (0, 0), must be within (20, -150.0, 150.0, 150.0)"),
        (random_waypoint, {"slowest_mps": 0}, "slowest_mps 0, fastest_mps 10"),
        (random_waypoint, {"turn_time_s": 0}, "turn_time_s 0, must be 0 < slowest_mps ≤ fastest_mps, turn_time_s > 0"),
        (
            gauss_markov,
            {"alpha": 1},
            "alpha 1, speed_mps 8, speed_sigma_mps 1.5, step_s 1, turn_time_s 5, must be 0 ≤ alpha < 1",
        ),
        (gauss_markov, {"speed_sigma_mps": -5}, "speed_sigma_mps -5, step_s 1, turn_time_s 5, must be 0 ≤ alpha < 1"),
        (gauss_markov, {"step_s": 60}, "steps of 1200 m are too long for (-150.0, -150.0, 150.0, 150.0)"),
    ],
)
def test_parameters_that_mean_nothing_are_refused(model: Any, options: dict[str, float], said: str) -> None:
    with pytest.raises(PluginError) as refused:
        model(TIMES_S, starts(2), rng(), **options)
    assert said in str(refused.value)


def test_a_class_plans_in_flight_and_a_function_does_not() -> None:
    assert is_planner(Fleet)
    assert not is_planner(hover)
