"""A drone's own value and the fleet's: an override replaces its make's, and a make's replaces the fleet's."""

from __future__ import annotations

import pytest

from sortie.fleet.energy.battery import FleetBatteries
from sortie.fleet.energy.cell import energy_fraction
from sortie.fleet.flight.motion import fly
from sortie.fleet.plane import codebooks, equipment_of
from sortie.scenarios.reading.load import loads
from sortie.scenarios.schema import (
    Scenario,
)


def scenario(text: str) -> Scenario:
    return loads(f"name: joints\nduration_s: 4\n{text}")


def test_an_override_stands_in_place_of_the_value_of_its_make_and_of_the_fleet() -> None:
    """Of every field; drones that it does not name keep theirs, and so do other fields."""
    fleet = scenario(
        """
fleet:
  airframe: {payload_kg: 0.3}
  battery: {initial_soc: 0.9, capacity_wh: 100, cell_resistance_mohm: 20, cycles: 50}
  makes:
    - {name: heavy, drones: [1, 2], airframe: {payload_kg: 0.7, mass_kg: 3},
       battery: {initial_soc: 0.8, capacity_wh: 200}}
  overrides:
    - {drone: 0, payload_kg: 0.1, initial_soc: 0.5}
    - {drone: 1, payload_kg: 0.0, capacity_wh: 60, cell_resistance_mohm: 5}
    - {drone: 3, cycles: 100}
"""
    ).fleet
    assert [a.payload_kg for a in fleet.airframes] == [0.1, 0.0, 0.7, 0.3, 0.3]
    assert [a.mass_kg for a in fleet.airframes] == [2.04, 3, 3, 2.04, 2.04]
    packs = FleetBatteries(fleet.batteries, fleet.overrides, 5)
    assert packs.soc == [0.5, 0.8, 0.8, 0.9, 0.9]
    aged = [1 - 0.2 * cycles / 300 for cycles in (50, 0, 0, 100, 50)]
    full_wh = [100 * aged[0], 60, 200, 100 * aged[3], 100 * aged[4]]
    for drone, (wh, soc) in enumerate(zip(full_wh, packs.soc, strict=True)):
        assert packs.energy_left_j[drone] == pytest.approx(wh * 3600 * float(energy_fraction(soc)))


def test_zero_is_a_value_of_a_make_and_not_a_missing_one() -> None:
    quick = '{name: quick, drones: [1], compute_delay_s: 0, tx_power_dbm: 0, feature_space: "", policy_params: {}}'
    made = scenario(f"fleet: {{makes: [{quick}]}}\nperception: {{detector: none, compute_delay_s: 0.04}}")
    assert made.compute_delays_s == (0.04, 0.0, 0.04, 0.04, 0.04)
    assert [e.compute_delay_s for e in equipment_of(made).values()] == [0.04, 0.0, 0.04, 0.04, 0.04]


def test_a_make_may_fly_lower_than_the_fleet() -> None:
    fleet = scenario(
        "fleet: {drones: 3, formation: {altitude_m: 50}, makes: [{name: low, drones: [1], altitude_offset_m: -20}, "
        "{name: high, drones: [2], altitude_offset_m: 15}]}"
    ).fleet
    assert fleet.altitudes_m == (50.0, 30.0, 65.0)
    assert fly(fleet, 1.0, 0.1, 1).position_m[0, :, 2] == pytest.approx([50.0, 30.0, 65.0], abs=2.5)


def test_a_codebook_that_a_make_shares_with_the_fleet_is_the_fleet_s() -> None:
    """It has no name of its own, wherever it lies; the file need not be there to see that."""
    shared = loads(
        "name: shared\nperception: {codebook: none/c.safetensors}\n"
        "fleet: {makes: [{name: own, drones: [1], codebook: none/c.safetensors}]}"
    )
    assert codebooks(shared) == ("",) * 5
