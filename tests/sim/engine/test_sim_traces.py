"""Traces and energy in whole sorties: a run flies again from its own states; events and effects reach the record."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from sim_examples import example

from sortie.fleet.energy.cell import energy_fraction
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

STATES = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "vx_mps", "vy_mps", "vz_mps", "soc")


def column(record: SortieRecord, name: str, drone: int | None = None) -> np.ndarray:
    """A column of the states, of one drone or of all."""
    states = record.tables["states"]
    return (states if drone is None else states.filter(pc.equal(states["drone"], drone)))[name].to_numpy()


def test_a_run_flies_again_from_its_own_states(tmp_path: Path) -> None:
    """Another seed, other jitter, another battery: the trace decides all the same."""
    first = run_sortie(example("fleet.overrides=[{drone: 1, initial_soc: 0.5}]"))
    path = tmp_path / "states.parquet"
    pq.write_table(first.tables["states"], path)
    again = run_sortie(example(f"fleet.trace={path}", "seed=99", "fleet.battery.initial_soc=0.3"))
    for name in STATES:
        np.testing.assert_allclose(column(again, name), column(first, name), atol=2e-6, err_msg=name)
    energy = outcome(again)["energy_j"]
    assert energy["recorded"] == pytest.approx(energy["total"], rel=1e-9)
    # the states end with the last frame's begin, where the trace holds: 59 of 60 frames were drained
    assert energy["total"] == pytest.approx(outcome(first)["energy_j"]["total"] * 59 / 60, rel=1e-3)


def test_a_trace_of_some_drones_leaves_the_others_as_they_were(tmp_path: Path) -> None:
    """Their motion and their packs, to the last bit; only radio and policy may answer to the drone that moved."""
    path = tmp_path / "trace.csv"
    path.write_text("t_s,drone,x_m,y_m,z_m,soc\n0,2,0,40,60,0.9\n6,2,12,40,60,0.8\n")
    plain, traced = run_sortie(example()), run_sortie(example(f"fleet.trace={path}"))
    for drone in (0, 1, 3, 4):
        for name in STATES[:-1]:
            np.testing.assert_array_equal(column(traced, name, drone), column(plain, name, drone))
        np.testing.assert_allclose(column(traced, "soc", drone), column(plain, "soc", drone), atol=1e-4)
    np.testing.assert_allclose(column(traced, "x_m", 2), 2 * column(traced, "t_s", 2), atol=1e-9)


def test_a_cell_drops_out_at_its_time() -> None:
    record = run_sortie(example("events=[{kind: cell_failure, at_s: 2, drone: 1}]"))
    t_s, volts = column(record, "t_s", 1), column(record, "voltage_v", 1)
    before, after = volts[(t_s > 1) & (t_s < 1.95)].mean(), volts[t_s > 2.15].mean()
    assert after == pytest.approx(before * 3 / 4, rel=0.02)
    notes = record.tables["events"].to_pylist()
    assert {"t_s": 2.0, "drone": 1, "kind": "cell_failure", "text": "3 cells are left"} in notes
    assert (np.diff(column(record, "soc", 1)) <= 1e-6).all()


def test_cells_drop_out_until_the_drone_lands() -> None:
    failures = ", ".join(f"{{kind: cell_failure, at_s: {at}, drone: 1}}" for at in (1, 1.5, 2, 2.5))
    record = run_sortie(example(f"events=[{failures}]"))
    kinds = [(e["kind"], e["drone"]) for e in record.tables["events"].to_pylist()]
    assert ("landed", 1) in kinds
    assert column(record, "soc", 1)[-1] == 0.0
    energy = record.tables["energy"]
    faults = energy.filter(pc.and_(pc.equal(energy["drone"], 1), pc.equal(energy["cause"], "fault")))
    assert isinstance(energy, pa.Table)
    assert faults["energy_j"][0].as_py() > 0.9 * 0.95 * 130 * 3600


def test_states_say_what_the_ledger_of_a_sortie_to_there_says() -> None:
    """With ohmic loss, polarisation and a fault; a drone that landed spends no more."""
    sets = (
        "fleet.battery.cell_resistance_mohm=40", "fleet.battery.polarisation.resistance_mohm=20",
        "mission.phases=[{at_s: 0, phase: search}]",
        "events=[{kind: battery_fault, drone: 1, at_s: 0.5, lost_fraction: 0.01}, {kind: drone_lost, drone: 2, at_s: 0.7}]",
    )  # fmt: skip
    states = run_sortie(example(*sets)).tables["states"].to_pylist()
    for until_s in (0.8, 1.1, 4.0):
        at = [row["spent_j"] for row in states if row["t_s"] == pytest.approx(until_s)]
        shorter = outcome(run_sortie(example(*sets, f"duration_s={until_s}")))
        assert at == pytest.approx([d["energy_j"] for d in shorter["drones"].values()], rel=1e-12)
        assert sum(at) == pytest.approx(shorter["energy_j"]["total"], rel=1e-12)
        assert shorter["energy_j"]["ohmic"] > 0


def test_everything_at_once_keeps_the_ledger() -> None:
    """Cold, old, polarising packs with payload under momentum theory, and a lost cell: the record's causes are what
    left the packs."""
    scenario = example(
        "fleet.airframe={power_model: momentum, payload_kg: 0.4, air_density_kgpm3: 1.1}",
        "fleet.battery={ambient_c: -5, cycles: 150, polarisation: {resistance_mohm: 5}, cutoff_cell_v: 2.0}",
        "events=[{kind: cell_failure, at_s: 2, drone: 1}, {kind: battery_fault, at_s: 3, drone: 2, lost_fraction: 0.3}]",
    )
    record = run_sortie(scenario)
    assert {"cell_failure", "battery_fault"} <= set(record.tables["events"]["kind"].to_pylist())  # they flew till then
    full_j = 130 * 3600 * 0.9  # 150 of 300 cycles take a tenth
    spent = outcome(record)["energy_j"]["total"]
    left = 0.0
    for drone in range(5):
        cells = 3 / 4 if drone == 1 else 1.0
        left += full_j * cells * float(energy_fraction(column(record, "soc", drone)[-1]))
    # the last frame's drain comes after its state was written
    assert spent + left == pytest.approx(5 * full_j * float(energy_fraction(0.95)), rel=1e-4)
