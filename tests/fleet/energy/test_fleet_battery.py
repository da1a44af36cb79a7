"""Packs against closed forms and an independent integration: cells, where energy goes, landing, plug-in cells."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp
from scipy.interpolate import PchipInterpolator

from sortie.fleet.energy import cell
from sortie.fleet.energy.battery import CAUSES, RECORDED, FleetBatteries
from sortie.fleet.energy.cell import (
    cell_curve,
    current_a,
    energy_fraction,
    open_circuit_cell_v,
)
from sortie.fleet.energy.recorded import BatteryTrace
from sortie.scenarios.schema import Battery, DroneOverride

HOVER_W = 168.48
LOAD_W = HOVER_W / 0.8 + 8 + 25 + 2.4
"""What `steady` draws: rotors, avionics, half a computer and a tenth of the air."""


def steady(batteries: FleetBatteries, seconds: float, rotor_w: float = HOVER_W, dt_s: float = 0.1) -> None:
    n = len(batteries.soc)
    for _ in range(round(seconds / dt_s)):
        batteries.step(dt_s, [rotor_w] * n, [0.5] * n, [0.1] * n)


# --- the cell ---------------------------------------------------------------------------------------------


def test_the_cells_curve_is_the_monotone_cubic_through_its_points() -> None:
    """Energy is its integral over charge."""
    volts = [4.20, 3.98, 3.87, 3.79, 3.74, 3.68, 3.2]
    np.testing.assert_allclose(open_circuit_cell_v([1.0, 0.8, 0.6, 0.4, 0.2, 0.1, 0.0]), volts)
    curve = PchipInterpolator(cell._SOC, cell._CELL_V)
    energy = curve.antiderivative()
    soc = np.linspace(0.0, 1.0, 10_001)
    np.testing.assert_allclose(open_circuit_cell_v(soc), curve(soc), rtol=1e-15)
    np.testing.assert_allclose(energy_fraction(soc), energy(soc) / energy(1.0), rtol=1e-14)
    assert np.diff(open_circuit_cell_v(soc)).min() > 0


@given(st.floats(0, 2000), st.floats(3, 100), st.floats(0, 2))
def test_current_delivers_the_power_at_the_terminals(power_w: float, ocv: float, resistance: float) -> None:
    current = current_a(power_w, ocv, resistance)
    if current is None:
        assert power_w > ocv**2 / (4 * resistance) * (1 - 1e-9)
    else:
        assert (ocv - current * resistance) * current == pytest.approx(power_w, rel=1e-9, abs=1e-9)
        assert current * resistance <= ocv / 2 * (1 + 1e-9)  # the lower root, on the stable side


def test_the_tables_are_good_to_a_millionth() -> None:
    for soc in (0.001, 0.0731, 0.3333, 0.95, 1.0):
        b = FleetBatteries(Battery(initial_soc=soc, landing_soc=0), (), 1)
        b.fault(0, 0.0)  # reads charge and voltage off the energy
        assert b.soc[0] == pytest.approx(soc, abs=1e-6)
        assert b.voltage_v[0] == pytest.approx(4 * float(open_circuit_cell_v(soc)), abs=2e-3 if soc < 0.01 else 2e-5)


# --- a pack of them ---------------------------------------------------------------------------------------


def test_each_cause_gets_its_share() -> None:
    """Rotors by the efficiency of each drone's own drive."""
    b = FleetBatteries([Battery(), Battery(drivetrain_efficiency=0.5)], (), 2)
    steady(b, 60.0)
    spent = {cause: b.energy_j[cause][0] / 60.0 for cause in CAUSES}
    assert spent["rotor"] == pytest.approx(HOVER_W / 0.8)
    assert b.energy_j["rotor"][1] / 60.0 == pytest.approx(HOVER_W / 0.5)
    assert spent["avionics"] == pytest.approx(8.0)
    assert spent["compute"] == pytest.approx(10 + 0.5 * 30)
    assert spent["radio"] == pytest.approx(2 + 0.1 * 4)
    assert spent["ohmic"] == pytest.approx(b.current_a[0] ** 2 * 0.052, rel=0.02)  # it rises as the pack sags
    assert spent["fault"] == 0


def test_the_pack_against_an_independent_integration() -> None:
    """d(soc)/dt = −I/Q with Q in coulombs and I from the quadratic, by an adaptive solver."""
    mean_v = quad(lambda s: float(open_circuit_cell_v(s)), 0, 1, points=[0.1, 0.2, 0.4, 0.6, 0.8])[0]
    charge_c = 60.0 * 3600 / (4 * mean_v)

    def rate(_: float, soc: np.ndarray) -> list[float]:
        ocv = 4 * float(open_circuit_cell_v(soc[0]))
        return [-(ocv - math.sqrt(ocv**2 - 4 * 0.052 * LOAD_W)) / (2 * 0.052) / charge_c]

    reference = solve_ivp(rate, (0, 600), [1.0], rtol=1e-9, atol=1e-12, t_eval=[300, 600]).y[0]
    b = FleetBatteries(Battery(capacity_wh=60.0, initial_soc=1.0, landing_soc=0.05), (), 1)
    for wanted in reference:
        steady(b, 300.0)
        assert b.soc[0] == pytest.approx(wanted, abs=2e-5)


def test_overrides_touch_their_drone_alone() -> None:
    weak = DroneOverride(drone=2, capacity_wh=13.0, cell_resistance_mohm=0)
    overrides = (DroneOverride(drone=1, initial_soc=0.5), weak, DroneOverride(drone=3, cycles=200))
    plain, b = FleetBatteries(Battery(), (), 5), FleetBatteries(Battery(), overrides, 5)
    assert b.soc == [0.95, 0.5, 0.95, 0.95, 0.95]
    for each in (plain, b):
        steady(each, 10.0)
    for i in (0, 4):
        assert [b.energy_j[c][i] for c in CAUSES] == [plain.energy_j[c][i] for c in CAUSES]
        assert (b.soc[i], b.voltage_v[i]) == (plain.soc[i], plain.voltage_v[i])
    assert b.energy_j["ohmic"][2] == 0
    assert 0.95 - b.soc[2] == pytest.approx(10 * (0.95 - b.soc[0]), rel=0.1)
    assert b.voltage_v[1] < b.voltage_v[0]
    assert b.soc[3] < b.soc[0]


# --- landing ----------------------------------------------------------------------------------------------


def test_it_lands_at_landing_soc_and_then_draws_nothing() -> None:
    b = FleetBatteries(Battery(capacity_wh=10, landing_soc=0.3), (), 1)
    while not b.landed[0]:
        steady(b, 0.1)
    assert 0.299 < b.soc[0] <= 0.3
    assert b.current_a == [0.0]
    assert b.voltage_v[0] == pytest.approx(4 * float(open_circuit_cell_v(b.soc[0])), abs=1e-5)
    spent, left = {k: list(v) for k, v in b.energy_j.items()}, list(b.energy_left_j)
    steady(b, 10.0)
    assert (b.energy_j, b.energy_left_j) == (spent, left)


def test_a_pack_gives_no_more_than_it_has() -> None:
    """Its last step is as long as its energy lasts, and the rotors' share is of that."""
    packs = FleetBatteries(Battery(capacity_wh=2.0, landing_soc=0.0, cell_resistance_mohm=3), (), 1)
    begin_j = packs.energy_left_j[0]
    for _ in range(60):
        before = {cause: of[0] for cause, of in packs.energy_j.items()}
        packs.step(1.0, [170.0], [1.0], [0.1])
        if packs.landed[0]:
            break
    assert packs.landed[0]
    assert packs.spent_j[0] == pytest.approx(begin_j)
    assert packs.energy_left_j[0] == 0.0
    lasts_s = (packs.energy_j["avionics"][0] - before["avionics"]) / 8.0
    assert 0.0 < lasts_s < 1.0
    assert packs.energy_j["rotor"][0] - before["rotor"] == pytest.approx(170.0 / 0.8 * lasts_s)


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


def test_a_member_on_the_mains_is_full_whatever_is_said_of_its_pack() -> None:
    """A low charge, an override, a trace, faults: nothing is drawn of it, and it never lands."""
    low = (DroneOverride(drone=1, initial_soc=0.3),)
    fallen = BatteryTrace([0.0, 10.0], [0.9, 0.2], energy_fraction([0.9, 0.2]).tolist(), [], [], [], [])
    packs = FleetBatteries(Battery(initial_soc=0.05), low, 3, {2: fallen}, mains=(1, 2))
    assert packs.landed == [True, False, False]
    assert packs.soc == [0.05, 1.0, 1.0]
    packs.fault(1, 0.9)
    packs.fault(2, 1.0)
    steady(packs, 10.0, dt_s=10.0)
    packs.take_off(2)
    assert packs.soc[1:] == [1.0, 1.0]
    assert packs.spent_j == [0.0] * 3
    assert packs.landed == [True, False, False]
    assert RECORDED not in packs.energy_j


# --- a cell of one's own ----------------------------------------------------------------------------------


CELLS = """
from sortie.fleet.energy.cell import open_circuit_cell_v


def straight(soc, *, empty_v=3.0):
    return empty_v + (4.2 - empty_v) * soc


def same(soc):
    return open_circuit_cell_v(soc)
"""


@pytest.fixture
def straight(tmp_path: Path) -> Battery:
    (tmp_path / "own.py").write_text(CELLS)
    return Battery(cell_model=f"{tmp_path / 'own.py'}:straight", cell_resistance_mohm=0.0)


def test_a_straight_cell_s_charge_by_energy_is_a_square_root(straight: Battery) -> None:
    curve = cell_curve(straight)
    soc = np.linspace(0.0, 1.0, 11)
    share = (3.0 * soc + 0.6 * soc**2) / 3.6
    np.testing.assert_allclose(curve.energy_fraction(soc), share, atol=1e-8)
    np.testing.assert_allclose(curve.open_circuit_v(soc), 3.0 + 1.2 * soc, rtol=1e-9)
    energy = np.linspace(0.0, 1.0, len(curve.soc) - 1)
    np.testing.assert_allclose(curve.soc[:-1], (np.sqrt(9.0 + 4 * 0.6 * 3.6 * energy) - 3.0) / 1.2, atol=1e-7)


def test_a_pack_of_straight_cells_drains_by_its_own_voltage(straight: Battery) -> None:
    packs = FleetBatteries([straight, Battery(cell_resistance_mohm=0.0)], (), 2)
    assert packs.voltage_v[0] == pytest.approx(4 * (3.0 + 1.2 * 0.95))
    for _ in range(600):
        packs.step(1.0, [200.0, 200.0], [1.0, 1.0], [0.0, 0.0])
    spent = packs.spent_j[0] / (130 * 3600)
    left = (3.0 * 0.95 + 0.6 * 0.95**2) / 3.6 - spent
    soc = (np.sqrt(9.0 + 4 * 0.6 * 3.6 * left) - 3.0) / 1.2
    assert packs.soc[0] == pytest.approx(soc, abs=1e-6)
    assert packs.current_a[0] == pytest.approx(packs.spent_j[0] / 600 / (4 * (3.0 + 1.2 * soc)), rel=1e-3)
    assert packs.soc[0] != packs.soc[1]


def test_cells_of_one_kind_and_other_parameters_are_other_cells(straight: Battery) -> None:
    of = [straight.model_copy(update={"cell_params": {"empty_v": v}, "initial_soc": 0.5}) for v in (3.0, 3.6, 3.0)]
    packs = FleetBatteries([*of, Battery(initial_soc=0.5)], (), 4)
    wanted = [4 * 3.6, 4 * 3.9, 4 * 3.6, 4 * float(open_circuit_cell_v(0.5))]
    assert packs.voltage_v == pytest.approx(wanted, rel=1e-4)
    falling = BatteryTrace([0.0, 10.0], [0.5, 0.4], energy_fraction([0.5, 0.4]).tolist(), [], [], [], [])
    traced = FleetBatteries(of, (), 3, {1: falling})
    left_j = of[1].capacity_wh * 3600 * float(energy_fraction(0.5))  # a trace's charge is that of the built-in cell
    assert traced.energy_left_j[1] == pytest.approx(left_j)
