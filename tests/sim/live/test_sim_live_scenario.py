"""What a live flight takes of its scenario: makes, members, clocks, lies and people, and what it says it leaves out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import simpy
from dds_domains import domain
from live_flights import Seen, fly_until
from memory_bus import MemoryBus
from policies_examples import fleet_of
from pydantic import BaseModel
from sim_examples import example
from typer.testing import CliRunner

from sortie.fleet.memory import PeerMemory
from sortie.fleet.messages.wire import encode_descriptor
from sortie.fleet.plane import DroneStatus
from sortie.policies.contract import PERSON_FLAG, Representation, TaskPhase
from sortie.policies.staleness import LinkHealth
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Scenario
from sortie.sim.cli.app import app
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import build, run_frames, run_sortie
from sortie.sim.export.topics import CONTEXT
from sortie.sim.live import session
from sortie.sim.live.context import ReplaySenses, Trace, traces
from sortie.sim.live.events import LiveEvents, status_of
from sortie.sim.live.node import LiveNode
from sortie.sim.live.policy_process import Begin, PolicyOrders
from sortie.sim.live.rules import rules_of
from sortie.sim.live.scope import UNUSED, left_out
from sortie.sim.live.seals import Seals
from sortie.sim.live.watchdog import DETECTIONS, Watchdog

SEEN = ("states", "descriptors")
ALL_4 = "policy: all-4, policy_params: {received_budget: 0.03125}"
OTHER = f"fleet.makes=[{{name: other, drones: [1], {ALL_4}, feature_space: other}}]"


def frames_in_the_fleet(trace: Trace, scenario: Scenario) -> list[bool]:
    """Whether a drone of a live flight is in the fleet, by frame."""
    env, status = simpy.Environment(), status_of(scenario, 1, 0.0)
    LiveEvents(scenario, 1, env, status, lambda _: None).follow(trace)  # type: ignore[arg-type]
    found = []
    for frame in range(scenario.frames):
        env.run(until=frame * scenario.frame_s + 0.001)
        found.append(status.airborne)
    return found


# --- makes ---------------------------------------------------------------------------------------------


def test_a_make_s_own_policy_decides() -> None:
    scenario = example(
        "fleet.drones=3", "fleet.makes=[{name: quiet, drones: [1], policy: silence}]", "policy={name: all-4}"
    )
    asked = []
    for drone in (0, 1):
        dog = Watchdog(PolicyOrders(scenario, drone), fallback=DETECTIONS, deadline_s=30.0)
        try:
            dog.wait_until_loaded()
            dog.begin(Begin(0.0, 0.0), str, lambda _: None)
            asked.append({d.representation for d in dog(fleet_of(3)._replace(ego=drone))})
        finally:
            dog.close()
    assert asked == [{Representation.FEATURES}, {Representation.NONE}]


def test_two_networks_fly_and_a_drone_joins_and_is_lost_as_the_scenario_says() -> None:
    """Two makes with two networks; drone 1 joins late, and is lost. Policies send no maps to another network."""
    members = "events=[{kind: drone_joins, at_s: 1.5, drone: 1}, {kind: drone_lost, at_s: 20, drone: 1}]"
    # on a busy machine descriptors and decisions come late, and orders would name that as their reason
    patient = "context={degraded_after_periods: 99, detached_after_periods: 100}"

    def both_networks_and_lost(seen: Seen) -> bool:
        reasons = {(o.drone, "another network" in o.reason) for new in seen.fleet.news for o in new.orders}
        return {(0, True), (1, True)} <= reasons and seen.healths(0, 1)[-1:] == [LinkHealth.DETACHED]

    mixed = fly_until(
        both_networks_and_lost, "fleet.drones=2", OTHER, members, patient, domain=domain(__name__), decide_within_s=1.0
    )
    for drone in (0, 1):
        orders = [o for o in mixed.orders if o.drone == drone and o.representation != "none"]
        assert {o.representation for o in orders} == {"detections"}
    seen = [c for c in mixed.health if (c.drone, c.peer) == (0, 1) and c.health != LinkHealth.DEGRADED]
    assert [c.health for c in seen] == [LinkHealth.FRESH, LinkHealth.DETACHED]
    assert seen[0].t_s > 1.4
    assert seen[1].t_s > 20.0 + 9.9
    assert mixed.each[1].published <= 186  # from 1.5 s to 20 s
    assert {n.text for n in mixed.notices if n.drone == 1} >= {"takes off", "fell silent"}
    assert mixed.lost == []  # its process flew to the end


# --- members -------------------------------------------------------------------------------------------


def test_a_live_drone_is_in_the_fleet_when_the_simulated_one_is() -> None:
    for events in (
        "{kind: drone_joins, at_s: 1.5, drone: 1}, {kind: drone_lost, at_s: 4, drone: 1}",
        "{kind: drone_lost, at_s: 1, drone: 1}, {kind: drone_joins, at_s: 3.05, drone: 1}",
        "{kind: battery_fault, at_s: 2, drone: 1, lost_fraction: 1}",
    ):
        low = ("fleet.formation.altitude_m=10", "mission.descent_mps=5")
        scenario = example("fleet.drones=2", *low, f"events=[{events}]")
        flown = run_sortie(scenario).tables["states"].to_pandas()
        found = frames_in_the_fleet(traces(scenario)[1], scenario)
        assert found == flown[flown["drone"] == 1]["airborne"].tolist()
        assert 0 < sum(found) < len(found)


def test_what_is_replayed_is_of_the_same_frame_also_of_a_drone_that_goes_home() -> None:
    """It was of the frame before."""
    scenario = example("fleet.drones=2", "events=[{kind: drone_leaves, at_s: 2, drone: 1}]")
    flown = {name: t.to_pandas().query("drone == 1") for name, t in run_sortie(scenario).tables.items() if name in SEEN}
    height_m, soc = flown["states"]["z_m"].to_numpy(), flown["descriptors"]["soc"].to_list()
    begin = 5
    senses = ReplaySenses(scenario, 1, traces(scenario)[1], begin * 0.1)
    for frame in (0, 14, 16, 35, 54):
        sensed = senses.sense(frame)
        assert sensed.capture.drone == 1
        assert sensed.capture.position_m[2] == pytest.approx(height_m[begin + frame])
        assert senses.platform().soc == soc[begin + frame]
        assert (senses.task().phase == TaskPhase.LANDING) == (begin + frame > 19)
    assert height_m[59] < height_m[0] - 9


def test_a_planner_and_a_ground_station_are_replayed() -> None:
    own = Path(__file__).parents[1] / "engine" / "own_models.py"
    planner = (f"fleet.mobility={own}:Goes", "fleet.mobility_params={x_m: -50, y_m: -10, only: 0}")
    scenario = example("fleet.drones=3", *planner, "fleet.ground=[{drone: 2, position_m: [5, 5, 9]}]")
    flown = run_sortie(scenario).tables["states"].to_pandas()
    replayed = [ReplaySenses(scenario, i, trace, 0.0) for i, trace in enumerate(traces(scenario))]
    for frame in (0, 30, 50):
        its = flown[flown["t_s"].round(3) == round(frame * 0.1, 3)].sort_values("drone")
        sensed = [senses.sense(frame) for senses in replayed]
        assert [each.capture.position_m[0] for each in sensed] == pytest.approx(its["x_m"].tolist())
        assert [each.footprint_radius_m > 0 for each in sensed] == [True, True, False]


def test_a_drone_that_never_flies_has_senses_and_a_goodput_for_every_drone_whatever_rosters_say() -> None:
    scenario = example("fleet.drones=2", "events=[{kind: drone_joins, at_s: 5, drone: 1}]", "duration_s=6")
    (_, trace) = traces(scenario.model_copy(update={"duration_s": 2.0}))
    assert trace.aloft == ()
    senses = ReplaySenses(scenario, 1, trace, 0.0)
    assert senses.goodput_mbps() == (0.0,)
    assert 0 <= senses.platform().soc <= 1
    scenario = example("fleet.drones=3", "context.roster=true", "events=[{kind: drone_joins, at_s: 3, drone: 0}]")
    trace = traces(scenario)[2]
    assert {len(p.goodput_mbps) for p in trace.published} == {2}


class Fixed:
    """A clock that stands."""

    now = 1.0


def test_a_drone_on_the_ground_hears_nothing() -> None:
    bus, scenario = MemoryBus(), example("fleet.drones=2")
    status = DroneStatus(airborne=False)
    node = LiveNode(bus, Seals(None), 1, 2, seed=0)
    memory = PeerMemory(1, rules_of(scenario, 0.0, 6.0), status)
    node.fly(Fixed(), memory, rules_of(scenario, 0.0, 6.0), lambda: (1.0,))  # type: ignore[arg-type]
    descriptor = fleet_of(2).descriptors[0]._replace(stamp_ns=1_000_000_000)
    bus.writer(CONTEXT).write(encode_descriptor(descriptor))
    node.take()
    assert memory.peers == []
    status.airborne = True
    node.take()
    assert memory.peers == []  # what it missed is gone
    bus.writer(CONTEXT).write(encode_descriptor(descriptor))
    node.take()
    assert memory.peers == [0]


def test_each_link_loses_descriptors_by_draws_of_its_own() -> None:
    bus, scenario = MemoryBus(), example("fleet.drones=4")
    rules, view = rules_of(scenario, 0.0, 6.0), fleet_of(4)
    nodes = [LiveNode(bus, Seals(None), drone, 4, seed=0, loss=0.5) for drone in range(4)]
    for node in nodes:
        node.fly(Fixed(), PeerMemory(node.drone, rules, DroneStatus()), rules, lambda: (1.0,) * 3)
    lost: dict[tuple[int, int], list[int]] = {}
    for k in range(60):
        for sender in range(4):
            bus.writer(CONTEXT).write(encode_descriptor(view.descriptors[sender]._replace(stamp_ns=10**9 + k)))
            for node in nodes:
                before = node.report(0.0).lost
                node.take()
                if node.drone != sender:
                    lost.setdefault((sender, node.drone), []).append(node.report(0.0).lost - before)
    assert len({tuple(each) for each in lost.values()}) == 12
    assert all(15 < sum(each) < 45 for each in lost.values())


# --- clocks, lies, people ------------------------------------------------------------------------------

CLOCKS = (
    "fleet.clock={offset_s: 0.2, drift_ppm: 30000, drift_growth_ppm_per_min: 50000}",
    "events=[{kind: clock_skew, at_s: 1, drone: 1, skew_s: -0.5}, {kind: gnss_loss, at_s: 2, until_s: 4}, "
    "{kind: clock_drift, at_s: 5, drone: 1, drift_ppm: 40000}, {kind: clock_skew, at_s: 1, drone: 0, skew_s: 3}]",
)


def test_a_live_clock_is_off_as_the_simulated_one() -> None:
    """Also of a drone that starts late."""
    scenario = example("fleet.drones=2", *CLOCKS)
    for begin_s in (0.0, 3.0):
        parts = build(scenario, plan_for(scenario), scenario.seed)
        parts.env.process(run_frames(parts, lambda _: None))
        zero_s = 1000.0
        env, status, told = simpy.Environment(begin_s), status_of(scenario, 1, zero_s), []
        events = LiveEvents(scenario, 1, env, status, told.append)  # type: ignore[arg-type]
        off_s = []
        for frame in range(round(begin_s * 10), 60):
            t_s = frame * scenario.frame_s + 0.001
            parts.env.run(until=t_s)
            env.run(until=t_s)
            parts.world.read_clocks()
            events.read()
            simulated_s = parts.world.drones[1].clock_skew_s
            assert status.clock_skew_s - zero_s == pytest.approx(simulated_s, abs=1e-9)
            off_s.append(simulated_s)
        assert len({round(v, 4) for v in off_s}) >= 20
        said = ["clock off", "no GNSS: the clock drifts", "the clock follows GNSS again", "clock drifts"]
        assert [text.partition(" by")[0] for text in told] == said


def test_a_live_drone_lies_itself_and_its_own_senses_are_true() -> None:
    """The replayed charge was the lie, so that the drone's own policy believed it."""
    lie = "events=[{kind: lie, at_s: 1, drone: 1, about: battery, claim: little, until_s: 3}]"
    scenario = example("fleet.drones=2", lie)
    senses = ReplaySenses(scenario, 1, traces(scenario)[1], 0.0)
    env, status = simpy.Environment(), status_of(scenario, 1, 0.0)
    LiveEvents(scenario, 1, env, status, str)  # type: ignore[arg-type]
    lies = []
    for frame in (5, 15, 35):
        env.run(until=frame * 0.1)
        senses.sense(frame)
        assert senses.platform().soc > 0.9
        claims = fleet_of(2).descriptors[1]
        for each in status.lies.values():
            claims = each(claims)
        lies.append(claims.battery_soc < 0.1)
    assert lies == [False, True, False]


def test_a_person_that_the_simulated_drone_found_is_known_live() -> None:
    scenario = load("person_crossing", [])
    flown = run_sortie(scenario, replication=0).tables["descriptors"].to_pandas()
    known = flown[flown["drone"] == 0]["novelty_flags"].to_numpy() & PERSON_FLAG > 0
    senses = ReplaySenses(scenario, 0, traces(scenario)[0], 0.0)
    assert rules_of(scenario, 0.0, 1.0).people
    assert known.any()
    for frame in (int(np.flatnonzero(known)[0]), int(np.flatnonzero(~known)[0])):
        senses.sense(frame)
        assert senses.task().person_in_region == known[frame]


# --- what is left out ----------------------------------------------------------------------------------


def test_what_a_flight_leaves_out_is_named_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    assert left_out(example()) == ""
    spoof, drop, lost = (
        f"{{kind: {kind}, at_s: 1, drone: {i}}}" for kind, i in (("spoof", 1), ("link_drop", 1), ("drone_lost", 0))
    )
    scenario = example(
        "context.form=small",
        "perception.detector=surrogate",
        "record.views=true",
        "fleet.drones=3",
        "fleet.makes=[{name: a, drones: [2], weights: x.safetensors}]",
        f"events=[{spoof}, {drop}, {lost}]",
    )
    assert left_out(scenario) == (
        "a live flight does not use context.form, perception.detector, record.views, fleet.makes.0.weights, "
        "events.0 (spoof: no attacker joins the bus), "
        "events.1 (link_drop: it changes the replayed goodput alone, the bus loses nothing)"
    )
    assert left_out(scenario, vehicles=[0]).endswith(", events.2 (drone_lost: drone 0 does as its vehicle does)")
    monkeypatch.setattr(session, "traces", Mock(side_effect=KeyboardInterrupt))
    done = CliRunner().invoke(app, ["live", "--set", "record.views=true"])
    assert "a live flight does not use perception.detector, record.views" in done.stderr.replace("\n", " ")


USED = {
    "context": "rate_hz degraded_after_periods detached_after_periods authentication publish_every trust roster",
    "perception": "tracking_rate_hz compute_delay_s people thermal scene code_bytes",
    "policy": "name params dwell_s hysteresis changes commands invariants of_makes shield",
    "record": "",
    "limits": "decision_s",
}


def test_every_field_is_used_or_named() -> None:
    """A new field of these sections has to be in one of the two."""
    for section, words in USED.items():
        model: Any = Scenario.model_fields[section].annotation
        assert issubclass(model, BaseModel)
        used, unused = set(words.split()), {p.partition(".")[2] for p in UNUSED if p.startswith(f"{section}.")}
        assert unused | used == set(model.model_fields)
        assert not unused & used


LEFT_OUT = {
    **{"precision": "bfloat16", "sample_rate_hz": 1, "egos": 2, "fusion_delay_s": 0.01, "max_age_s": 0.2},
    **{"join": "nms", "codebook": "other.safetensors", "match_poses": True},
    **{"maps_bring_boxes": True, "score_threshold": 0.5, "unsent_cells": "zero"},
}


def test_fields_that_are_left_out_change_no_trace() -> None:
    base = example("fleet.drones=2", "duration_s=3")
    flown = traces(base)
    for fields in (LEFT_OUT, {"fusion": "late", "motion_compensation": False}):
        sets = [f"perception.{name}={json.dumps(value)}" for name, value in fields.items()]
        changed = example("fleet.drones=2", "duration_s=3", *sets)
        assert all(getattr(base.perception, name) != getattr(changed.perception, name) for name in fields)
        named = left_out(changed).removeprefix("a live flight does not use ").split(", ")
        assert set(named) >= {f"perception.{name}" for name in fields}
        for one, other in zip(flown, traces(changed), strict=True):
            assert (one.t_s, one.published) == (other.t_s, other.published)
            assert (one.aloft, one.events) == (other.aloft, other.events)
