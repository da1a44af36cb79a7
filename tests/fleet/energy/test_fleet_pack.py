"""What polarisation, temperature, age, cut-off, lost cells and traces do to a pack; the ledger with all of them on."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sortie.fleet.energy.battery import CAUSES, RECORDED, FleetBatteries
from sortie.fleet.energy.cell import (
    COOLING_TIME_S,
    energy_fraction,
    heat_capacity_jpk,
    open_circuit_cell_v,
    resistance_factor,
    terminal_voltage_v,
)
from sortie.fleet.energy.recorded import BatteryTrace
from sortie.scenarios.schema import Battery, Polarisation

LOAD = ([170.0], [1.0], [0.1])


HOVER_W = 168.48


def steady(batteries: FleetBatteries, seconds: float, rotor_w: float = HOVER_W, dt_s: float = 0.1) -> None:
    n = len(batteries.soc)
    for _ in range(round(seconds / dt_s)):
        batteries.step(dt_s, [rotor_w] * n, [0.5] * n, [0.1] * n)


# --- one effect at a time ---------------------------------------------------------------------------------


def test_polarisation_builds_up_with_its_time_constant() -> None:
    plain = FleetBatteries(Battery(), (), 1)
    slow = FleetBatteries(Battery(polarisation=Polarisation(resistance_mohm=5, time_s=10)), (), 1)
    for b in (plain, slow):
        steady(b, 10.0, dt_s=0.01)
    lag_v = 4 * float(open_circuit_cell_v(slow.soc[0])) - slow.voltage_v[0] - slow.current_a[0] * 0.052
    assert lag_v == pytest.approx(slow.current_a[0] * 0.020 * (1 - math.exp(-1)), rel=0.01)
    assert slow.voltage_v[0] < plain.voltage_v[0]
    assert slow.energy_j["ohmic"][0] > plain.energy_j["ohmic"][0]


def test_cold_raises_resistance_and_the_pack_warms_itself() -> None:
    """Arrhenius by hand; the temperature against dT/dt = (P − (T − Ta)·C/τ)/C in small steps."""
    assert resistance_factor(25.0) == 1.0
    assert resistance_factor(0.0) == pytest.approx(math.exp(20_000 / 8.314462618 * (1 / 273.15 - 1 / 298.15)))
    b = FleetBatteries(Battery(ambient_c=-10), (), 1)
    at_rest = b.voltage_v[0]
    steady(b, 0.1)
    sag_ohm = (at_rest - b.voltage_v[0]) / b.current_a[0]
    assert sag_ohm == pytest.approx(0.052 * resistance_factor(-10.0), rel=1e-3)
    temperature_c, heat = -10.0, heat_capacity_jpk(130.0)
    for _ in range(6000):
        lost_w = b.current_a[0] ** 2 * 0.052 * resistance_factor(b.temperature_c[0])
        temperature_c += 0.1 * (lost_w - (temperature_c + 10) * heat / 900.0) / heat
        steady(b, 0.1)
    assert b.temperature_c[0] == pytest.approx(temperature_c, abs=0.1)
    assert b.temperature_c[0] > 0


def test_a_pack_on_the_ground_cools_to_the_air_while_one_in_flight_stays_warm() -> None:
    b = FleetBatteries((Battery(ambient_c=-10), Battery(), Battery(ambient_c=-10)), (), 3)
    steady(b, 300.0, dt_s=1.0)
    warm_c, spent = b.temperature_c[0], b.spent_j[0]
    b.land(0, "told to")
    b.land(1, "told to")
    b.step(900.0, [HOVER_W] * 3, [0.5] * 3, [0.1] * 3)
    assert b.temperature_c[0] == pytest.approx(-10 + (warm_c + 10) / math.e)
    assert b.temperature_c[1] == 25.0
    assert b.temperature_c[2] > warm_c
    assert b.spent_j[0] == spent


def test_cold_and_age_act_on_both_parts_of_the_resistance() -> None:
    """Voltage of a loaded pack once polarisation has settled: both resistances times the factors of cold and of age."""
    for cold, cycles, polarised in product([None, -10.0], [0.0, 150.0], [0.0, 4.0]):
        slow = Polarisation(resistance_mohm=polarised, time_s=0.05)
        pack = Battery(cell_resistance_mohm=6, ambient_c=cold, cycles=cycles, capacity_wh=5000, polarisation=slow)
        packs = FleetBatteries(pack, (), 1)
        for _ in range(12):
            packs.step(0.1, [170.0], [0.0], [0.0])
        factor = resistance_factor(packs.temperature_c[0] if cold is not None else 25.0)
        open_v = 4 * float(open_circuit_cell_v(packs.soc[0]))
        drop_v = packs.current_a[0] * 4 * (6 + polarised) / 1000 * (1 + cycles / 300) * factor
        assert packs.voltage_v[0] == pytest.approx(open_v - drop_v, abs=2e-3), (cold, cycles, polarised)
        assert drop_v > 0.3


def test_all_that_is_lost_in_a_pack_warms_its_mass() -> None:
    """Old packs hold less and weigh as much; what polarisation takes is lost in the pack as well."""
    for cycles, polarised in product((0.0, 300.0), (0.0, 6.0)):
        slow = Polarisation(resistance_mohm=polarised, time_s=0.5)
        pack = Battery(ambient_c=10.0, cycles=cycles, polarisation=slow)
        packs = FleetBatteries(pack, (), 1)
        for _ in range(30):
            before_c, before_j = packs.temperature_c[0], packs.energy_j["ohmic"][0]
            packs.step(1.0, *LOAD)
        lost_w = packs.energy_j["ohmic"][0] - before_j
        warmed_c = lost_w * COOLING_TIME_S / heat_capacity_jpk(pack.capacity_wh)
        fades = math.exp(-1.0 / COOLING_TIME_S)
        wanted_c = 10.0 + warmed_c + (before_c - 10.0 - warmed_c) * fades
        assert packs.temperature_c[0] == pytest.approx(wanted_c, rel=1e-12)
        assert packs.temperature_c[0] > 10.05


def test_a_pack_that_takes_off_again_is_one_of_its_charge_that_never_flew() -> None:
    """What was polarised is gone at rest; voltage, current and what is spent go on from the charge alone."""
    of = Battery(capacity_wh=120, polarisation=Polarisation(resistance_mohm=8, time_s=30))
    flew = FleetBatteries(of, (), 1)
    for _ in range(60):
        flew.step(1.0, [170.0], [1.0], [0.1])
    flew.land(0, "told to")
    flew.take_off(0)
    fresh = FleetBatteries(of.model_copy(update={"initial_soc": flew.soc[0]}), (), 1)
    for _ in range(5):
        for packs in (flew, fresh):
            packs.step(1.0, [170.0], [1.0], [0.1])
        assert flew.voltage_v[0] == pytest.approx(fresh.voltage_v[0], rel=1e-6)
        assert flew.current_a[0] == pytest.approx(fresh.current_a[0], rel=1e-6)


# --- a cell drops out -------------------------------------------------------------------------------------


def test_a_lost_cell_takes_its_voltage_energy_and_both_resistances() -> None:
    """A pack of four that loses one is a pack of three in the same state."""
    of = Battery(cell_resistance_mohm=15, capacity_wh=120, polarisation=Polarisation(resistance_mohm=5, time_s=1))
    four = FleetBatteries(of, (), 2)
    before_j = four.energy_left_j[0]
    four.drop_cell(0)
    assert four.cells == [3, 4]
    assert four.energy_j["fault"] == [pytest.approx(before_j / 4), 0.0]
    three = FleetBatteries(of.model_copy(update={"cells": 3, "capacity_wh": 90.0}), (), 2)
    for _ in range(50):
        for packs in (four, three):
            packs.step(0.1, [120.0] * 2, [0.5] * 2, [0.1] * 2)
        assert four.voltage_v[0] == pytest.approx(three.voltage_v[0], rel=1e-9)
        assert four.current_a[0] == pytest.approx(three.current_a[0], rel=1e-9)
        assert four.soc[0] == pytest.approx(three.soc[0], rel=1e-9)
    assert four.energy_left_j[0] == pytest.approx(three.energy_left_j[0])
    assert four.landed == [False, False]


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


def test_losing_a_cell_under_a_cut_off_by_the_cell_goes_on_and_the_last_cell_lands() -> None:
    b = FleetBatteries(Battery(cells=2, cutoff_cell_v=3.0), (), 1)
    b.drop_cell(0)
    steady(b, 1.0)
    assert not b.landed[0]
    b.drop_cell(0)
    assert b.landed[0]
    assert b.energy_left_j[0] == 0.0


def test_the_voltage_after_a_fault_is_that_of_the_cold_and_polarised_pack() -> None:
    """Between that of the step before and that of the next; a lost cell takes its own share of it."""
    cold = Battery(ambient_c=-5, polarisation=Polarisation(resistance_mohm=5, time_s=20))
    b = FleetBatteries(cold, (), 2)
    steady(b, 60.0)
    before_v, whole_v = b.voltage_v
    b.fault(0, 0.001)
    b.drop_cell(1)
    after_v, three_cells_v = b.voltage_v
    assert three_cells_v == pytest.approx(3 / 4 * whole_v, abs=0.001)
    steady(b, 0.1)
    assert b.voltage_v[0] < after_v < before_v


# --- a trace in place of the model ------------------------------------------------------------------------


def trace(time_s: list[float], soc: list[float], volts: list[float] | None = None) -> BatteryTrace:
    volts = volts or []
    return BatteryTrace(time_s, soc, energy_fraction(soc).tolist(), time_s[: len(volts)], volts, [], [])


def test_a_traced_drone_follows_its_trace_and_the_others_their_model() -> None:
    plain = FleetBatteries(Battery(), (), 3)
    b = FleetBatteries(Battery(), (), 3, {1: trace([0, 10], [0.9, 0.4], [16.0, 15.0])})
    for each in (plain, b):
        steady(each, 5.0)
    assert b.voltage_v[1] == pytest.approx(15.5, abs=1e-6)
    assert float(energy_fraction(b.soc[1])) == pytest.approx(
        float(energy_fraction(0.9) + energy_fraction(0.4)) / 2, abs=1e-6
    )
    for i in (0, 2):
        assert [b.energy_j[c][i] for c in CAUSES] == [plain.energy_j[c][i] for c in CAUSES]
    assert [b.energy_j[c][1] for c in CAUSES] == [0.0] * len(CAUSES)
    steady(b, 20.0)
    assert b.soc[1] == pytest.approx(0.4, abs=1e-6)  # held after the end
    assert RECORDED not in plain.energy_j


def test_a_traced_drone_lands_at_landing_soc_too() -> None:
    b = FleetBatteries(Battery(landing_soc=0.5), (), 1, {0: trace([0, 10], [0.9, 0.4])})
    steady(b, 10.0)
    assert b.landed == [True]
    assert 0.48 < b.soc[0] <= 0.5


def test_faults_of_a_traced_pack_stay_and_each_takes_of_what_is_left() -> None:
    """Half is gone at once, later a fifth; from then on the trace's fall is of the two fifths that are left."""
    soc = [0.9, 0.8, 0.7]
    energy = [float(energy_fraction(s)) for s in soc]
    packs = FleetBatteries(Battery(capacity_wh=100), (), 1, {0: trace([0.0, 10.0, 20.0], soc)})
    packs.step(5.0, [0.0], [0.0], [0.0])
    half = packs.energy_left_j[0] / 2
    packs.fault(0, 0.5)
    assert packs.energy_left_j[0] == pytest.approx(half)
    packs.step(5.0, [0.0], [0.0], [0.0])
    left = 360_000 * energy[1] / 2
    assert packs.energy_left_j[0] == pytest.approx(left)
    packs.fault(0, 0.2)
    assert packs.energy_left_j[0] == pytest.approx(0.8 * left)
    packs.step(10.0, [0.0], [0.0], [0.0])
    assert packs.energy_left_j[0] == pytest.approx(360_000 * energy[2] * 0.4)
    lost = half + 0.2 * left
    assert packs.energy_j["fault"][0] == pytest.approx(lost)
    assert packs.spent_j[0] == pytest.approx(360_000 * (energy[0] - 0.4 * energy[2]))
    assert packs.energy_j[RECORDED][0] == pytest.approx(packs.spent_j[0] - lost)


def test_what_a_trace_says_was_spent_on_the_ground_is_spent_at_take_off() -> None:
    packs = FleetBatteries(Battery(capacity_wh=100), (), 1, {0: trace([0, 10, 20, 30], [0.9, 0.8, 0.7, 0.6])})
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
    packs = FleetBatteries(Battery(), (), 1, {0: trace([0.0, 10.0], [0.9, 0.8], [16.0, 0.0])})
    packs.step(5.0, *LOAD)
    assert packs.current_a[0] > 0.0
    packs.step(5.0, *LOAD)
    assert (packs.voltage_v[0], packs.current_a[0]) == (0.0, 0.0)
    assert packs.soc[0] == pytest.approx(0.8, abs=1e-3)


# --- the ledger, everything on ----------------------------------------------------------------------------

packs = st.builds(
    Battery,
    capacity_wh=st.floats(0.05, 200),
    cells=st.integers(1, 12),
    initial_soc=st.floats(0.01, 1),
    cell_resistance_mohm=st.floats(0, 100),
    drivetrain_efficiency=st.floats(0.3, 1),
    polarisation=st.builds(Polarisation, resistance_mohm=st.floats(0, 40), time_s=st.floats(0.1, 100)),
    ambient_c=st.none() | st.floats(-30, 50),
    cycles=st.floats(0, 500),
    cutoff_cell_v=st.floats(0, 3.6),
    landing_soc=st.floats(0, 0.5),
)
happenings = st.none() | st.just("cell") | st.floats(0, 0.9)
flights = st.lists(
    st.tuples(st.floats(0.01, 2), st.floats(0, 600), st.floats(0, 1), st.floats(0, 1), happenings), max_size=40
)
charges = st.lists(st.floats(0.001, 1), min_size=2, max_size=5).map(lambda soc: sorted(soc, reverse=True))


@settings(max_examples=300)
@given(packs, flights, charges)
def test_the_ledger_holds_with_every_effect_on(
    config: Battery, flight: list[tuple[float, float, float, float, str | float | None]], soc: list[float]
) -> None:
    traced = trace([10.0 * k for k in range(len(soc))], soc)
    b = FleetBatteries(config, (), 3, {2: traced})
    before_j, charge = list(b.energy_left_j), list(b.soc)
    for dt_s, rotor_w, duty, airtime, happens in flight:
        for i in (0, 2):
            if happens == "cell":
                b.drop_cell(i)
            elif isinstance(happens, float):
                b.fault(i, happens)
            assert b.voltage_v[i] >= 0
        b.step(dt_s, [rotor_w, 0.0, rotor_w], [duty, 0.0, duty], [airtime, 0.0, airtime])
        for i in range(3):
            assert 0 <= b.soc[i] <= charge[i] + 2e-6  # never rises; the look-up is good to 1e-6
            assert b.energy_left_j[i] >= 0
            assert b.voltage_v[i] > 0
            assert b.current_a[i] >= 0
            assert b.landed[i] or b.soc[i] > config.landing_soc
            assert math.isfinite(b.temperature_c[i])
            left = before_j[i] - sum(b.energy_j[cause][i] for cause in b.energy_j)
            assert b.energy_left_j[i] == pytest.approx(left, rel=1e-9, abs=1e-9 * before_j[i])
        charge = list(b.soc)


# --- the same cell, driven by current ---------------------------------------------------------------------


def test_a_packs_voltage_under_its_own_current_is_the_fleets() -> None:
    """The current that the fleet's model drew, put through the one that counts charge, gives its voltage back."""
    config = Battery(capacity_wh=60, polarisation=Polarisation(resistance_mohm=6, time_s=15), cycles=100)
    b = FleetBatteries(config, (), 1)
    rng = np.random.default_rng(1)
    current, volts = [], []
    for load_w in rng.uniform(50, 250, 120).repeat(20):
        b.step(0.05, [load_w], [0.0], [0.0])
        current.append(b.current_a[0])
        volts.append(b.voltage_v[0])
    time_s = 0.05 * np.arange(len(volts))
    np.testing.assert_allclose(terminal_voltage_v(time_s, np.array(current), config, 0.95), volts, rtol=2e-4)
