"""Groups with routes and legs of their own, take-off, and ground stations: where they are, what they leave alone."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from sortie.fleet.flight.motion import Trajectories, fly
from sortie.fleet.flight.rotor import fleet_power_w
from sortie.fleet.flight.steps import Staircase, Step, landing_s
from sortie.scenarios.schema import Fleet, FlightGroup

CALM = {"wind_mps": [0, 0], "gust_sigma_mps": 0, "pose_jitter_m": 0, "pose_error_m": 0, "heading_error_deg": 0}


SCOUT = {
    "drones": [3],
    "formation": {"altitude_m": 30},
    "route": {"waypoints_m": [[0, 40]], "speed_mps": 6, "turn_time_s": 2},
    "take_off": True,
    "legs": [
        {"to_m": [60, 40]},
        {"action": "hold", "for_s": 5},
        {"to_m": [60, 70], "altitude_m": 45, "speed_mps": 10},
        {"action": "return"},
        {"action": "land"},
    ],
}
"""On the ground 1 s, up 10 s at 3 m/s, at rest 2 s; 10 s east; 5 + 2 s at rest; 5 s north and 15 m up at 3 m/s."""


def flown(duration_s: float = 60.0, **changes: Any) -> tuple[Fleet, Trajectories]:
    fleet = Fleet.model_validate({"motion": CALM} | changes)
    return fleet, fly(fleet, duration_s, 0.1, seed=4)


def test_legs_are_flown_as_they_are_written() -> None:
    _, motion = flown(drones=4, groups=[SCOUT])
    at = {t: motion.position_m[round(t * 10), 3] for t in (0, 0.1, 6, 12, 18, 24, 26, 29.9)}
    places = {0: (0, 40, 0), 6: (0, 40, 15), 12: (0, 40, 30), 18: (30, 40, 30), 24: (60, 40, 30), 26: (60, 40, 30)}
    for t, place in places.items():
        np.testing.assert_allclose(at[t], place, atol=1e-9)
    np.testing.assert_allclose(motion.position_m[325, 3], (60, 55, 37.5), atol=1e-9)  # half way north and up
    np.testing.assert_allclose(motion.velocity_mps[325, 3], (0, 6, 3), atol=1e-9)  # as fast as its climb allows
    back_s = 35 + np.hypot(60, 30) / 6
    assert landing_s(FlightGroup.model_validate(SCOUT)) == pytest.approx(back_s + 1)
    np.testing.assert_allclose(motion.position_m[round(back_s * 10) + 12, 3], (0, 40, 45), atol=1e-9)


def legs(*steps: dict[str, Any]) -> np.ndarray:
    route = {"waypoints_m": [[0, 0], [40, 0]], "speed_mps": 4, "turn_time_s": 0.2}
    group = {"drones": [0], "formation": {"altitude_m": 30}, "route": route, "legs": list(steps)}
    fleet = Fleet.model_validate({"drones": 1, "motion": CALM, "groups": [group]})
    return np.asarray(fly(fleet, 60.0, 0.1, seed=1).velocity_mps[:, 0])


def test_a_leg_is_flown_at_its_own_speed_and_others_at_the_route_s() -> None:
    """The route 10 s at 4 m/s; 80 m at 8; 30 m north at 4; the way home at 10."""
    home, rest = {"action": "return", "speed_mps": 10}, {"action": "hold", "for_s": 1}
    velocity = legs({"to_m": [120, 0], "speed_mps": 8}, {"to_m": [120, 30]}, home, rest)
    level = np.hypot(velocity[:, 0], velocity[:, 1])
    home_s = 27.5 + math.hypot(120, 30) / 10
    np.testing.assert_allclose(
        level[[50, 150, 230, 320, round(home_s * 10) + 5]], [4.0, 8.0, 4.0, 10.0, 0.0], atol=1e-9
    )


def test_the_way_home_ends_at_its_own_height() -> None:
    """A return with an altitude climbs to it; one without stays where it is."""
    for step, climbs in (({"action": "return", "altitude_m": 45}, True), ({"action": "return"}, False)):
        velocity = legs({"to_m": [100, 0]}, step)
        assert bool(velocity[:, 2].max() > 0.1) is climbs


def test_a_drone_on_the_ground_does_not_sway_and_rises_as_one_piece() -> None:
    """At steps of 10 ms, by central differences."""
    fleet = Fleet.model_validate({"drones": 4, "groups": [SCOUT], "motion": CALM | {"pose_jitter_m": 1.0}})
    motion = fly(fleet, 40.0, 0.01, seed=4)
    np.testing.assert_allclose(motion.position_m[0, 3], (0, 40, 0), atol=1e-12)
    assert motion.position_m[:, 3, 2].min() >= 0.0
    assert np.abs(motion.position_m[1200:1800, 3, 2] - 30).max() > 0.2
    for value, rate in ((motion.position_m, motion.velocity_mps), (motion.velocity_mps, motion.acceleration_mps2)):
        numeric = (value[2:, 3] - value[:-2, 3]) / 0.02
        np.testing.assert_allclose(numeric, rate[1:-1, 3], atol=0.02)


def test_drones_of_other_heights_leave_the_ground_together() -> None:
    group = SCOUT | {"drones": [2, 3]}
    _, motion = flown(drones=4, groups=[group], makes=[{"name": "high", "drones": [3], "altitude_offset_m": 15}])
    assert motion.position_m[0, 2:, 2].tolist() == [0, 0]
    np.testing.assert_allclose(motion.position_m[120, 2:, 2], (30, 45))
    np.testing.assert_allclose(motion.position_m[360, 2:, 2], (45, 60))
    assert np.abs(np.diff(motion.position_m[:, 3, 2])).max() < 3.0 * 45 / 30 * 0.1 + 1e-9


def test_a_group_flies_as_a_fleet_of_its_own_would() -> None:
    route = {"waypoints_m": [[0, 0], [40, 0], [40, 60]], "speed_mps": 7}
    formation = {"shape": "line", "spacing_m": 15, "altitude_m": 80}
    _, motion = flown(drones=5, groups=[{"drones": [4, 1], "formation": formation, "route": route}])
    _, alone = flown(drones=2, formation=formation, route=route)
    np.testing.assert_array_equal(motion.position_m[:, [4, 1]], alone.position_m)
    np.testing.assert_array_equal(motion.orientation_xyzw[:, [4, 1]], alone.orientation_xyzw)
    _, others = flown(drones=3)
    np.testing.assert_array_equal(motion.position_m[:, [0, 2, 3]], others.position_m)


def test_a_station_stands_level_in_any_wind_and_needs_no_rotors() -> None:
    fleet, motion = flown(
        drones=3, ground=[{"drone": 1, "position_m": [9, 8, 7]}], motion={"wind_mps": [9, 9], "pose_jitter_m": 2}
    )
    assert (motion.position_m[:, 1] == (9, 8, 7)).all()
    assert (motion.est_position_m[:, 1] == (9, 8, 7)).all()
    assert (motion.orientation_xyzw[:, 1] == (0, 0, 0, 1)).all()
    for still in (motion.velocity_mps, motion.acceleration_mps2, motion.body_rates_radps, motion.est_yaw_rad):
        assert not still[:, 1].any()
    power_w = fleet_power_w(fleet, motion)
    assert not power_w[:, 1].any()
    assert power_w[:, [0, 2]].min() > 50
    assert fleet.altitudes_m == (60, 7, 60)


steps = st.lists(
    st.tuples(st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-3, 3)), st.floats(0.2, 20)), max_size=8
)


@settings(max_examples=40, deadline=None)
@given(steps, st.floats(0.5, 6))
def test_a_staircase_is_the_polyline_smoothed_by_a_quadratic_b_spline(
    given_steps: list[tuple[tuple[float, float, float], float]], width_s: float
) -> None:
    """The same curve by brute force: sample the polyline in time and convolve."""
    way = Staircase((1.0, 2.0, 3.0), [Step(*step) for step in given_steps], width_s)
    velocities = np.array([v for v, _ in given_steps] or [(0.0, 0.0, 0.0)])
    ends_s = np.cumsum([0.0, *(lasts for _, lasts in given_steps)])
    ways = velocities[: len(given_steps)] * np.diff(ends_s)[:, None]
    corners = np.array((1.0, 2.0, 3.0)) + np.vstack([np.zeros(3), np.cumsum(ways, axis=0).reshape(-1, 3)])

    def polyline(t_s: np.ndarray) -> np.ndarray:
        flown = np.stack([np.interp(t_s, ends_s, column) for column in corners.T], axis=-1)
        return flown + np.where(t_s < 0, t_s, 0)[:, None] * velocities[0]  # it begins at speed

    kernel = BSpline.basis_element(np.linspace(-width_s / 2, width_s / 2, 4))
    shift = np.linspace(-width_s / 2, width_s / 2, 8001)
    weight = kernel(shift) / kernel(shift).sum()
    time_s = np.linspace(0, ends_s[-1] + width_s, 23)
    position, _, _ = way.at(time_s)
    brute = np.array([weight @ polyline(t - shift) for t in time_s])
    np.testing.assert_allclose(position, brute, atol=1e-4)


LANDS_FIRST = [{"action": "land"}, {"to_m": [1, 1]}]
CLIMBS = [{"to_m": [1, 1]}, {"to_m": [2, 2], "altitude_m": 395}]
HIGH = [{"name": "high", "drones": [1], "altitude_offset_m": 10}]
TOO_HIGH = "must be such that its drones fly at 10 to 400 m"
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"groups": [{"drones": [7]}]}, "groups.0.drones.0: 7, must be below fleet.drones = 5"),
    (
        {"groups": [{"drones": [1]}, {"drones": [2, 1]}]},
        "groups.1.drones.1: 1, must be named once, it is in groups.0 already",
    ),
    (
        {"groups": [{"drones": [1]}], "ground": [{"drone": 1}]},
        "ground.0.drone: 1, must be named once, it is in groups.0 already",
    ),
    ({"groups": [{"drones": [1], "legs": LANDS_FIRST}]}, "legs.0.action: land, must be the last leg"),
    ({"groups": [{"drones": [1], "legs": [{"action": "hold"}]}]}, "for_s: missing, must be given for hold"),
    (
        {"groups": [{"drones": [1], "legs": [{"action": "land", "speed_mps": 3}]}]},
        "speed_mps: 3.0, must be left out for land",
    ),
    (
        {"groups": [{"drones": [1], "legs": CLIMBS}], "makes": HIGH},
        f"makes.0.altitude_offset_m: 10, {TOO_HIGH}, groups.0.legs.1.altitude_m is 395",
    ),
    (
        {"groups": [{"drones": [2]}, {"drones": [1], "formation": {"altitude_m": 399}}], "makes": HIGH},
        f"{TOO_HIGH}, groups.1.formation.altitude_m is 399",
    ),
]


def test_what_does_not_fit_is_refused() -> None:
    wrong = {}
    for changes, said in REFUSED:
        with pytest.raises(ValueError, match=r".") as refused:
            Fleet.model_validate(changes)
        if said not in str(refused.value):
            wrong[said] = str(refused.value)
    assert wrong == {}
