"""Traces in whole sorties: a run flies again from its own states, and a trace leaves other drones alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from recorded import recorded
from sim_examples import example

from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

STATES = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "vx_mps", "vy_mps", "vz_mps", "soc")


def column(record: SortieRecord, name: str, drone: int | None = None) -> np.ndarray:
    """A column of the states, of one drone or of all."""
    states = record.tables["states"]
    return (states if drone is None else states.filter(pc.equal(states["drone"], drone)))[name].to_numpy()


def test_a_run_flies_again_from_its_own_states(tmp_path: Path) -> None:
    """A flight of its own, from the recorded one. Another seed, other jitter, another battery: the trace decides."""
    first, path = recorded("base"), tmp_path / "states.parquet"
    pq.write_table(first.tables["states"], path)
    again = run_sortie(example(f"fleet.trace={path}", "seed=99", "fleet.battery.initial_soc=0.3"), "silence")
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
    plain, traced = recorded("base"), run_sortie(example(f"fleet.trace={path}"))
    for drone in (0, 1, 3, 4):
        for name in STATES[:-1]:
            np.testing.assert_array_equal(column(traced, name, drone), column(plain, name, drone))
        np.testing.assert_allclose(column(traced, "soc", drone), column(plain, "soc", drone), atol=1e-4)
    np.testing.assert_allclose(column(traced, "x_m", 2), 2 * column(traced, "t_s", 2), atol=1e-9)
