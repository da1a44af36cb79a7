"""Viewpoints in flight: drones truly move when their policy asks, and nothing at all is different where none does."""

from __future__ import annotations

import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sim_examples import example

from sortie.fleet.coverage import unpack_grid
from sortie.fleet.flight.motion import MotionError
from sortie.fleet.flight.viewpoints import Move
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
from sortie.sim.engine import choreography
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

ASIDE = "mission.target.waypoints_m=[[-60, 60], [200, 60]]"
LONG = (
    "duration_s=20",
    ASIDE,
    "mission.phases=[{at_s: 0, phase: search}, {at_s: 2, phase: track, region: {radius_m: 32}}]",
)


def share(view: FleetView) -> list[Directive]:
    return everyone(view, received_budget=0.02)


def never(view: FleetView) -> Reposition | None:
    return None


def flown_m(record: SortieRecord) -> np.ndarray:
    """[T, N, 3] true positions."""
    states = record.tables["states"]
    xyz = np.stack([states[c].to_numpy() for c in ("x_m", "y_m", "z_m")], axis=-1)
    return xyz.reshape(-1, 5, 3)


def north_m(record: SortieRecord, position_m: np.ndarray) -> float:
    """How far north the cells lie that drone 0 sees well at the last look, in the mean."""
    told = [d["coverage_grid"] for d in record.tables["descriptors"].to_pylist() if d["drone"] == 0]
    row = math.floor(position_m[190, 0, 1] / COVERAGE_CELL_M) - 8
    rows = np.flatnonzero((unpack_grid(told[190]) >= Coverage.WELL).any(axis=1))
    return float((row + rows.mean()) * COVERAGE_CELL_M)


def column(record: SortieRecord, table: str, name: str) -> np.ndarray:
    values: np.ndarray = record.tables[table][name].to_numpy()
    return values


def test_a_policy_that_asks_for_nothing_flies_the_very_same_sortie() -> None:
    """Bit for bit, everything: the machinery is there and nobody moves."""
    asks_nothing = looks_from(never)(lambda view: share(view))
    asks_nothing.name = f"{share.__module__}.share"  # type: ignore[attr-defined]
    assert run_sortie(example(*LONG), asks_nothing).fingerprint == run_sortie(example(*LONG), share).fingerprint


def test_drones_move_and_all_that_hangs_on_it_follows() -> None:
    plain = ("perception.scene.building_density=0", "perception.scene.tree_density=0")  # houses hide cells
    stays, moves = (run_sortie(example(*LONG, *plain), policy) for policy in (share, vantage))
    before, after = flown_m(stays), flown_m(moves)
    assert np.array_equal(before[:21], after[:21])  # nobody knows before the phase turns
    assert (after[-1, :, 1] - before[-1, :, 1]).min() > 15.0  # 17 s towards y = 60, a move of 40 m takes 30
    gone = [e for e in moves.tables["events"].to_pylist() if e["kind"] == "viewpoint"]
    assert sorted(e["drone"] for e in gone) == [0, 1, 2, 3, 4]
    assert all("m from the region" in e["text"] for e in gone)

    # what drones say of themselves: the cells that drone 0 sees well, whose edges go by whole cells
    went_m = after[190, 0, 1] - before[190, 0, 1]
    assert north_m(moves, after) - north_m(stays, before) == pytest.approx(went_m, abs=COVERAGE_CELL_M / 2)
    # velocity is the slope of position; nobody jumps
    velocity = column(moves, "states", "vy_mps").reshape(-1, 5)
    assert np.abs(np.diff(after[:, :, 1], axis=0) / 0.1 - velocity[:-1]).max() < 0.3
    # the battery: what the rotors draw depends on the air speed
    rotor = [
        {e["drone"]: e["energy_j"] for e in r.tables["energy"].to_pylist() if e["cause"] == "rotor"}
        for r in (stays, moves)
    ]
    assert all(abs(rotor[1][i] - rotor[0][i]) > 1.0 for i in range(5))
    # the radio: another path, another SNR
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
    fast = ("fleet.viewpoints.speed_mps=8", "fleet.viewpoints.acceleration_mps2=4", "fleet.viewpoints.separation_m=9")
    record = run_sortie(
        example("duration_s=24", *fast, f"fleet.viewpoints.fence_m={fence}"), looks_from(crowd)(lambda v: share(v))
    )
    position = flown_m(record)
    apart = [np.linalg.norm(position[:, i] - position[:, j], axis=-1) for i in range(5) for j in range(i)]
    assert 9.0 < np.min(apart) < 15.0  # they came close, and not too close
    assert (position[..., :2] > fence[:2]).all()
    assert (position[..., :2] < fence[2:]).all()
    assert position[..., 0].max() > 78.0  # and near the fence
    said = {e["text"].split(":")[0] for e in record.tables["events"].to_pylist() if e["kind"] == "viewpoint"}
    assert "stays, would leave the fence" in said
    assert any(text.startswith("stays, would come too near drone") for text in said)


def test_drones_return_to_their_slots_when_the_policy_changes() -> None:
    """To one that chooses no viewpoints, here by time."""
    settings = (
        *LONG,
        "duration_s=45",
        "fleet.viewpoints.reach_m=8",
        "policy.name=vantage",
        "policy.params={received_budget: 0.02}",
    )
    stays = flown_m(run_sortie(example(*settings, "policy.name=all-4")))
    moves = flown_m(run_sortie(example(*settings, "policy.changes=[{at_s: 20, name: silence}]")))
    aside = np.linalg.norm(moves - stays, axis=-1)
    assert aside[190].min() > 7.9
    assert aside[-1].max() < 1e-9


@pytest.mark.parametrize("offset_m", [[0, 0, 0], [9, -4, 0]])
def test_a_request_for_where_a_drone_is_moves_it_nowhere_whatever_it_believes(offset_m: list[float]) -> None:
    """A drone that believes to be elsewhere asks for elsewhere. It is meant to stay, and not to run after its own error."""

    def here(view: FleetView) -> Reposition | None:
        return None if view.me is None else Reposition(*view.me.position_m[:2])

    fault = f"events=[{{kind: position_fault, at_s: 1, drone: 2, offset_m: {offset_m}, drift_mps: [0, 0.5, 0]}}]"
    settings = ("duration_s=5", "fleet.motion.pose_error_m=0.5", fault)
    stays, asks = (flown_m(run_sortie(example(*settings), p)) for p in (share, looks_from(here)(lambda v: share(v))))
    assert np.abs(asks - stays).max() < 0.6  # the jitter about its slot is not flown away either


def test_nobody_keeps_clear_of_drones_that_left_the_air() -> None:
    lost = "events=[{kind: drone_lost, at_s: 0, drone: 0}, {kind: drone_lost, at_s: 0, drone: 1}]"
    bounds = ("fleet.viewpoints.separation_m=19", "fleet.viewpoints.reach_m=50")
    record = run_sortie(example(*LONG, *bounds, lost), vantage)
    told = [e["text"] for e in record.tables["events"].to_pylist() if e["kind"] == "viewpoint"]
    assert any(text.startswith("moves ") for text in told)
    assert not [text for text in told if re.search(r"too near drone [01]\b", text)]


@pytest.mark.parametrize("comes", [True, False])
def test_a_refused_request_waits_a_second_and_is_written_down_once(
    comes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By hand, frame by frame: who asks, with whom left out, and what is noted. Drone 3 goes home, and 4 is on the ground: neither
    asks. What stands in the way is left out where it is gone for good."""
    joins = "events=[{kind: drone_joins, at_s: 5.5, drone: 4}]" if comes else "events=[]"
    asked: list[tuple[int, int, list[int]]] = []
    told: list[tuple[int, int, str]] = []
    frame = 0
    world: Any = SimpleNamespace(
        motion=SimpleNamespace(time_s=np.arange(60) * 0.1), homebound={3}, reroute=lambda motion: None,
        drones=[SimpleNamespace(airborne=i != 4) for i in range(5)],
        note=lambda drone, kind, text: told.append((frame, drone, text.partition(",")[0])),
    )  # fmt: skip

    def answer(drone: int, *_: Any) -> Move | str | None:
        asked.append((_[4], drone, _[5]))
        moves = {20: Move(2.0, 1.0, (0.0, 0.0), (3.0, 0.0))}
        return moves.get(frame, None if 20 < frame < 30 else "would come too near drone 1")

    monkeypatch.setattr(choreography, "grant", answer)
    monkeypatch.setattr(choreography, "displaced", lambda *_: None)
    fleet = choreography.Choreography(example(joins), world, posed_by_trace=False)
    for drone in (2, 3, 4):
        fleet.request(drone, None)
    for frame in range(45):
        fleet.renew(frame)
    gone: list[int] = [] if comes else [4]
    assert asked == [(at, 2, gone) for at in (0, 10, *range(20, 31), 40)]
    assert told == [(0, 2, "stays"), (20, 2, "moves 3.0 m in 1.0 s"), (30, 2, "stays")]


def test_a_fleet_in_which_a_trace_flies_holds_its_slots(tmp_path: Path) -> None:
    trace = tmp_path / "trace.csv"
    trace.write_text("t_s,drone,x_m,y_m,z_m\n0,1,-40,0,60\n20,1,60,0,60\n")
    record = run_sortie(example(*LONG, f"fleet.trace={trace}"), vantage)
    said = [e["text"] for e in record.tables["events"].to_pylist() if e["kind"] == "viewpoint"]
    assert said == ["holds its slot: a drone of the fleet flies a recorded pose"] * 5
    assert np.array_equal(flown_m(record), flown_m(run_sortie(example(*LONG, f"fleet.trace={trace}"), share)))


def test_a_wish_out_of_bounds_stops_the_sortie_with_its_drone_and_bound() -> None:
    far = looks_from(lambda view: Reposition(5000.0, 0.0))(lambda view: share(view))
    with pytest.raises(
        PolicyError, match=r"reposition of drone \d: 50\d\d\.\d m from the drone, must be at most 200 m"
    ):
        run_sortie(example(), far)
    broken = looks_from(lambda view: view.nothing)(lambda view: share(view))
    with pytest.raises(PolicyError, match=r"on drone \d: its viewpoint raises AttributeError"):
        run_sortie(example(), broken)


def test_a_fence_that_the_formation_leaves_is_told_before_anything_flies() -> None:
    with pytest.raises(MotionError, match="must hold every slot's way"):
        run_sortie(example("fleet.viewpoints.fence_m=[-100, -5, 100, 5]"), vantage)
    run_sortie(example("fleet.viewpoints.fence_m=[-100, -5, 100, 5]", "duration_s=1"), share)  # nobody asks


@pytest.mark.slow
def test_nearer_the_region_more_is_found_in_it() -> None:
    settings = (*LONG, "duration_s=30", "perception.detector=surrogate", "fleet.viewpoints.speed_mps=8")
    stays, moves = (outcome(run_sortie(example(*settings), policy)) for policy in (share, vantage))
    assert moves["ap50"]["mission"] > stays["ap50"]["mission"]
