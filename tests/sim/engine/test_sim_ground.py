"""Groups that land by themselves, and ground stations: power, radio, scores, playback and exports."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from sim_examples import example

from sortie.fleet.logs.mavlink import mavlink2
from sortie.scenarios.errors import SortieError
from sortie.sim.engine.pilot import plan_for
from sortie.sim.engine.sortie import build, run_sortie
from sortie.sim.export.origin import ORIGIN
from sortie.sim.export.telemetry import Stream
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.report import page

STATION = "fleet.ground=[{drone: 4, position_m: [0, -20, 3]}]"
BATTERY = "fleet.ground=[{drone: 4, position_m: [0, -20, 3], mains: false}]"
SURROGATE = ("perception.detector=surrogate", "duration_s=3", "mission.phases=[{at_s: 0, phase: search}]")


def rows(record: SortieRecord, table: str, **where: Any) -> list[dict[str, Any]]:
    return [r for r in record.tables[table].to_pylist() if all(r[k] == v for k, v in where.items())]


def joules(record: SortieRecord, drone: int) -> dict[str, float]:
    return {r["cause"]: r["energy_j"] for r in rows(record, "energy", drone=drone) if r["energy_j"]}


def test_a_group_that_lands_goes_home_and_leaves_the_fleet() -> None:
    group = "{drones: [3], formation: {altitude_m: 10}, legs: [{action: hold, for_s: 1}, {action: land}], route: {turn_time_s: 1}}"
    record = run_sortie(example(f"fleet.groups=[{group}]", "mission.descent_mps=10"))
    told = [(r["kind"], r["text"]) for r in rows(record, "events", drone=3)]
    assert told == [("drone_leaves", "goes home: its legs end"), ("landed", "went home")]
    home, down = (r["t_s"] for r in rows(record, "events", drone=3))
    assert home == pytest.approx(2.5)  # a hold of 1 s between two changes of 1 s, and half of the next
    assert down == pytest.approx(home + 1, abs=0.1)
    assert rows(record, "states", drone=3)[-1]["z_m"] == pytest.approx(0.0, abs=0.05)
    assert {r["drone"] for r in rows(record, "events")} == {3}


def test_a_station_on_mains_takes_part_and_spends_nothing() -> None:
    record = run_sortie(example(STATION))
    assert joules(record, 4) == {}
    states = rows(record, "states", drone=4)
    assert {(r["x_m"], r["y_m"], r["z_m"], r["soc"], r["airborne"]) for r in states} == {(0.0, -20.0, 3.0, 1.0, True)}
    said = rows(record, "descriptors", drone=4)
    assert len(said) == len(rows(record, "descriptors", drone=0))
    assert {r["soc"] for r in said} == {1.0}
    assert not any(any(r["coverage_grid"]) for r in said)
    sharing = run_sortie(example(STATION, "policy.name=boxes", "policy.params={}", "duration_s=2"))
    assert rows(sharing, "transmissions", peer=4, status="delivered")
    assert not rows(sharing, "transmissions", drone=4)  # without cameras it has nothing to send
    assert outcome(record)["mission"]["flown_share"] == 1.0
    lost = run_sortie(example(STATION, "events=[{kind: drone_lost, at_s: 3, drone: 0}]"))
    assert outcome(lost)["mission"]["flown_share"] == pytest.approx(1 - 0.5 / 4), "of the four that fly"
    world = build(record.scenario, plan_for(record.scenario), 1).world
    assert [sensed.footprint_radius_m > 0 for sensed in (world.sensed(i, 0) for i in (0, 4))] == [True, False]


def test_a_station_on_its_battery_pays_for_all_but_rotors_and_goes_off() -> None:
    record = run_sortie(example(BATTERY, "fleet.battery.capacity_wh=50"))
    spent = joules(record, 4)
    assert spent.keys() == {"avionics", "compute", "radio", "ohmic"}
    assert spent["avionics"] == pytest.approx(8 * 6)
    assert spent["compute"] == pytest.approx(10 * 6)  # its computer rests
    off = run_sortie(example(BATTERY, "events=[{kind: battery_fault, at_s: 2, drone: 4, lost_fraction: 1}]"))
    assert [r["kind"] for r in rows(off, "events", drone=4)] == ["battery_fault", "power_lost"]
    assert max(r["t_s"] for r in rows(off, "descriptors", drone=4)) < 2
    assert outcome(off)["mission"]["flown_share"] == 1.0  # it is no drone that flies


def test_a_station_is_scored_only_where_it_is_told_to_be() -> None:
    left_out, scored = (
        run_sortie(example(*SURROGATE, f"fleet.ground=[{{drone: 4, position_m: [0, -20, 3], scored: {told}}}]"))
        for told in ("false", "true")
    )
    assert {r["drone"] for r in rows(left_out, "fusions")} == {0, 1, 2, 3}
    assert {r["drone"] for r in rows(left_out, "truths")} == {0, 1, 2, 3}
    assert {r["drone"] for r in rows(scored, "fusions")} == {0, 1, 2, 3, 4}
    same = [r for r in rows(scored, "fusions") if r["drone"] != 4]
    assert same == rows(left_out, "fusions")


def test_a_station_with_cameras_sees_from_where_it_stands() -> None:
    sees = "fleet.ground=[{drone: 4, position_m: [0, 0, 40], camera: true}]"
    record = run_sortie(example(sees))
    assert any(any(r["coverage_grid"]) for r in rows(record, "descriptors", drone=4))
    assert rows(record, "transmissions", drone=4)


def test_telemetry_and_report_call_a_station_one() -> None:
    record = run_sortie(example(STATION, "duration_s=1"))
    kinds = {
        drone: message.type
        for _, drone, message in Stream(record.scenario, ORIGIN).add(record.tables)
        if message.get_type() == "HEARTBEAT"
    }
    assert kinds == {**dict.fromkeys(range(4), mavlink2.MAV_TYPE_QUADROTOR), 4: mavlink2.MAV_TYPE_GCS}
    said = page(record)
    assert "<tr><td>station 4</td><td>mains</td><td></td><td></td><td>on</td></tr>" in said
    assert "<tr><td>drone 3</td>" in said


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (
            (STATION, "events=[{kind: drone_leaves, at_s: 1, drone: 4}]"),
            "events.0.drone: 4, must be a drone that flies, it is a ground station on mains power",
        ),
        (
            (BATTERY, "events=[{kind: drone_leaves, at_s: 1, drone: 4}]"),
            "events.0.drone: 4, must be a drone that flies, it is a ground station",
        ),
        (
            (STATION, "mission.groups=[{drones: [3, 4], phases: [{}], reserve: [3]}]"),
            "mission.groups.0.drones.1: 4, must be a drone that flies where there is a reserve, it is a ground station",
        ),
    ],
)
def test_what_a_station_cannot_do_is_refused(settings: tuple[str, ...], said: str) -> None:
    with pytest.raises(SortieError) as refused:
        example(*settings)
    assert said in str(refused.value)


def test_no_viewpoint_is_granted_where_groups_fly_apart() -> None:
    looks = ("policy.name=vantage", "policy.params={received_budget: 0.02}", "fleet.formation.spacing_m=14")
    aside = "mission.target.waypoints_m=[[-60, 60], [200, 60]]"
    apart = run_sortie(example(*looks, aside, "fleet.groups=[{drones: [4], route: {waypoints_m: [[300, 300]]}}]"))
    texts = {r["text"] for r in rows(apart, "events", kind="viewpoint")}
    assert texts == {"holds its slot: a drone of the fleet flies apart from the formation"}
    near = run_sortie(example(*looks, aside, STATION))  # a station is in nobody's way
    moves = rows(near, "events", kind="viewpoint")
    assert any("moves" in r["text"] for r in moves)
    assert 4 not in {r["drone"] for r in moves}
    heights = np.array([r["z_m"] for r in rows(near, "states", drone=4)])
    assert (heights == 3.0).all()
