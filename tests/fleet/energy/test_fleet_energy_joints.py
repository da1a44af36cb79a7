"""Packs where two of their settings meet: mains, traces, cells of one's own, lost cells, age and warmth."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from sortie.fleet.energy.battery import RECORDED, FleetBatteries
from sortie.fleet.energy.cell import COOLING_TIME_S, energy_fraction, heat_capacity_jpk, open_circuit_cell_v
from sortie.fleet.energy.recorded import BatteryTrace
from sortie.scenarios.schema import Battery, DroneOverride, Polarisation

LOAD = ([170.0], [1.0], [0.1])


def falling(*soc: float, each_s: float = 10.0) -> BatteryTrace:
    """A charge every ten seconds, without voltage and current."""
    energy = [float(energy_fraction(s)) for s in soc]
    return BatteryTrace([each_s * k for k in range(len(soc))], list(soc), energy, [], [], [], [])


def test_a_member_on_the_mains_is_full_whatever_is_said_of_its_pack() -> None:
    """A low charge, an override, a trace, faults: nothing is drawn of it, and it never lands."""
    packs = FleetBatteries(
        Battery(initial_soc=0.05), (DroneOverride(drone=1, initial_soc=0.3),), 3, {2: falling(0.9, 0.2)}, mains=(1, 2)
    )
    assert packs.landed == [True, False, False]
    assert packs.soc == [0.05, 1.0, 1.0]
    packs.fault(1, 0.9)
    packs.fault(2, 1.0)
    packs.step(10.0, [170.0] * 3, [1.0] * 3, [0.0] * 3)
    packs.take_off(2)
    assert packs.soc[1:] == [1.0, 1.0]
    assert packs.spent_j == [0.0] * 3
    assert packs.landed == [True, False, False]
    assert RECORDED not in packs.energy_j


def test_cells_of_one_kind_and_other_parameters_are_other_cells(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text("def straight(soc, *, empty_v=3.0):\n    return empty_v + (4.2 - empty_v) * soc\n")
    name = f"{tmp_path / 'own.py'}:straight"
    of = [Battery(cell_model=name, cell_params={"empty_v": v}, initial_soc=0.5) for v in (3.0, 3.6, 3.0)]
    packs = FleetBatteries([*of, Battery(initial_soc=0.5)], (), 4)
    wanted = [4 * 3.6, 4 * 3.9, 4 * 3.6, 4 * float(open_circuit_cell_v(0.5))]
    assert packs.voltage_v == pytest.approx(wanted, rel=1e-4)
    traced = FleetBatteries(of, (), 3, {1: falling(0.5, 0.4)})
    left_j = of[1].capacity_wh * 3600 * float(energy_fraction(0.5))  # a trace's charge is that of the built-in cell
    assert traced.energy_left_j[1] == pytest.approx(left_j)


def test_a_cell_s_mean_voltage_is_over_the_cells_that_work() -> None:
    """A pack of four that lost one is cut off where a cell is low, not where three cells give less than four would."""
    of = Battery(cutoff_cell_v=3.3, initial_soc=0.8, capacity_wh=300)
    packs = FleetBatteries(of, (), 1)
    packs.drop_cell(0)
    packs.step(0.1, *LOAD)
    assert packs.cells == [3]
    assert packs.voltage_v[0] < 3.3 * 4
    assert not packs.landed[0]
    low = FleetBatteries(of.model_copy(update={"cutoff_cell_v": 3.9}), (), 1)
    low.step(0.1, *LOAD)
    assert low.landed[0]
    assert low.landing_reason[0].endswith("cut off below 3.9 V")


@pytest.mark.parametrize("cycles", [0.0, 300.0])
@pytest.mark.parametrize("polarised", [0.0, 6.0])
def test_all_that_is_lost_in_a_pack_warms_its_mass(cycles: float, polarised: float) -> None:
    """Old packs hold less and weigh as much; what polarisation takes is lost in the pack as well."""
    pack = Battery(ambient_c=10.0, cycles=cycles, polarisation=Polarisation(resistance_mohm=polarised, time_s=0.5))
    packs = FleetBatteries(pack, (), 1)
    for _ in range(30):
        before_c, before_j = packs.temperature_c[0], packs.energy_j["ohmic"][0]
        packs.step(1.0, *LOAD)
    lost_w = packs.energy_j["ohmic"][0] - before_j
    warmed_c = lost_w * COOLING_TIME_S / heat_capacity_jpk(pack.capacity_wh)
    fades = math.exp(-1.0 / COOLING_TIME_S)
    assert packs.temperature_c[0] == pytest.approx(10.0 + warmed_c + (before_c - 10.0 - warmed_c) * fades, rel=1e-12)
    assert packs.temperature_c[0] > 10.05


def test_a_pack_gives_no_more_than_it_has() -> None:
    """Its last step is as long as its energy lasts, and the rotors' share is of that."""
    packs = FleetBatteries(Battery(capacity_wh=2.0, landing_soc=0.0, cell_resistance_mohm=3), (), 1)
    begin_j = packs.energy_left_j[0]
    for _ in range(60):
        before = {cause: of[0] for cause, of in packs.energy_j.items()}
        packs.step(1.0, *LOAD)
        if packs.landed[0]:
            break
    assert packs.landed[0]
    assert packs.spent_j[0] == pytest.approx(begin_j)
    assert packs.energy_left_j[0] == 0.0
    lasts_s = (packs.energy_j["avionics"][0] - before["avionics"]) / 8.0
    assert 0.0 < lasts_s < 1.0
    assert packs.energy_j["rotor"][0] - before["rotor"] == pytest.approx(170.0 / 0.8 * lasts_s)


def test_what_a_trace_says_was_spent_on_the_ground_is_spent_at_take_off() -> None:
    packs = FleetBatteries(Battery(capacity_wh=100), (), 1, {0: falling(0.9, 0.8, 0.7, 0.6)})
    packs.step(10.0, *LOAD)
    packs.land(0, "told to")
    packs.step(10.0, *LOAD)
    assert packs.soc[0] == pytest.approx(0.8, abs=1e-3)
    packs.take_off(0)
    assert packs.soc[0] == pytest.approx(0.7, abs=1e-3)
    assert packs.spent_j[0] == pytest.approx(360_000 * float(energy_fraction(0.9) - energy_fraction(0.7)))
    before_j = packs.energy_j[RECORDED][0]
    packs.step(10.0, *LOAD)
    spent_j = packs.energy_j[RECORDED][0] - before_j
    assert packs.current_a[0] == pytest.approx(spent_j / 10.0 / packs.voltage_v[0])
    assert packs.voltage_v[0] == pytest.approx(4 * float(open_circuit_cell_v(0.6)), abs=1e-2)


def test_a_trace_of_no_voltage_has_no_current() -> None:
    trace = BatteryTrace(
        [0.0, 10.0], [0.9, 0.8], energy_fraction([0.9, 0.8]).tolist(), [0.0, 10.0], [16.0, 0.0], [], []
    )
    packs = FleetBatteries(Battery(), (), 1, {0: trace})
    packs.step(5.0, *LOAD)
    assert packs.current_a[0] > 0.0
    packs.step(5.0, *LOAD)
    assert (packs.voltage_v[0], packs.current_a[0]) == (0.0, 0.0)
    assert packs.soc[0] == pytest.approx(0.8, abs=1e-3)


def test_every_drone_has_the_efficiency_of_its_own_drive() -> None:
    packs = FleetBatteries([Battery(drivetrain_efficiency=e) for e in (0.5, 0.8)], (), 2)
    packs.step(1.0, [100.0] * 2, [0.0] * 2, [0.0] * 2)
    assert packs.energy_j["rotor"] == pytest.approx([200.0, 125.0])
