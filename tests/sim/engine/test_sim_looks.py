"""A drone's own look: when it is there, what resting costs; and where drones stay that leave the air."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import pyarrow.compute as pc
import pytest
from sim_examples import example

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.accuracy import both_matched
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

SEEING = ("perception.detector=surrogate", "perception.sample_rate_hz=1")
FAST = (*SEEING, "fleet.route={waypoints_m: [[-60, 0], [160, 0]], speed_mps: 15}")


def resting(percent_by_peer: Sequence[int], view: FleetView) -> list[Directive]:
    """Nothing to anyone; perception by what each link, in order, asks."""
    asked = zip(view.peers, percent_by_peer, strict=False)
    return [Directive(view.ego, peer, duty_percent=percent, reason="rests") for peer, percent in asked]


def asleep(view: FleetView) -> list[Directive]:
    return resting([0] * 8, view)


def one_link_asks(view: FleetView) -> list[Directive]:
    """Features to the first peer, which takes the dwell time to be let through; the other links let perception rest."""
    first, *others = view.peers or (None,)
    served = [] if first is None else [Directive(view.ego, first, Representation.FEATURES, 0.05, rate_hz=10.0)]
    return served + [Directive(view.ego, peer, duty_percent=0) for peer in others]


def of(record: SortieRecord, table: str, drone: int) -> dict[str, np.ndarray]:
    rows = record.tables[table].filter(pc.equal(record.tables[table]["drone"], drone))
    return {name: rows[name].to_numpy() for name in rows.column_names if rows[name].type != "list<item: double>"}


@pytest.mark.parametrize("rate_hz", [10, 2, 1, 0.5])
def test_a_slow_plane_is_scored_on_the_present_look(rate_hz: float) -> None:
    """Drones act within 10 ms of a frame's begin, however long the frame is: 95 ms later their looks are there."""
    record = run_sortie(example(*SEEING, f"context.rate_hz={rate_hz}", "policy.name=silence", "policy.params={}"))
    scored = round(6 * min(rate_hz, 1.0)) * 5
    assert record.tables["fusions"].num_rows == scored
    assert outcome(record)["ap50"]["sample_rate_hz"] == min(rate_hz, 1.0)
    here = record.tables["states"].filter(pc.equal(record.tables["states"]["t_s"], 0.0))
    truth = record.tables["truths"].filter(pc.less(record.tables["truths"]["t_s"], 0.1))
    away_m = np.abs(truth["x_m"].to_numpy() - np.repeat(here["x_m"].to_numpy(), np.bincount(truth["drone"].to_numpy())))
    assert away_m.max() < 110.0


def test_an_own_look_takes_its_compute_delay() -> None:
    """Computed after the frame's fusion, a look is used in the next one: 0.1 s later, and of nothing in the first."""
    flown = [
        run_sortie(example(*FAST, "policy.name=silence", "policy.params={}", f"perception.compute_delay_s={delay_s}"))
        for delay_s in (0.03, 0.09, 0.95)
    ]
    fusions = [record.tables["fusions"].num_rows for record in flown]
    assert fusions == [30, 25, 25]  # drones act 0 … 10 ms into a frame: at 0.09 s some look may just make it
    first, _, late = (of(record, "detections", 0) for record in flown)
    assert not np.isin(late["x_m"], first["x_m"]).any()


def test_a_drone_that_rests_sees_nothing_and_is_judged_where_it_is() -> None:
    record = run_sortie(example(*FAST), asleep)
    found = of(record, "fusions", 0)
    awake = found["t_s"] < 0.5
    assert (found["detections"][awake] > 0).all()
    assert (found["detections"][found["t_s"] > 1.0] == 0).all()
    assert (found["truths"] > 0).all()
    truth, states = of(record, "truths", 0), of(record, "states", 0)
    for t_s in found["t_s"]:
        x_m = np.interp(t_s - 0.095, states["t_s"], states["x_m"])
        cars_m = truth["x_m"][truth["t_s"] == t_s]
        assert np.abs(cars_m - x_m).max() < 110.0  # its range, not that of where it looked last
    assert states["x_m"][-1] - states["x_m"][0] > 60.0


def test_a_link_that_waits_for_its_dwell_keeps_perception_awake() -> None:
    """A drone's duty is the highest of its links', those whose first directive is not yet in force among them."""
    record = run_sortie(
        example(*SEEING, "perception.sample_rate_hz=10", "policy.dwell_s=2", "duration_s=1"), one_link_asks
    )
    seen = of(record, "fusions", 0)
    assert len(set(seen["t_s"])) == 10
    compute_j = {r["energy_j"] for r in record.tables["energy"].to_pylist() if r["cause"] == "compute"}
    awake = run_sortie(example("duration_s=1", "policy.name=silence", "policy.params={}"))
    assert compute_j == {r["energy_j"] for r in awake.tables["energy"].to_pylist() if r["cause"] == "compute"}


def test_who_leaves_the_air_stays_where_that_was() -> None:
    events = (
        "events=[{kind: drone_lost, at_s: 2.05, drone: 1}, {kind: battery_fault, at_s: 3, drone: 2, lost_fraction: 1}]"
    )
    lost, faulty, flying = (of(run_sortie(example(*FAST[2:], events)), "states", drone) for drone in (1, 2, 0))
    for states, since_s in ((lost, 2.0), (faulty, 3.0)):
        down = states["t_s"] > since_s + 1e-6
        there = states["x_m"][np.isclose(states["t_s"], since_s)]
        assert (states["x_m"][down] == there).all()
        assert not any(states[name][down].any() for name in ("vx_mps", "vy_mps", "vz_mps", "p_radps", "r_radps"))
        assert np.ptp(states["x_m"][~down]) > 20.0
    assert np.diff(flying["x_m"])[10:].min() > 0.5


@pytest.mark.parametrize(
    ("override", "why"),
    [
        ("fleet.airframe.mass_kg=30", "the pack cannot give "),
        ("fleet.battery.cutoff_cell_v=4.1", " V a cell, cut off below 4.1 V"),
        ("fleet.battery.initial_soc=0.1001", "charge 10.0%"),
    ],
)
def test_a_landing_says_what_brought_it_down(override: str, why: str) -> None:
    record = run_sortie(example(override, "fleet.airframe.power_model=momentum", "duration_s=2"))
    landed = [row["text"] for row in record.tables["events"].to_pylist() if row["kind"] == "landed"]
    assert len(landed) == 5
    assert all(why in text for text in landed)


def served(kind: Representation, rho: float, view: FleetView) -> list[Directive]:
    """Drone 0 rests and sends nothing; the others send to all at 10 Hz."""
    if view.ego == 0:
        return resting([0] * 8, view)
    return [Directive(view.ego, p, kind, rho, None, 10.0, reason="serves") for p in view.peers]


@pytest.mark.parametrize(
    ("kind", "rho"),
    [(Representation.DETECTIONS, 0.0), (Representation.TRACKS, 0.0), (Representation.FEATURES, 0.25)],
)
def test_a_drone_that_rests_fuses_what_its_peers_send(kind: Representation, rho: float) -> None:
    record = run_sortie(example(*SEEING), partial(served, kind, rho))
    table = record.tables["fusions"]
    rows = [r for r in table.to_pylist() if r["t_s"] > 1.0]
    resting_rows, awake = ([r for r in rows if (r["drone"] == 0) == rests] for rests in (True, False))
    assert all(r["peers"] == [1, 2, 3, 4] for r in resting_rows)
    assert min(r["detections"] for r in resting_rows) > 10
    hits = {
        rests: np.mean(
            [m.hit.sum() for (t_s, d), m in both_matched(record)["full_scene"].items() if t_s > 1 and (d == 0) == rests]
        )
        for rests in (True, False)
    }
    assert hits[True] > 0.5 * hits[False]
    assert awake
