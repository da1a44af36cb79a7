"""Power of any airframe: published values, scaling laws, and momentum theory against its own equation."""

from __future__ import annotations

import math
from itertools import product

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
from sortie.scenarios.schema import Airframe, DroneOverride, Fleet, Motion

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


def test_tip_speed_is_that_of_hover_without_payload() -> None:
    """The profile's part that falls with the tips' speed: hover's profile power, times 3 V² / tip speed²."""
    for mass_kg, payload_kg in ((2.04, 0.0), (4.5, 0.0), (2.04, 1.2), (5.0, 2.0)):
        frames = (Airframe(mass_kg=mass_kg, payload_kg=payload_kg, tip_speed_mps=tip) for tip in (150.0, 100.0))
        fast, slow = (float(rotor_power_w(12.0, frame)) for frame in frames)
        profile_w = 79.8563 * ((mass_kg + payload_kg) / 2.04) ** 1.5
        tips = 1 + payload_kg / mass_kg  # how much a payload raises the square of the speed
        wanted_w = profile_w * 3 * 12.0**2 * (1 / 100.0**2 - 1 / 150.0**2) / tips
        assert slow - fast == pytest.approx(wanted_w, rel=1e-9), (mass_kg, payload_kg)


def test_rotor_power_at_published_constants() -> None:
    published = {0: 168.48, 5: 143.6, 10: 126.0, 15: 138.5, 20: 178.3, 30: 356.3}
    assert {v: float(rotor_power_w(v)) for v in published} == pytest.approx(published, rel=1e-3)


@given(st.floats(0, 60))
def test_rotor_power_term_by_term(v: float) -> None:
    """The formula as printed, in scalars."""
    profile = 79.8563 * (1 + 3 * v**2 / 120**2)
    induced = 88.6279 * math.sqrt(math.sqrt(1 + v**4 / (4 * 4.03**4)) - v**2 / (2 * 4.03**2))
    assert float(rotor_power_w(v)) == pytest.approx(
        profile + induced + 0.5 * 0.6 * 1.225 * 0.05 * 0.503 * v**3, rel=1e-9
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


def test_drag_takes_power_along_the_whole_way_through_the_air() -> None:
    """Half of density, drag area and the cube of the speed: forward, upward and both."""
    frames = [Airframe(power_model="momentum", drag_area_m2=area) for area in (0.04, 0.0)]
    for velocity in ((8.0, 0.0, 0.0), (0.0, 0.0, 5.0), (6.0, 2.0, 3.0)):
        with_drag, without = (float(momentum_power_w(np.array(velocity), np.zeros(3), frame)) for frame in frames)
        speed = float(np.linalg.norm(velocity))
        assert with_drag - without == pytest.approx(0.5 * 1.225 * 0.04 * speed**3, rel=1e-6), velocity


def test_climbing_costs_its_potential_energy_and_descent_gives_nothing_back() -> None:
    np.testing.assert_allclose(climb_power_w([2.0, 0.0, -2.0]), [2.04 * 9.81 * 2, 0, 0])
    still, down = np.zeros(3), np.array([0.0, 0.0, -2.0])
    assert momentum_power_w(down, still) == pytest.approx(float(momentum_power_w(still, still)))


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


def test_every_drone_pays_for_its_own_load_in_level_flight_and_in_climb() -> None:
    """Also where drones of two kinds have numbers in turn, and each another load."""
    loads = tuple(DroneOverride(drone=i, payload_kg=0.4 * i) for i in range(4))
    for model, heavy in product(("level", "momentum"), ((), (2, 0))):
        frame, large = Airframe(power_model=model), Airframe(power_model=model, mass_kg=4.0, disc_area_m2=0.9)
        makes = ({"name": "large", "drones": heavy, "airframe": large},) if heavy else ()
        fleet = Fleet(airframe=frame, drones=4, overrides=loads, makes=makes)
        motion = fly(fleet, 6.0, 0.1, 1)
        power_w = fleet_power_w(fleet, motion)
        assert (motion.velocity_mps[..., 2] > 0.05).any()
        for drone in range(4):
            own = (large if drone in heavy else frame).model_copy(update={"payload_kg": 0.4 * drone})
            air_mps = motion.velocity_mps[:, drone] - motion.wind_mps[:, drone]
            if model == "momentum":
                wanted = momentum_power_w(air_mps, motion.acceleration_mps2[:, drone], own)
            else:
                level_w = rotor_power_w(np.hypot(*air_mps[:, :2].T), own)
                wanted = level_w + climb_power_w(motion.velocity_mps[:, drone, 2], own)
            np.testing.assert_allclose(power_w[:, drone], wanted, rtol=1e-9)
