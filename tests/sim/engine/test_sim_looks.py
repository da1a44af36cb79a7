"""A drone's own look: when it is there, and what resting costs."""

from __future__ import annotations

import functools

import numpy as np
import pyarrow.compute as pc
from sim_examples import example

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.accuracy import both_matched
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

SEEING = ("perception.detector=surrogate", "perception.sample_rate_hz=1", "mission.phases=[{}]")
FAST = (*SEEING, "fleet.route={waypoints_m: [[-60, 0], [160, 0]], speed_mps: 15}")


def of(record: SortieRecord, table: str, drone: int) -> dict[str, np.ndarray]:
    rows = record.tables[table].filter(pc.equal(record.tables[table]["drone"], drone))
    return {name: rows[name].to_numpy() for name in rows.column_names if rows[name].type != "list<item: double>"}


def test_a_slow_plane_is_scored_on_the_present_look() -> None:
    """Drones act within 10 ms of a frame's begin, however long the frame is: 95 ms later their looks are there."""
    for rate_hz in (2, 0.5):
        record = run_sortie(example(*SEEING, "fleet.drones=3", f"context.rate_hz={rate_hz}"), "silence")
        assert record.tables["fusions"].num_rows == round(6 * min(rate_hz, 1.0)) * 3
        assert outcome(record)["ap50"]["sample_rate_hz"] == min(rate_hz, 1.0)
        here = record.tables["states"].filter(pc.equal(record.tables["states"]["t_s"], 0.0))
        truth = record.tables["truths"].filter(pc.less(record.tables["truths"]["t_s"], 0.1))
        cars = np.bincount(truth["drone"].to_numpy())
        assert np.abs(truth["x_m"].to_numpy() - np.repeat(here["x_m"].to_numpy(), cars)).max() < 110.0


def test_an_own_look_takes_its_compute_delay() -> None:
    """Computed after the frame's fusion, a look is used in the next one: 0.1 s later, and of nothing in the first."""
    flown = [
        run_sortie(example(*FAST, "fleet.drones=2", "duration_s=4", f"perception.compute_delay_s={s}"), "silence")
        for s in (0.03, 0.95)
    ]
    assert [record.tables["fusions"].num_rows for record in flown] == [8, 6]
    first, late = (of(record, "detections", 0) for record in flown)
    assert not np.isin(late["x_m"], first["x_m"]).any()


@functools.cache
def resting() -> SortieRecord:
    """Drones 0 and 4 rest. The others send drone 0 each another representation, and drone 4 nothing."""
    sends = {1: (Representation.DETECTIONS, 0.0), 2: (Representation.TRACKS, 0.0), 3: (Representation.FEATURES, 0.25)}

    def policy(view: FleetView) -> list[Directive]:
        if view.ego not in sends:
            return [Directive(view.ego, peer, duty_percent=0, reason="rests") for peer in view.peers]
        rung, rho = sends[view.ego]
        to_0 = [Directive(view.ego, 0, rung, rho, None, 10.0, reason="serves")] if 0 in view.peers else []
        return [*to_0, *(Directive(view.ego, p, reason="nothing") for p in view.peers if p != 0)]

    return run_sortie(example(*FAST), policy)


def test_a_drone_that_rests_sees_nothing_and_is_judged_where_it_is() -> None:
    record = resting()
    found = of(record, "fusions", 4)
    assert (found["detections"][found["t_s"] < 0.5] > 0).all(), "before it heard of a peer"
    assert (found["detections"][found["t_s"] > 1.0] == 0).all()
    assert (found["truths"] > 0).all()
    truth, states = of(record, "truths", 4), of(record, "states", 4)
    for t_s in found["t_s"]:
        x_m = np.interp(t_s - 0.095, states["t_s"], states["x_m"])
        cars_m = truth["x_m"][truth["t_s"] == t_s]
        assert np.abs(cars_m - x_m).max() < 110.0  # its range, not that of where it looked last
    assert states["x_m"][-1] - states["x_m"][0] > 60.0


def test_a_drone_that_rests_fuses_what_its_peers_send() -> None:
    record = resting()
    rows = [r for r in record.tables["fusions"].to_pylist() if r["t_s"] > 1.0 and r["drone"] == 0]
    assert all(r["peers"] == [1, 2, 3] for r in rows)
    assert all(r["representations"] == ["detections", "tracks", "features"] for r in rows)
    assert min(r["detections"] for r in rows) > 10
    matched = both_matched(record)["full_scene"]
    hits = {d: np.mean([m.hit.sum() for (t_s, i), m in matched.items() if t_s > 1 and i == d]) for d in (0, 1)}
    assert hits[0] > 0.5 * hits[1]


def test_a_link_that_waits_for_its_dwell_keeps_perception_awake() -> None:
    """A drone's duty is the highest of its links', those whose first directive is not yet in force among them."""

    def one_link_asks(view: FleetView) -> list[Directive]:
        first, *others = view.peers or (None,)
        served = [] if first is None else [Directive(view.ego, first, Representation.FEATURES, 0.05, rate_hz=10.0)]
        return served + [Directive(view.ego, peer, duty_percent=0) for peer in others]

    few = ("duration_s=1", "fleet.drones=3", "mission.phases=[{}]", "policy.dwell_s=2")
    asks, awake = (run_sortie(example(*few), policy) for policy in (one_link_asks, "silence"))
    looks = [record.tables["states"]["looks"].to_pylist() for record in (asks, awake)]
    assert looks[0] == looks[1]
    assert not asks.tables["transmissions"].num_rows
