"""The random models against their closed forms, within their fence; and which plug-in models are refused."""

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
    options = {**area, "slowest_mps": 2, "fastest_mps": 12, "turn_time_s": 0.1}
    way = [random_waypoint(times_s + dt, starts(60), rng(), **options) for dt in (0, 0.2)]
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


def test_random_waypoint_rests_evenly_up_to_the_longest() -> None:
    """Of many rests the mean is half of it, and some are short. Heights lie about the start."""
    options = {"pause_s": 40.0, "slowest_mps": 10.0, "turn_time_s": 0.01, "height_range_m": 20.0}
    way = random_waypoint(np.arange(0.0, 4000.0, 0.5), starts(8), rng(2), **options)
    still = (np.abs(np.diff(way, axis=0)).max(axis=-1) < 1e-9).T
    runs = [run for drone in still for run in np.split(drone, np.flatnonzero(np.diff(drone.astype(int)) != 0) + 1)]
    lasts_s = [0.5 * len(run) for run in runs if run[0]]
    assert np.mean(lasts_s) == pytest.approx(20.0, abs=2.0)
    assert max(lasts_s) <= 40.5
    assert min(lasts_s) < 8.0
    assert np.ptp(way[..., 2]) > 18.0


def velocities(drones: int, steps: int, **options: float) -> np.ndarray:
    """Of Gauss-Markov ways, within each step and far from the changes."""
    times_s = (np.arange(steps)[:, None] + (0.45, 0.65)).ravel()
    options = {**WIDE, "turn_time_s": 0.1, "height_range_m": 90} | options
    way = gauss_markov(times_s, starts(drones), rng(), **options)
    return (way[1::2] - way[::2]) / 0.2


def test_gauss_markov_has_its_mean_spread_and_memory() -> None:
    """Speed is an AR(1) process: its correlation over k steps is α^k. It is stationary from the first step on."""
    for alpha in (0.0, 0.85):
        velocity = velocities(150, 400, speed_mps=9, speed_sigma_mps=1.5, alpha=alpha, climb_sigma_mps=0.1)
        speed = np.hypot(velocity[..., 0], velocity[..., 1])
        assert speed.mean() == pytest.approx(9, abs=0.05)
        assert speed.std() == pytest.approx(1.5, rel=0.03)
        assert speed[0].std() == pytest.approx(1.5, rel=0.2)
        for k in (1, 3):
            over_k = np.mean((speed[k:] - 9) * (speed[:-k] - 9)) / 1.5**2
            assert over_k == pytest.approx(alpha**k, abs=0.03)
        assert velocity[..., 2].std() == pytest.approx(0.1, rel=0.05)


def test_gauss_markov_draws_speed_heading_and_climb_apart_and_heads_about_its_mean_heading() -> None:
    velocity = velocities(120, 300, heading_sigma_deg=20, speed_sigma_mps=1.0, climb_sigma_mps=0.1)
    course = np.exp(1j * np.arctan2(velocity[..., 1], velocity[..., 0]))
    mean = course.mean(axis=0)
    off = np.angle(course / (mean / np.abs(mean)))
    assert np.degrees(off.std()) == pytest.approx(20, rel=0.05)
    assert np.abs(mean.mean()) < 0.15  # mean headings are drawn evenly
    drawn = np.stack([np.hypot(velocity[..., 0], velocity[..., 1]).ravel(), off.ravel(), velocity[..., 2].ravel()])
    assert np.abs(np.corrcoef(drawn)[np.triu_indices(3, 1)]).max() < 0.08


def test_a_drone_that_is_reflected_keeps_its_new_heading() -> None:
    """Without noise and without memory it flies level and straight from edge to edge, like a ball."""
    times_s = np.arange(0.5, 400.0)
    ball = {"alpha": 0.0, "heading_sigma_deg": 0.0, "speed_mps": 8.0, "speed_sigma_mps": 0.0}
    begin_m = np.tile([10.0, -5.0, 60.0], (6, 1))
    way = gauss_markov(times_s, begin_m, rng(5), **ball, margin_m=0.0, turn_time_s=1e-3)
    assert np.abs(way[..., :2]).max() <= 150.0 + 1e-6
    assert np.ptp(way[..., 2]) == 0.0
    velocity, reflected = np.diff(way, axis=0)[2:], 0
    assert np.hypot(velocity[..., 0], velocity[..., 1]).max() < 8.0 + 1e-6
    for drone, axis in np.ndindex(6, 2):
        speed = float(np.median(np.abs(velocity[:, drone, axis])))
        turns = np.flatnonzero(np.diff(np.sign(velocity[:, drone, axis])) != 0)
        assert all(gap >= 300 / speed - 3 for gap in np.diff(turns))
        reflected += len(turns)
    assert reflected > 20


def test_near_the_edge_a_drone_turns_to_the_middle_of_its_own_fence() -> None:
    """Of a fence that does not hold the origin in its middle."""
    fence = {"west_m": 0.0, "south_m": -50.0, "east_m": 600.0, "north_m": 550.0}
    begin_m = np.tile([300.0, 250.0, 60.0], (6, 1))
    way = gauss_markov(np.arange(60.0, 400.0, 5.0), begin_m, rng(), **fence, margin_m=150.0)
    np.testing.assert_allclose(way[..., :2].mean(axis=(0, 1)), (300.0, 250.0), atol=60.0)


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


def test_more_drones_and_more_time_change_nothing() -> None:
    for name in ("random_waypoint", "gauss_markov"):
        fleet = Fleet(drones=3, mobility=name)
        short, long = fly(fleet, 20.0, 0.1, seed=5), fly(fleet, 40.0, 0.1, seed=5)
        more = fly(fleet.model_copy(update={"drones": 5}), 20.0, 0.1, seed=5)
        for field in ("position_m", "velocity_mps", "orientation_xyzw", "est_position_m", "wind_mps"):
            np.testing.assert_array_equal(getattr(short, field), getattr(long, field)[:200], err_msg=field)
            np.testing.assert_array_equal(getattr(short, field), getattr(more, field)[:, :3], err_msg=field)
        formation = fly(Fleet(drones=3), 1.0, 0.1, seed=5)
        assert np.abs(short.position_m[0] - formation.position_m[0]).max() < 1e-9


def test_groups_that_move_at_random_have_ways_of_their_own() -> None:
    """Each group, the fleet, another seed and another replication: the same start, other places."""
    alone = [{"drones": [i], "mobility": "random_waypoint"} for i in (1, 2)]
    fleet = Fleet(drones=3, mobility="random_waypoint", groups=alone)
    ways = np.stack(
        [
            fly(fleet, 60.0, 0.1, seed, replication).position_m[:, drone, :2]
            for seed, replication in ((5, 0), (6, 0), (5, 1))
            for drone in range(3)
        ]
    )
    assert np.ptp(ways[:, 0], axis=0).max() < 4.0  # but for their jitter they begin in one place
    apart = np.linalg.norm(ways[:, None] - ways[None], axis=-1).max(axis=-1)
    assert apart[~np.eye(len(ways), dtype=bool)].min() > 20.0


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


def test_what_cannot_be_flown_is_refused() -> None:
    assert positions_m(hover, TIMES_S, starts(2), rng()).shape == (50, 2, 3)
    place = "is at (0.0, 0.0, -1.0) at 0 s, must be within ±20000 m, at or above the ground"
    for model, said in (
        (jump, "mobility jump: drone 0 of its drones accelerates by 100 m/s² at 3 s, must be at most 20"),
        (below, f"mobility below: drone 0 of its drones {place}"),
        (flat, "mobility flat: returns shape (50, 2, 2), must be (50, 2, 3)"),
    ):
        with pytest.raises(PluginError) as refused:
            positions_m(model, TIMES_S, starts(2), rng())
        assert str(refused.value) == said


MEANINGLESS: list[tuple[Any, dict[str, float], str]] = [
    (random_waypoint, {"west_m": 200}, "(200, -150.0, 150.0, 150.0), must be west_m < east_m and south_m < north_m"),
    (random_waypoint, {"west_m": 20}, "a drone begins at (0, 0), must be within (20, -150.0, 150.0, 150.0)"),
    (random_waypoint, {"slowest_mps": 0}, "slowest_mps 0, fastest_mps 10"),
    (random_waypoint, {"turn_time_s": 0}, "turn_time_s 0, must be 0 < slowest_mps ≤ fastest_mps, turn_time_s > 0"),
    (
        gauss_markov,
        {"alpha": 1},
        "alpha 1, speed_mps 8, speed_sigma_mps 1.5, step_s 1, turn_time_s 5, must be 0 ≤ alpha",
    ),
    (gauss_markov, {"speed_sigma_mps": -5}, "speed_sigma_mps -5, step_s 1, turn_time_s 5, must be 0 ≤ alpha < 1"),
    (gauss_markov, {"step_s": 60}, "steps of 1200 m are too long for (-150.0, -150.0, 150.0, 150.0)"),
]


def test_parameters_that_mean_nothing_are_refused() -> None:
    wrong = {}
    for model, options, said in MEANINGLESS:
        with pytest.raises(PluginError) as refused:
            model(TIMES_S, starts(2), rng(), **options)
        if said not in str(refused.value):
            wrong[model.__name__, *options] = str(refused.value)
    assert wrong == {}


def test_a_class_plans_in_flight_and_a_function_does_not() -> None:
    assert is_planner(Fleet)
    assert not is_planner(hover)
