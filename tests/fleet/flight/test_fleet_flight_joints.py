"""Where flights and their settings meet: rotors and loads, models of mobility and their fences, legs and their speeds.

1. Tip speed is that of hover without payload: an airframe's own mass leaves it, a payload raises it.
2. A model of mobility that meets its fence is turned for good, and rests as long as it draws.
3. A leg's own speed, on a way there and on the way back.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from sortie.fleet.flight.mobility import gauss_markov, random_waypoint
from sortie.fleet.flight.motion import fly
from sortie.fleet.flight.rotor import rotor_power_w
from sortie.scenarios.schema import Airframe, Fleet

CALM = {"wind_mps": [0, 0], "gust_sigma_mps": 0, "pose_jitter_m": 0, "pose_error_m": 0, "heading_error_deg": 0}


@pytest.mark.parametrize(("mass_kg", "payload_kg"), [(2.04, 0.0), (4.5, 0.0), (2.04, 1.2), (5.0, 2.0)])
def test_tip_speed_is_that_of_hover_without_payload(mass_kg: float, payload_kg: float) -> None:
    """The profile's part that falls with the tips' speed: hover's profile power, times 3 V² / tip speed²."""
    fast, slow = (
        float(rotor_power_w(12.0, Airframe(mass_kg=mass_kg, payload_kg=payload_kg, tip_speed_mps=tip)))
        for tip in (150.0, 100.0)
    )
    load = (mass_kg + payload_kg) / 2.04
    profile_w = 79.8563 * load**1.5
    tips = 1 + payload_kg / mass_kg  # how much a payload raises the square of the speed
    assert slow - fast == pytest.approx(profile_w * 3 * 12.0**2 * (1 / 100.0**2 - 1 / 150.0**2) / tips, rel=1e-9)


def steps_of(times_s: np.ndarray, way: np.ndarray) -> np.ndarray:
    return np.diff(way, axis=0) / np.diff(times_s)[:, None, None]


def test_a_drone_that_is_reflected_keeps_its_new_heading() -> None:
    """Without noise and without memory it flies straight from edge to edge, like a ball."""
    times_s = np.arange(0.5, 400.0)
    way = gauss_markov(
        times_s, np.tile([10.0, -5.0, 60.0], (6, 1)), np.random.default_rng(5), alpha=0.0, heading_sigma_deg=0.0,
        speed_mps=8.0, speed_sigma_mps=0.0, margin_m=0.0, turn_time_s=1e-3,
    )  # fmt: skip
    assert np.abs(way[..., :2]).max() <= 150.0 + 1e-6
    velocity, reflected = steps_of(times_s, way)[2:], 0
    assert np.hypot(velocity[..., 0], velocity[..., 1]).max() < 8.0 + 1e-6
    for drone in range(6):
        for axis in (0, 1):
            speed = float(np.median(np.abs(velocity[:, drone, axis])))
            turns = np.flatnonzero(np.diff(np.sign(velocity[:, drone, axis])) != 0)
            assert all(gap >= 300 / speed - 3 for gap in np.diff(turns))
            reflected += len(turns)
    assert reflected > 20


def test_rests_are_drawn_evenly_up_to_the_longest() -> None:
    """Of many rests the mean is half of it, and some are short."""
    times_s = np.arange(0.0, 4000.0, 0.5)
    way = random_waypoint(
        times_s, np.tile([0.0, 0.0, 60.0], (8, 1)), np.random.default_rng(2), pause_s=40.0, slowest_mps=10.0,
        turn_time_s=0.01,
    )  # fmt: skip
    still = (np.abs(np.diff(way, axis=0)).max(axis=-1) < 1e-9).T
    lasts_s = [
        0.5 * len(run)
        for drone in still
        for run in np.split(drone, np.flatnonzero(np.diff(drone.astype(int)) != 0) + 1)
        if run[0]
    ]
    assert np.mean(lasts_s) == pytest.approx(20.0, abs=2.0)
    assert max(lasts_s) <= 40.5
    assert min(lasts_s) < 8.0


def test_heights_of_a_random_model_lie_about_its_start() -> None:
    way = random_waypoint(
        np.arange(0.0, 3000.0, 2.0), np.tile([0.0, 0.0, 60.0], (6, 1)), np.random.default_rng(4), height_range_m=20.0
    )
    assert way[..., 2].min() >= 50.0 - 1e-9
    assert way[..., 2].max() <= 70.0 + 1e-9
    assert np.ptp(way[..., 2]) > 18.0


def test_a_model_whose_heights_do_not_change_does_not_climb() -> None:
    way = gauss_markov(np.arange(0.0, 100.0), np.tile([0.0, 0.0, 60.0], (3, 1)), np.random.default_rng(1))
    assert np.ptp(way[..., 2]) == 0.0


def test_near_the_edge_a_drone_turns_to_the_middle_of_its_own_fence() -> None:
    """Of a fence that does not hold the origin in its middle."""
    fence = {"west_m": 0.0, "south_m": -50.0, "east_m": 600.0, "north_m": 550.0}
    way = gauss_markov(
        np.arange(60.0, 400.0, 5.0), np.tile([300.0, 250.0, 60.0], (6, 1)), np.random.default_rng(3), **fence,
        margin_m=150.0,
    )  # fmt: skip
    mean = way[..., :2].mean(axis=(0, 1))
    np.testing.assert_allclose(mean, (300.0, 250.0), atol=60.0)


def legs(*steps: dict[str, Any]) -> np.ndarray:
    group = {
        "drones": [0], "formation": {"altitude_m": 30}, "route": {"waypoints_m": [[0, 0], [40, 0]], "speed_mps": 4, "turn_time_s": 0.2},
        "legs": list(steps),
    }  # fmt: skip
    fleet = Fleet.model_validate({"drones": 1, "motion": CALM, "groups": [group]})
    return np.asarray(fly(fleet, 60.0, 0.1, seed=1).velocity_mps[:, 0])


def test_a_leg_is_flown_at_its_own_speed_and_others_at_the_route_s() -> None:
    """The route 10 s at 4 m/s; 80 m at 8; 30 m back to the start's height of y at 4; the way home at 10."""
    velocity = legs(
        {"to_m": [120, 0], "speed_mps": 8}, {"to_m": [120, 30]}, {"action": "return", "speed_mps": 10}, {"action": "hold", "for_s": 1}
    )  # fmt: skip
    level = np.hypot(velocity[:, 0], velocity[:, 1])
    np.testing.assert_allclose(level[50], 4.0, atol=1e-9)
    np.testing.assert_allclose(level[150], 8.0, atol=1e-9)
    np.testing.assert_allclose(level[230], 4.0, atol=1e-9)
    np.testing.assert_allclose(level[320], 10.0, atol=1e-9)
    home_s = 27.5 + math.hypot(120, 30) / 10
    np.testing.assert_allclose(level[round(home_s * 10) + 5], 0.0, atol=1e-9)


def test_the_way_home_ends_at_its_own_height() -> None:
    """A return with an altitude climbs to it; one without stays where it is."""
    for step, climbs in (({"action": "return", "altitude_m": 45}, True), ({"action": "return"}, False)):
        velocity = legs({"to_m": [100, 0]}, step)
        assert bool(velocity[:, 2].max() > 0.1) is climbs
