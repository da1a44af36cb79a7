"""Coverage in flight: scene, duty and what peers published stand in the descriptors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from sim_examples import example

from sortie.fleet.coverage import LOOK_STANDS_S, NOVEL_FLAG, unpack_grid
from sortie.policies.contract import Coverage, Directive, FleetView
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.record import SortieRecord

FLOWN = ("duration_s=6", "perception.detector=none")
SCENE = "perception.scene"


def grids(record: SortieRecord) -> np.ndarray:
    """[T, N, 16, 16]"""
    states = [unpack_grid(g) for g in record.tables["descriptors"]["coverage_grid"].to_pylist()]
    return np.array(states).reshape(-1, 5, 16, 16)


def resting(view: FleetView) -> Sequence[Directive]:
    """No drone looks, from the first peer heard on."""
    return [Directive(view.ego, peer, duty_percent=0) for peer in view.peers]


def test_buildings_hide_ground_in_flight() -> None:
    bare, dense = (
        grids(run_sortie(example(*FLOWN, f"{SCENE}.building_density={d}", f"{SCENE}.tree_density={d}"))) for d in (0, 1)
    )
    assert (bare[1:] > 0).mean() > 1.3 * (dense[1:] > 0).mean()


def test_a_drone_that_does_not_look_covers_nothing() -> None:
    record = run_sortie(example(*FLOWN), resting)
    looked = np.array(record.tables["states"]["looks"]).reshape(-1, 5)
    assert looked.max() <= 2, "before it heard of a peer"
    late = grids(record)[int(10 * LOOK_STANDS_S) + 4 :]
    assert len(late) > 30
    assert not late.any()


def test_a_cell_is_new_to_the_fleet_once() -> None:
    """Few descriptors have a new cell; the drones at the front have more than those behind them."""
    record = run_sortie(example("duration_s=20", "perception.detector=none"))
    flags = np.array(record.tables["descriptors"]["novelty_flags"]).reshape(-1, 5) & NOVEL_FLAG
    assert not flags[0].any(), "nothing was looked at yet"
    assert flags[1].all(), "all is new"
    assert 0.01 < flags[2:].mean() < 0.4
    assert ((grids(record) == Coverage.NOVEL).any(axis=(2, 3)) == flags.astype(bool)).all()
