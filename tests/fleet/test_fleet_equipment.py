"""What each drone of a fleet is equipped with, and what its computer has left for more."""

from __future__ import annotations

from dataclasses import astuple

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils.flop_counter import FlopCounterMode

from sortie.fleet.computer import Work, headrooms
from sortie.fleet.energy.battery import FleetBatteries
from sortie.fleet.energy.cell import energy_fraction
from sortie.fleet.flight.motion import fly
from sortie.fleet.plane import equipment_of
from sortie.perception.network.fusion.base import takes_part
from sortie.perception.network.fusion.registry import FUSIONS
from sortie.scenarios.reading.load import loads
from sortie.scenarios.schema import (
    Computer,
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
  makes: [{name: heavy, drones: [1, 2], airframe: {payload_kg: 0.7, mass_kg: 3}, battery: {initial_soc: 0.8, capacity_wh: 200}}]
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


# --- computers --------------------------------------------------------------------------------------------


ORIN, LOOK_S, FRAME_S = Computer(), 0.03, 0.1


def test_a_frame_by_hand() -> None:
    """A look of 30 ms and four maps at 0.32 ms on the accelerator; a core feeds it, decides, and copies 41.6 Mb."""
    cpu, gpu = headrooms(ORIN, LOOK_S, Work(7, 3, 5, 10), Work(8, 7, 6, 5_200_010), FRAME_S)
    assert gpu == pytest.approx(1 - (30 + 4 * 0.32) / 100)
    assert cpu == pytest.approx(1 - (30 + 4 * 0.32 + 0.1 + 41.6 / 19.5) / (12 * 100))


def test_headrooms_count_looks_maps_decisions_and_bytes() -> None:
    """By hand: each alone, and together."""
    computer = Computer(cpu_cores=4, decision_s=0.01, payload_mbps=100.0, driving_cores=2.0, fusion_s=0.02)
    cases = [
        (Work(15, 5, 5, 5), 1 - 2 * 10 * 0.03 / 8, 1 - 0.3 / 2),  # ten looks of 30 ms in 2 s, four cores
        (Work(5, 15, 5, 5), 1 - 2 * 10 * 0.02 / 8, 1 - 0.2 / 2),  # ten maps
        (Work(5, 5, 15, 5), 1 - 10 * 0.01 / 8, 1.0),
        (Work(5, 5, 5, 5_000_005), 1 - 40.0 / 100.0 / 8, 1.0),  # 40 Mb
        (Work(15, 15, 15, 5_000_005), 1 - (2 * 0.5 + 0.1 + 0.4) / 8, 1 - 0.5 / 2),
    ]
    for after, cpu, gpu in cases:
        assert headrooms(computer, 0.03, Work(5, 5, 5, 5), after, 2.0) == pytest.approx((cpu, gpu)), after


def test_the_papers_prototype_takes_nine_percent_of_a_core() -> None:
    """Four agents at 10 Hz that send and receive 105 MB/s, without perception: one second of one computer."""
    second = Work(decisions=4 * 10, payload_bytes=2 * 105_000_000)
    cpu, gpu = headrooms(Computer(cpu_cores=1), LOOK_S, Work(), second, 1.0)
    assert cpu == pytest.approx(1 - 0.09, abs=0.0005)
    assert gpu == 1.0


def test_the_time_of_a_fusion_is_its_operations_at_a_tenth_of_the_orins_peak() -> None:
    agents, arrived = torch.zeros(1, 5, 80, 64, 64), torch.ones(1, 4, 64, 64, dtype=torch.bool)
    part = takes_part(arrived, torch.ones_like(arrived), torch.ones(1, 4), "masked")
    with FlopCounterMode(display=False) as counted, torch.inference_mode():
        FUSIONS["disconet"]().eval()(agents, part, torch.ones(1, 5))
    assert counted.get_total_flops() / 4 / (0.1 * 5.3e12) == pytest.approx(ORIN.fusion_s, abs=5e-6)


counts = st.builds(Work, *[st.integers(0, 1000)] * 3, st.integers(0, 10**9))


@given(counts, counts)
def test_headrooms_are_shares_and_more_work_leaves_less(some: Work, more: Work) -> None:
    both = Work(*map(sum, zip(astuple(some), astuple(more), strict=True)))
    less, least = (headrooms(ORIN, LOOK_S, Work(), work, FRAME_S) for work in (some, both))
    assert all(0.0 <= b <= a <= 1.0 for a, b in zip(less, least, strict=True))
