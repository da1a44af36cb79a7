"""Coverage in flight: scene, duty and what peers published stand in the descriptors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from recorded import recorded
from sim_examples import example

from sortie.fleet.coverage import LOOK_STANDS_S, NOVEL_FLAG, unpack_grid
from sortie.policies.contract import Coverage, Directive, FleetView
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.record import SortieRecord


def grids(record: SortieRecord) -> np.ndarray:
    """[T, N, 16, 16]"""
    states = [unpack_grid(g) for g in record.tables["descriptors"]["coverage_grid"].to_pylist()]
    return np.array(states).reshape(-1, record.scenario.fleet.drones, 16, 16)


def test_buildings_hide_ground_in_flight() -> None:
    """Two short flights of their own, over a bare and over a dense town."""
    bare, dense = (
        grids(run_sortie(example("duration_s=1", "mission.phases=[{}]", "fleet.drones=3", scene), "silence"))
        for scene in (f"perception.scene={{building_density: {d}, tree_density: {d}}}" for d in (0, 1))
    )
    assert (bare[1:] > 0).mean() > 1.3 * (dense[1:] > 0).mean()


def test_a_drone_that_does_not_look_covers_nothing() -> None:
    """A flight of its own: no drone looks, from the first peer heard on."""

    def resting(view: FleetView) -> Sequence[Directive]:
        return [Directive(view.ego, peer, duty_percent=0) for peer in view.peers]

    record = run_sortie(example("fleet.drones=3"), resting)
    assert max(record.tables["states"]["looks"].to_pylist()) <= 2, "before it heard of a peer"
    late = grids(record)[int(10 * LOOK_STANDS_S) + 4 :]
    assert len(late) > 30
    assert not late.any()


def test_a_cell_is_new_to_the_fleet_once() -> None:
    record = recorded("base")
    flags = np.array(record.tables["descriptors"]["novelty_flags"]).reshape(-1, 5) & NOVEL_FLAG
    assert not flags[0].any(), "nothing was looked at yet"
    assert flags[1].all(), "all is new"
    assert 0.01 < flags[2:].mean() < 0.4, "few descriptors have a new cell"
    assert ((grids(record) == Coverage.NOVEL).any(axis=(2, 3)) == flags.astype(bool)).all()
