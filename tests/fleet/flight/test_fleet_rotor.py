"""Power of any airframe: scaling laws, momentum theory against its own equation and against the level formula."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sortie.fleet.flight.motion import fly
from sortie.fleet.flight.rotor import (
    climb_power_w,
    figure_of_merit,
    fleet_power_w,
    induced_speed,
    momentum_power_w,
    rotor_power_w,
)
from sortie.scenarios.schema import Airframe, DroneOverride, Fleet, Motion, Route

speeds = st.floats(0, 25)
airframes = st.builds(
    Airframe,
    mass_kg=st.floats(0.3, 20),
    payload_kg=st.floats(0, 5),
    disc_area_m2=st.floats(0.05, 3),
    figure_of_merit=st.floats(0.3, 0.8),
    tip_speed_mps=st.floats(40, 200),
    drag_area_m2=st.floats(0, 0.2),
    air_density_kgpm3=st.floats(0.5, 1.4),
)


def ideal_w(airframe: Airframe) -> float:
    thrust_n = (airframe.mass_kg + airframe.payload_kg) * 9.81
    return thrust_n**1.5 / math.sqrt(2 * airframe.air_density_kgpm3 * airframe.disc_area_m2)


@given(airframes)
def test_hover_is_ideal_power_over_the_figure_of_merit(airframe: Airframe) -> None:
    """The default's constants are rounded (its figure of merit is 0.4782, the schema says 0.478): 0.2 % apart."""
    assert float(rotor_power_w(0.0, airframe)) == pytest.approx(ideal_w(airframe) / airframe.figure_of_merit, rel=2e-3)


@given(airframes, st.floats(1.01, 2))
def test_payload_and_thin_air_raise_hover_by_their_laws(airframe: Airframe, times: float) -> None:
    hover_w = float(rotor_power_w(0.0, airframe))
    laden = airframe.model_copy(
        update={"payload_kg": (airframe.mass_kg + airframe.payload_kg) * times - airframe.mass_kg}
    )
    thin = airframe.model_copy(update={"air_density_kgpm3": airframe.air_density_kgpm3 / times})
    assert float(rotor_power_w(0.0, laden)) == pytest.approx(hover_w * times**1.5, rel=1e-9)
    assert float(rotor_power_w(0.0, thin)) == pytest.approx(hover_w * times**0.5, rel=1e-9)


def test_payload_at_speed_against_the_formula_by_hand() -> None:
    """1 kg more on the default machine at 10 m/s: every term with its own scale."""
    load = 3.04 / 2.04
    profile = 79.8563 * load**1.5 * (1 + 3 * 100 / (120.0**2 * load))
    v02 = 4.03**2 * load
    induced = 88.6279 * load**1.5 * math.sqrt(math.sqrt(1 + 1e4 / (4 * v02**2)) - 100 / (2 * v02))
    parasite = 0.5 * 0.6 * 1.225 * 0.05 * 0.503 * 1000
    assert float(rotor_power_w(10.0, Airframe(payload_kg=1.0))) == pytest.approx(
        profile + induced + parasite, rel=1e-12
    )


@given(st.floats(0, 8), st.floats(0, 5))
def test_induced_speed_solves_glauerts_equation(forward: float, climb: float) -> None:
    x = float(induced_speed(forward, climb))
    assert 0 < x <= 1
    assert x * math.hypot(forward, climb + x) == pytest.approx(1.0, abs=1e-9)


@given(st.floats(0, 4))
def test_induced_speed_in_axial_climb_is_the_closed_form(climb: float) -> None:
    assert float(induced_speed(0.0, climb)) == pytest.approx(-climb / 2 + math.sqrt(climb**2 / 4 + 1), abs=1e-10)


@given(airframes, speeds, st.floats(-math.pi, math.pi))
def test_momentum_theory_is_the_formula_in_steady_level_flight(airframe: Airframe, v: float, heading: float) -> None:
    air = np.array([v * math.cos(heading), v * math.sin(heading), 0.0])
    power_w = float(momentum_power_w(air, np.zeros(3), airframe))
    assert power_w == pytest.approx(float(rotor_power_w(v, airframe)), rel=1e-9)


@given(airframes, st.floats(0.1, 8))
def test_a_climbs_inflow_pays_for_part_of_it(airframe: Airframe, climb: float) -> None:
    """Between hover alone and hover with all of m·g·w; a slow climb costs about 1 − 1.1/2 of it."""
    hover_w = float(rotor_power_w(0.0, airframe))
    drag_w = 0.5 * airframe.air_density_kgpm3 * airframe.drag_area_m2 * climb**3
    cost_w = float(momentum_power_w(np.array([0.0, 0.0, climb]), np.zeros(3), airframe)) - hover_w - drag_w
    full_w = float(climb_power_w(climb, airframe))
    assert 0.44 * full_w < cost_w < full_w
    slow = float(momentum_power_w(np.array([0.0, 0.0, 1e-3]), np.zeros(3), airframe)) - hover_w
    assert slow == pytest.approx(0.45 * float(climb_power_w(1e-3, airframe)), rel=0.02)


def test_descent_gives_nothing_back() -> None:
    still, down = np.zeros(3), np.array([0.0, 0.0, -2.0])
    assert momentum_power_w(down, still) == pytest.approx(float(momentum_power_w(still, still)))
    assert climb_power_w(-2.0) == 0.0


def test_acceleration_upwards_costs_thrust_to_the_power_of_three_halves() -> None:
    hover_w = float(momentum_power_w(np.zeros(3), np.zeros(3)))
    pushed_w = float(momentum_power_w(np.zeros(3), np.array([0.0, 0.0, 9.81])))
    assert pushed_w == pytest.approx(hover_w * 2**1.5, rel=1e-9)


def test_speeding_up_costs_the_kinetic_energy_and_braking_gives_it_back() -> None:
    air, push = np.array([10.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
    faster_w, slower_w = float(momentum_power_w(air, push)), float(momentum_power_w(air, -push))
    assert faster_w - slower_w == pytest.approx(2 * 2.04 * 10, rel=1e-9)  # the thrust is the same in both
    assert (faster_w + slower_w) / 2 == pytest.approx(float(momentum_power_w(air, np.zeros(3))), rel=0.01)


def test_figure_of_merit_is_ideal_over_true_power() -> None:
    """By hand for CT 0.12, CP 0.05, D 0.25 m, 80 turns a second, air of 1.2 kg/m³."""
    thrust, power = 0.12 * 1.2 * 80**2 * 0.25**4, 0.05 * 1.2 * 80**3 * 0.25**5
    ideal = thrust**1.5 / math.sqrt(2 * 1.2 * math.pi * 0.125**2)
    assert figure_of_merit(0.12, 0.05) == pytest.approx(ideal / power, rel=1e-12)


def test_wind_changes_the_air_speed_and_with_it_the_power() -> None:
    """Hovering in a steady 10 m/s of wind is flying at 10 m/s."""
    fleet = Fleet(motion=Motion(wind_mps=(6, 8), gust_sigma_mps=0, pose_jitter_m=0))
    np.testing.assert_allclose(fleet_power_w(fleet, fly(fleet, 2.0, 0.1, 1)), float(rotor_power_w(10.0)), rtol=1e-9)


@pytest.mark.parametrize("model", ["level", "momentum"])
def test_only_the_laden_drone_pays(model: str) -> None:
    airframe = Airframe(power_model=model)
    empty = Fleet(airframe=airframe, route=Route(waypoints_m=((0, 0), (100, 0))))
    laden = empty.model_copy(update={"overrides": (DroneOverride(drone=2, payload_kg=0.5),)})
    motion = fly(empty, 5.0, 0.1, 1)
    before, after = fleet_power_w(empty, motion), fleet_power_w(laden, motion)
    assert (after[:, 2] > 1.2 * before[:, 2]).all()
    np.testing.assert_array_equal(np.delete(after, 2, 1), np.delete(before, 2, 1))


def test_the_default_is_the_formula_bit_for_bit() -> None:
    fleet = Fleet()
    motion = fly(fleet, 10.0, 0.1, 3)
    v2 = np.square(motion.air_speed_mps)
    x = v2 / (2 * 4.03**2)
    level = (
        79.8563 * (1 + 3 * v2 / 120.0**2)
        + 88.6279 / np.sqrt(np.sqrt(1 + x * x) + x)
        + 0.5 * 0.6 * 1.225 * 0.05 * 0.503 * v2 * np.sqrt(v2)
    )
    climb = 2.04 * 9.81 * np.maximum(motion.velocity_mps[..., 2], 0.0)
    np.testing.assert_array_equal(fleet_power_w(fleet, motion), level + climb)
