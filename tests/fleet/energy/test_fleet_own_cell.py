"""A cell of one's own: closed forms of a straight one, and the built-in one given as a function."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sortie.fleet.energy.battery import FleetBatteries
from sortie.fleet.energy.cell import LIPO, cell_curve, open_circuit_cell_v
from sortie.scenarios.schema import Battery

STRAIGHT = """
def straight(soc, *, empty_v=3.0, full_v=4.2):
    return empty_v + (full_v - empty_v) * soc
"""
SAME = """
from sortie.fleet.energy.cell import open_circuit_cell_v


def same(soc):
    return open_circuit_cell_v(soc)
"""


@pytest.fixture
def straight(tmp_path: Path) -> Battery:
    (tmp_path / "own.py").write_text(STRAIGHT)
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


def test_the_built_in_cell_as_a_function_of_one_s_own(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(SAME)
    curve = cell_curve(Battery(cell_model=f"{tmp_path / 'own.py'}:same"))
    np.testing.assert_allclose(curve.soc, LIPO.soc, atol=1e-6)
    np.testing.assert_allclose(curve.volts, LIPO.volts, atol=1e-6)
    soc = np.linspace(0, 1, 21)
    np.testing.assert_allclose(curve.open_circuit_v(soc), open_circuit_cell_v(soc), atol=1e-6)
    assert cell_curve(Battery()) is LIPO
