"""Viewpoints: who is granted a move and when, frame by frame, and that drones truly move when their policy asks."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import recorded
from sim_examples import example

from sortie.fleet.coverage import unpack_grid
from sortie.fleet.flight.motion import MotionError
from sortie.fleet.flight.viewpoints import Move, ViewpointWish
from sortie.policies.catalogue.baselines import everyone
from sortie.policies.catalogue.vantage import vantage
from sortie.policies.contract import (
    COVERAGE_CELL_M,
    Coverage,
    Directive,
    FleetView,
    PolicyError,
    Reposition,
    looks_from,
)
from sortie.sim.engine.manoeuvres import Manoeuvres, Viewpoints
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import build, run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

# --- who is granted what, frame by frame ---------------------------------------------------------


class Granting:
    """Stands for the rules of safety: answers by a script, and notes what it was asked."""

    def __init__(self, answer: Callable[[int, int], Move | str | None]) -> None:
        self.answer = answer
        self.asked: list[tuple[int, int]] = []
        self.gone: list[set[int]] = []

    def __call__(self, wish: ViewpointWish) -> Any:
        self.asked.append((wish.frame, wish.drone))
        self.gone.append(set(wish.gone))  # type: ignore[call-overload]
        return self.answer(wish.frame, wish.drone)


def _queue(monkeypatch: pytest.MonkeyPatch, grant: Granting, *sets: str) -> tuple[Viewpoints, Manoeuvres, Any]:
    scenario = example("duration_s=5", "fleet.drones=4", *sets)
    world = build(scenario, plan_for(scenario), 1).world
    monkeypatch.setattr("sortie.sim.engine.manoeuvres.grant", grant)
    monkeypatch.setattr(world, "reroute", lambda manoeuvres: None)
    viewpoints, queue = Viewpoints(scenario, world, posed_by_trace=False), Manoeuvres(scenario, world)
    queue.serve(viewpoints)
    return viewpoints, queue, world


def test_a_refused_request_is_decided_again_a_second_after_each_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    grant = Granting(lambda frame, drone: "too near")
    viewpoints, queue, world = _queue(monkeypatch, grant)
    viewpoints.request(2, Reposition(0.0, 0.0, "to see"))
    for frame in range(35):
        queue.renew(frame)
    assert grant.asked == [(0, 2), (10, 2), (20, 2), (30, 2)]
    assert [row[1:] for row in world._recorder.rows["events"]] == [(2, "viewpoint", "stays, too near: to see")]


def test_who_was_refused_is_decided_again_once_another_moved_out_of_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    met: list[int] = []

    def answer(frame: int, drone: int) -> Move | str:
        met.append(drone)
        return Move(0.0, 2.0, (0.0, 0.0), (3.0, 4.0)) if drone == 1 or 1 in met else "drone 1 is there"

    grant = Granting(answer)
    viewpoints, queue, world = _queue(monkeypatch, grant)
    for drone in (0, 1):
        viewpoints.request(drone, Reposition(0.0, 0.0, "to see"))
    queue.renew(0)
    assert grant.asked == [(0, 0), (0, 1), (0, 0)]
    assert [len(plan) for plan in viewpoints.plans] == [1, 1, 0, 0]
    texts = {row[1]: row[3] for row in world._recorder.rows["events"]}
    assert texts == dict.fromkeys((0, 1), "moves 5.0 m in 2.0 s, to +3.0 m ahead and +4.0 m left of its slot: to see")


def test_a_refusal_is_told_again_after_a_move(monkeypatch: pytest.MonkeyPatch) -> None:
    move = Move(0.0, 1.0, (0.0, 0.0), (1.0, 0.0))
    grant = Granting(lambda frame, drone: move if frame == 10 else "too near")
    viewpoints, queue, world = _queue(monkeypatch, grant)
    viewpoints.request(0, Reposition(0.0, 0.0, "r"))
    for frame in range(25):
        queue.renew(frame)
    told = [row[3].partition(" ")[0] for row in world._recorder.rows["events"]]
    assert told == ["stays,", "moves", "stays,"]


def test_only_drones_that_fly_move_and_slots_stay_free_for_those_that_will_come(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    joins = "events=[{kind: drone_joins, at_s: 4, drone: 3}]"
    grant = Granting(lambda frame, drone: None)
    viewpoints, queue, world = _queue(monkeypatch, grant, joins)
    for drone in range(4):
        viewpoints.request(drone, Reposition(0.0, 0.0, "r"))
    world.homebound.add(2)
    queue.renew(0)
    assert grant.asked == [(0, 0), (0, 1)], "drone 2 goes home and drone 3 is on the ground"
    assert grant.gone == [set(), set()]
    world.remove(1, "drone_lost", "fell silent")
    queue.renew(1)
    assert (grant.asked[2:], grant.gone[2:]) == ([(1, 0)], [{1}])


# --- in flight -----------------------------------------------------------------------------------

ASIDE = "mission.target.waypoints_m=[[-60, 60], [200, 60]]"
LONG = (
    "duration_s=20",
    ASIDE,
    "mission.phases=[{at_s: 0, phase: search}, {at_s: 2, phase: track, region: {radius_m: 32}}]",
)
"""Flights of their own: in no recorded one a policy chooses viewpoints."""


def share(view: FleetView) -> list[Directive]:
    return everyone(view, received_budget=0.02)


def flown_m(record: SortieRecord) -> np.ndarray:
    """[T, N, 3] true positions."""
    states = record.tables["states"]
    xyz = np.stack([states[c].to_numpy() for c in ("x_m", "y_m", "z_m")], axis=-1)
    return xyz.reshape(-1, record.scenario.fleet.drones, 3)


def viewpoints(record: SortieRecord) -> list[str]:
    return [e["text"] for e in record.tables["events"].to_pylist() if e["kind"] == "viewpoint"]


def north_m(record: SortieRecord, position_m: np.ndarray) -> float:
    """How far north the cells lie that drone 0 sees well at the last look, in the mean."""
    grids = [d["coverage_grid"] for d in record.tables["descriptors"].to_pylist() if d["drone"] == 0]
    row = math.floor(position_m[190, 0, 1] / COVERAGE_CELL_M) - 8
    rows = np.flatnonzero((unpack_grid(grids[190]) >= Coverage.WELL).any(axis=1))
    return float((row + rows.mean()) * COVERAGE_CELL_M)


def test_a_policy_that_asks_for_nothing_flies_the_very_same_sortie() -> None:
    """Bit for bit, everything: the machinery is there and nobody moves."""
    asks_nothing = looks_from(lambda view: None)(lambda view: share(view))
    asks_nothing.name = f"{share.__module__}.share"  # type: ignore[attr-defined]
    short = (*LONG, "duration_s=3")
    assert run_sortie(example(*short), asks_nothing).fingerprint == run_sortie(example(*short), share).fingerprint


def test_drones_move_and_all_that_depends_on_it_follows() -> None:
    plain = ("perception.scene.building_density=0", "perception.scene.tree_density=0")  # houses hide cells
    stays, moves = (run_sortie(example(*LONG, *plain), policy) for policy in (share, vantage))
    before, after = flown_m(stays), flown_m(moves)
    assert np.array_equal(before[:21], after[:21])  # nobody knows before the phase turns
    assert (after[-1, :, 1] - before[-1, :, 1]).min() > 15.0  # 17 s towards y = 60, a move of 40 m takes 30
    gone = [e for e in moves.tables["events"].to_pylist() if e["kind"] == "viewpoint"]
    assert sorted(e["drone"] for e in gone) == [0, 1, 2, 3, 4]
    assert all("m from the region" in e["text"] for e in gone)
    # the cells that drone 0 sees well, of which the edges go by whole cells
    went_m = after[190, 0, 1] - before[190, 0, 1]
    assert north_m(moves, after) - north_m(stays, before) == pytest.approx(went_m, abs=COVERAGE_CELL_M / 2)
    # velocity is the slope of position; nobody jumps
    velocity = moves.tables["states"]["vy_mps"].to_numpy().reshape(-1, 5)
    assert np.abs(np.diff(after[:, :, 1], axis=0) / 0.1 - velocity[:-1]).max() < 0.3
    # what the rotors draw depends on the air speed; the radio has another path, and another SNR
    rotor = [
        {e["drone"]: e["energy_j"] for e in r.tables["energy"].to_pylist() if e["cause"] == "rotor"}
        for r in (stays, moves)
    ]
    assert all(abs(rotor[1][i] - rotor[0][i]) > 1.0 for i in range(5))
    assert moves.tables["transmissions"]["snr_db"] != stays.tables["transmissions"]["snr_db"]


def test_no_pair_comes_closer_than_the_bound_and_nobody_leaves_the_fence() -> None:
    """True positions, jitter and all, of drones that all want to be where drone 0 is, and then far outside."""

    def crowd(view: FleetView) -> Reposition | None:
        if view.me is None or 0 not in view.descriptors:
            return None
        x_m, y_m, _ = view.descriptors[0].position_m
        late = view.me.stamp_ns > 12e9
        return Reposition(x_m + 60.0, y_m + 10.0 * view.ego) if late else Reposition(x_m, y_m)

    fence = [-90, -45, 85, 45]
    fast = f"fleet.viewpoints={{speed_mps: 8, acceleration_mps2: 4, separation_m: 9, fence_m: {fence}}}"
    record = run_sortie(example("duration_s=24", fast), looks_from(crowd)(lambda v: []))
    position = flown_m(record)
    apart = [np.linalg.norm(position[:, i] - position[:, j], axis=-1) for i in range(5) for j in range(i)]
    assert 9.0 < np.min(apart) < 15.0  # they came close, and not too close
    assert (position[..., :2] > fence[:2]).all()
    assert (position[..., :2] < fence[2:]).all()
    assert position[..., 0].max() > 78.0  # and near the fence
    noted = {text.split(":")[0] for text in viewpoints(record)}
    assert "stays, would leave the fence" in noted
    assert any(text.startswith("stays, would come too near drone") for text in noted)


def test_drones_return_to_their_slots_when_the_policy_changes() -> None:
    """To one that chooses no viewpoints, here by time."""
    sets = (*LONG, "duration_s=45", "fleet.viewpoints.reach_m=8", "fleet.drones=3")
    stays = flown_m(run_sortie(example(*sets), "silence"))
    moves = flown_m(run_sortie(example(*sets, "policy={name: vantage, changes: [{at_s: 20, name: silence}]}")))
    aside = np.linalg.norm(moves - stays, axis=-1)
    assert aside[190].min() > 7.9
    assert aside[-1].max() < 1e-9


def test_a_request_for_where_a_drone_is_moves_it_nowhere_whatever_it_believes() -> None:
    """A drone that believes to be elsewhere asks for elsewhere. It is to stay, and not to run after its own error."""

    def here(view: FleetView) -> Reposition | None:
        return None if view.me is None else Reposition(*view.me.position_m[:2])

    fault = "events=[{kind: position_fault, at_s: 1, drone: 2, offset_m: [9, -4, 0], drift_mps: [0, 0.5, 0]}]"
    settings = ("duration_s=5", "fleet.motion.pose_error_m=0.5", fault)
    nobody: Any = looks_from(here)(lambda view: [])
    stays, asks = (flown_m(run_sortie(example(*settings), policy)) for policy in ("silence", nobody))
    assert np.abs(asks - stays).max() < 0.6  # the jitter about its slot is not flown away either


def test_nobody_keeps_clear_of_drones_that_left_the_air() -> None:
    lost = "events=[{kind: drone_lost, at_s: 0, drone: 0}, {kind: drone_lost, at_s: 0, drone: 1}]"
    record = run_sortie(
        example(*LONG, "fleet.viewpoints={separation_m: 19, reach_m: 50}", lost, "duration_s=8"), vantage
    )
    noted = viewpoints(record)
    assert any(text.startswith("moves ") for text in noted)
    assert not [text for text in noted if re.search(r"too near drone [01]\b", text)]


def test_a_fleet_in_which_a_trace_or_a_group_flies_holds_its_slots_and_stations_are_in_nobody_s_way(
    tmp_path: Path,
) -> None:
    trace = tmp_path / "trace.csv"
    trace.write_text("t_s,drone,x_m,y_m,z_m\n0,1,-40,0,60\n20,1,60,0,60\n")
    short = (*LONG, "duration_s=3")
    record = run_sortie(example(*short, f"fleet.trace={trace}"), vantage)
    assert viewpoints(record) == ["holds its slot: a drone of the fleet flies a recorded pose"] * 5
    apart = "fleet.groups=[{drones: [4], route: {waypoints_m: [[300, 300]]}}]"
    assert set(viewpoints(run_sortie(example(*short, apart), vantage))) == {
        "holds its slot: a drone of the fleet flies apart from the formation"
    }
    near = run_sortie(example(*short, "fleet.ground=[{drone: 4, position_m: [0, -20, 3]}]"), vantage)
    moves = [r for r in near.tables["events"].to_pylist() if r["kind"] == "viewpoint"]
    assert any("moves" in r["text"] for r in moves)
    assert 4 not in {r["drone"] for r in moves}
    assert (flown_m(near)[:, 4, 2] == 3.0).all()


def test_a_wish_or_a_fence_out_of_bounds_is_refused_with_its_drone_and_bound() -> None:
    far = looks_from(lambda view: Reposition(5000.0, 0.0))(lambda view: share(view))
    words = r"reposition of drone \d: 50\d\d\.\d m from the drone, must be at most 200 m"
    with pytest.raises(PolicyError, match=words):
        run_sortie(example(), far)
    broken = looks_from(lambda view: view.nothing)(lambda view: share(view))
    with pytest.raises(PolicyError, match=r"on drone \d: its viewpoint raises AttributeError"):
        run_sortie(example(), broken)
    fenced = example("fleet.viewpoints.fence_m=[-100, -5, 100, 5]", "duration_s=0.3", "mission.phases=[{}]")
    with pytest.raises(MotionError, match="must hold every slot's way"):
        run_sortie(fenced, vantage)
    run_sortie(fenced, share)  # nobody asks
    assert viewpoints(recorded("base")) == []


@pytest.mark.slow
def test_nearer_the_region_more_is_found_in_it() -> None:
    settings = (*LONG, "duration_s=30", "perception.detector=surrogate", "fleet.viewpoints.speed_mps=8")
    stays, moves = (outcome(run_sortie(example(*settings), policy)) for policy in (share, vantage))
    assert moves["ap50"]["mission"] > stays["ap50"]["mission"]
