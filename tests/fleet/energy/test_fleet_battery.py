"""Power against published values, the pack against an independent integration, the ledger against itself."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp
from scipy.interpolate import PchipInterpolator
from scipy.optimize import minimize_scalar

from sortie.fleet.energy import cell
from sortie.fleet.energy.battery import CAUSES, FleetBatteries
from sortie.fleet.energy.cell import current_a, energy_fraction, open_circuit_cell_v
from sortie.fleet.flight.rotor import climb_power_w, rotor_power_w
from sortie.scenarios.schema import Battery, DroneOverride

HOVER_W = 168.48


@pytest.mark.parametrize(
    ("air_speed_mps", "power_w"), [(0, 168.48), (5, 143.6), (10, 126.0), (15, 138.5), (20, 178.3), (30, 356.3)]
)
def test_rotor_power_at_published_constants(air_speed_mps: float, power_w: float) -> None:
    assert rotor_power_w(air_speed_mps) == pytest.approx(power_w, rel=1e-3)


def test_least_power_and_best_range() -> None:
    least = minimize_scalar(lambda v: float(rotor_power_w(v)), bounds=(1, 30), method="bounded")
    assert (least.x, least.fun) == (pytest.approx(10.21, rel=1e-3), pytest.approx(125.99, rel=1e-3))
    best = minimize_scalar(lambda v: float(rotor_power_w(v)) / v, bounds=(1, 40), method="bounded")
    assert (best.x, best.fun) == (pytest.approx(18.29, rel=1e-3), pytest.approx(8.83, rel=1e-3))


@given(st.floats(0, 60))
def test_rotor_power_term_by_term(v: float) -> None:
    """The formula as printed, in scalars."""
    profile = 79.8563 * (1 + 3 * v**2 / 120**2)
    induced = 88.6279 * math.sqrt(math.sqrt(1 + v**4 / (4 * 4.03**4)) - v**2 / (2 * 4.03**2))
    assert float(rotor_power_w(v)) == pytest.approx(
        profile + induced + 0.5 * 0.6 * 1.225 * 0.05 * 0.503 * v**3, rel=1e-9
    )


def test_climbing_costs_its_potential_energy_and_descending_returns_none() -> None:
    np.testing.assert_allclose(climb_power_w([2.0, 0.0, -2.0]), [2.04 * 9.81 * 2, 0, 0])


def test_open_circuit_curve() -> None:
    np.testing.assert_allclose(
        open_circuit_cell_v([1.0, 0.8, 0.6, 0.4, 0.2, 0.1, 0.0]), [4.20, 3.98, 3.87, 3.79, 3.74, 3.68, 3.2]
    )
    assert (np.diff(open_circuit_cell_v(np.linspace(0, 1, 1001))) > 0).all()


@pytest.mark.parametrize("soc", [0.05, 0.3, 0.77, 1.0])
def test_energy_is_the_integral_of_voltage_over_charge(soc: float) -> None:
    volts = lambda s: float(open_circuit_cell_v(s))  # noqa: E731
    integral = quad(volts, 0, soc, points=[0.1, 0.2, 0.4])[0] / quad(volts, 0, 1, points=[0.1, 0.2, 0.4, 0.6, 0.8])[0]
    assert float(energy_fraction(soc)) == pytest.approx(integral, rel=1e-9)


@given(st.floats(0, 2000), st.floats(3, 100), st.floats(0, 2))
def test_current_delivers_the_power_at_the_terminals(power_w: float, ocv: float, resistance: float) -> None:
    current = current_a(power_w, ocv, resistance)
    if current is None:
        assert power_w > ocv**2 / (4 * resistance) * (1 - 1e-9)
    else:
        assert (ocv - current * resistance) * current == pytest.approx(power_w, rel=1e-9, abs=1e-9)
        assert current * resistance <= ocv / 2 * (1 + 1e-9)  # the lower root, on the stable side


def steady(batteries: FleetBatteries, n: int, seconds: float, rotor_w: float = HOVER_W, dt_s: float = 0.1) -> None:
    for _ in range(round(seconds / dt_s)):
        batteries.step(dt_s, [rotor_w] * n, [0.5] * n, [0.1] * n)


def test_each_cause_gets_its_share() -> None:
    b = FleetBatteries(Battery(), (), 1)
    steady(b, 1, 60.0)
    spent = {cause: b.energy_j[cause][0] / 60.0 for cause in CAUSES}
    assert spent["rotor"] == pytest.approx(HOVER_W / 0.8)
    assert spent["avionics"] == pytest.approx(8.0)
    assert spent["compute"] == pytest.approx(10 + 0.5 * 30)
    assert spent["radio"] == pytest.approx(2 + 0.1 * 4)
    assert spent["ohmic"] == pytest.approx(b.current_a[0] ** 2 * 0.052, rel=0.02)  # it rises as the pack sags
    assert spent["fault"] == 0


def test_hover_outweighs_the_radio_about_a_hundredfold() -> None:
    b = FleetBatteries(Battery(), (), 1)
    steady(b, 1, 10.0)
    assert 50 < b.energy_j["rotor"][0] / b.energy_j["radio"][0] < 150


def test_the_pack_against_an_independent_integration() -> None:
    """d(soc)/dt = −I/Q with Q in coulombs and I from the quadratic, by an adaptive solver."""
    config = Battery(capacity_wh=60.0, initial_soc=1.0, landing_soc=0.05)
    load_w = HOVER_W / 0.8 + 8 + 25 + 2.4
    mean_v = quad(lambda s: float(open_circuit_cell_v(s)), 0, 1, points=[0.1, 0.2, 0.4, 0.6, 0.8])[0]
    charge_c = 60.0 * 3600 / (4 * mean_v)

    def rate(_: float, soc: np.ndarray) -> list[float]:
        ocv = 4 * float(open_circuit_cell_v(soc[0]))
        return [-(ocv - math.sqrt(ocv**2 - 4 * 0.052 * load_w)) / (2 * 0.052) / charge_c]

    reference = solve_ivp(rate, (0, 600), [1.0], rtol=1e-9, atol=1e-12, t_eval=[300, 600]).y[0]
    b = FleetBatteries(config, (), 1)
    steady(b, 1, 300.0)
    assert b.soc[0] == pytest.approx(reference[0], abs=2e-5)
    steady(b, 1, 300.0)
    assert b.soc[0] == pytest.approx(reference[1], abs=2e-5)


def test_voltage_sags_by_current_times_resistance() -> None:
    stiff = FleetBatteries(Battery(cell_resistance_mohm=0), (), 1)
    soft = FleetBatteries(Battery(), (), 1)
    at_rest = soft.voltage_v[0]
    for b in (stiff, soft):
        b.step(0.1, [HOVER_W], [0.5], [0.1])
    assert stiff.voltage_v[0] == pytest.approx(at_rest, abs=1e-5)
    assert stiff.energy_j["ohmic"][0] == 0
    assert soft.voltage_v[0] == pytest.approx(at_rest - soft.current_a[0] * 4 * 0.013, abs=1e-5)
    assert soft.voltage_v[0] * soft.current_a[0] == pytest.approx(HOVER_W / 0.8 + 8 + 25 + 2.4)


packs = st.builds(
    Battery,
    capacity_wh=st.floats(0.05, 200),
    cells=st.integers(1, 12),
    initial_soc=st.floats(0.01, 1),
    cell_resistance_mohm=st.floats(0, 100),
    drivetrain_efficiency=st.floats(0.3, 1),
    landing_soc=st.floats(0, 0.5),
)
loads = st.lists(
    st.tuples(st.floats(0.01, 2), st.floats(0, 600), st.floats(0, 1), st.floats(0, 1), st.floats(0, 0.9) | st.none()),
    max_size=40,
)


@settings(max_examples=300)
@given(packs, loads)
def test_ledger_sums_to_what_left_the_pack(
    config: Battery, flight: list[tuple[float, float, float, float, float | None]]
) -> None:
    b = FleetBatteries(config, (), 2)
    before_j, soc = list(b.energy_left_j), list(b.soc)
    for dt_s, rotor_w, duty, airtime, lost in flight:
        if lost is not None:
            b.fault(0, lost)
        b.step(dt_s, [rotor_w, 0.0], [duty, 0.0], [airtime, 0.0])
        for i in range(2):
            assert 0 <= b.soc[i] <= soc[i] + 1e-6  # the look-up is good to 1e-6
            assert b.energy_left_j[i] >= 0
            assert b.voltage_v[i] > 0
            assert b.current_a[i] >= 0
            assert b.landed[i] or b.soc[i] > config.landing_soc
            left = before_j[i] - sum(b.energy_j[cause][i] for cause in CAUSES)
            assert b.energy_left_j[i] == pytest.approx(left, rel=1e-9, abs=1e-9 * before_j[i])
        soc = list(b.soc)


def test_empty_means_landing_and_not_a_negative_number() -> None:
    b = FleetBatteries(Battery(capacity_wh=0.5, landing_soc=0.0, cell_resistance_mohm=0), (), 1)
    before_j = b.energy_left_j[0]
    steady(b, 1, 60.0)
    assert b.landed == [True]
    assert b.energy_left_j == [0.0]
    assert b.soc == [0.0]
    assert sum(b.energy_j[cause][0] for cause in CAUSES) == pytest.approx(before_j, rel=1e-12)


def test_it_lands_at_landing_soc_and_then_draws_nothing() -> None:
    b = FleetBatteries(Battery(capacity_wh=10, landing_soc=0.3), (), 1)
    while not b.landed[0]:
        b.step(0.1, [HOVER_W], [1.0], [0.0])
    assert 0.299 < b.soc[0] <= 0.3
    assert b.current_a == [0.0]
    assert b.voltage_v[0] == pytest.approx(4 * float(open_circuit_cell_v(b.soc[0])), abs=1e-5)
    spent, left = {k: list(v) for k, v in b.energy_j.items()}, list(b.energy_left_j)
    steady(b, 1, 10.0)
    assert (b.energy_j, b.energy_left_j) == (spent, left)


def test_a_pack_too_weak_for_its_load_lands_at_once() -> None:
    b = FleetBatteries(Battery(cells=1, cell_resistance_mohm=50), (), 1)  # 4 V, 50 mΩ: 80 W at most
    b.step(0.1, [HOVER_W], [0.0], [0.0])
    assert b.landed == [True]
    assert not any(b.energy_j[cause][0] for cause in CAUSES)


def test_a_fault_takes_energy_at_once_and_may_land() -> None:
    b = FleetBatteries(Battery(initial_soc=0.8), (), 2)
    before_j = b.energy_left_j[0]
    b.fault(0, 0.5)
    assert b.energy_j["fault"] == [pytest.approx(before_j / 2), 0.0]
    assert b.landed == [False, False]
    assert float(energy_fraction(b.soc[0])) == pytest.approx(before_j / 2 / (130 * 3600), rel=1e-6)
    b.fault(0, 0.9)
    assert b.landed == [True, False]
    with pytest.raises(ValueError, match=r"lost_fraction is 1\.5, must be in \[0, 1\]"):
        b.fault(1, 1.5)


def test_told_to_land() -> None:
    b = FleetBatteries(Battery(), (), 3)
    b.land(1)
    steady(b, 3, 1.0)
    assert b.landed == [False, True, False]
    assert b.energy_j["rotor"][1] == 0


def test_overrides_touch_their_drone_alone() -> None:
    overrides = (
        DroneOverride(drone=1, initial_soc=0.5),
        DroneOverride(drone=2, capacity_wh=13.0, cell_resistance_mohm=0),
    )
    plain, b = FleetBatteries(Battery(), (), 4), FleetBatteries(Battery(), overrides, 4)
    assert b.soc == [0.95, 0.5, 0.95, 0.95]
    for each in (plain, b):
        steady(each, 4, 10.0)
    for i in (0, 3):
        assert [b.energy_j[c][i] for c in CAUSES] == [plain.energy_j[c][i] for c in CAUSES]
        assert (b.soc[i], b.voltage_v[i]) == (plain.soc[i], plain.voltage_v[i])
    assert b.energy_j["ohmic"][2] == 0
    assert 0.95 - b.soc[2] == pytest.approx(10 * (0.95 - b.soc[0]), rel=0.1)
    assert b.voltage_v[1] < b.voltage_v[0]


@pytest.mark.parametrize("soc", [0.001, 0.0731, 0.3333, 0.95, 1.0])
def test_the_tables_are_good_to_a_millionth(soc: float) -> None:
    b = FleetBatteries(Battery(initial_soc=soc, landing_soc=0), (), 1)
    b.fault(0, 0.0)  # reads charge and voltage off the energy
    assert b.soc[0] == pytest.approx(soc, abs=1e-6)
    assert b.voltage_v[0] == pytest.approx(4 * float(open_circuit_cell_v(soc)), abs=2e-3 if soc < 0.01 else 2e-5)


def test_the_cells_curve_is_the_monotone_cubic_through_its_points() -> None:
    curve = PchipInterpolator(cell._SOC, cell._CELL_V)
    energy = curve.antiderivative()
    soc = np.linspace(0.0, 1.0, 10_001)
    np.testing.assert_allclose(cell.open_circuit_cell_v(soc), curve(soc), rtol=1e-15)
    np.testing.assert_allclose(cell.energy_fraction(soc), energy(soc) / energy(1.0), rtol=1e-14)
    assert np.diff(cell.open_circuit_cell_v(soc)).min() > 0
