"""Groups that land by themselves, and ground stations: power, radio, scores, playback and exports.

Short flights of their own: in the recorded flight with a station it neither scores nor fails.
"""

from __future__ import annotations

from typing import Any

import pytest
from recorded import recorded
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

SHORT = ("duration_s=2", "fleet.drones=3", "mission.phases=[{at_s: 0, phase: search}]")
STATION = "fleet.ground=[{drone: 2, position_m: [0, -20, 3]}]"
BATTERY = "fleet.ground=[{drone: 2, position_m: [0, -20, 3], mains: false}]"


def rows(record: SortieRecord, table: str, **where: Any) -> list[dict[str, Any]]:
    return [r for r in record.tables[table].to_pylist() if all(r[k] == v for k, v in where.items())]


def joules(record: SortieRecord, drone: int) -> dict[str, float]:
    return {r["cause"]: r["energy_j"] for r in rows(record, "energy", drone=drone) if r["energy_j"]}


def test_a_group_that_lands_goes_home_and_leaves_the_fleet() -> None:
    legs = "legs: [{action: hold, for_s: 1}, {action: land}], route: {turn_time_s: 1}"
    group = f"fleet.groups=[{{drones: [3], formation: {{altitude_m: 10}}, {legs}}}]"
    record = run_sortie(example("duration_s=4", group, "mission.descent_mps=10"), "silence")
    events = rows(record, "events")
    assert [(r["drone"], r["kind"], r["text"]) for r in events] == [
        (3, "drone_leaves", "goes home: its legs end"),
        (3, "landed", "went home"),
    ]
    assert events[0]["t_s"] == pytest.approx(2.5)  # a hold of 1 s between two changes of 1 s, and half of the next
    assert events[1]["t_s"] == pytest.approx(3.5, abs=0.1)
    assert rows(record, "states", drone=3)[-1]["z_m"] == pytest.approx(0.0, abs=0.05)


def test_a_station_on_mains_takes_part_and_spends_nothing() -> None:
    """Drone 4 of the recorded flight stands between two pairs. Without cameras it has nothing to send, and relays."""
    record = recorded("relay")
    assert joules(record, 4) == {}
    states = rows(record, "states", drone=4)
    assert {(r["x_m"], r["y_m"], r["z_m"], r["soc"], r["airborne"]) for r in states} == {(-20.0, 0.0, 25.0, 1.0, True)}
    published = rows(record, "descriptors", drone=4)
    assert len(published) == len(rows(record, "descriptors", drone=0))
    assert {r["soc"] for r in published} == {1.0}
    assert not any(any(r["coverage_grid"]) for r in published)
    assert rows(record, "transmissions", peer=4, status="delivered")
    assert {r["representation"] for r in rows(record, "transmissions", peer=4)} == {"detections"}, "it fuses no maps"
    assert not rows(record, "transmissions", drone=4)
    lost = run_sortie(example(*SHORT, STATION, "events=[{kind: drone_lost, at_s: 1, drone: 0}]"), "silence")
    assert outcome(lost)["mission"]["flown_share"] == pytest.approx(1 - 0.5 / 2), "of the two that fly"
    world = build(record.scenario, plan_for(record.scenario), 1).world
    assert [world.sensed(i, 0).footprint_radius_m > 0 for i in (0, 4)] == [True, False]


def test_a_station_on_its_battery_pays_for_all_but_rotors_and_goes_off() -> None:
    spent = joules(run_sortie(example(*SHORT, BATTERY, "fleet.battery.capacity_wh=50")), 2)
    assert spent.keys() == {"avionics", "compute", "radio", "ohmic"}
    assert spent["avionics"] == pytest.approx(8 * 2)
    assert spent["compute"] == pytest.approx(10 * 2)  # its computer rests
    empty = "events=[{kind: battery_fault, at_s: 1, drone: 2, lost_fraction: 1}]"
    off = run_sortie(example(*SHORT, BATTERY, empty), "silence")
    assert [r["kind"] for r in rows(off, "events", drone=2)] == ["battery_fault", "power_lost"]
    assert max(r["t_s"] for r in rows(off, "descriptors", drone=2)) < 1
    assert outcome(off)["mission"]["flown_share"] == 1.0  # it is no drone that flies


def test_a_station_is_scored_only_where_that_is_set_and_sees_from_where_it_stands_if_it_has_cameras() -> None:
    seeing = (*SHORT, "perception.detector=surrogate")
    left_out, scored, sees = (
        run_sortie(example(*seeing, f"fleet.ground=[{{drone: 2, position_m: [0, 0, 40], {more}}}]"))
        for more in ("scored: false", "scored: true", "camera: true")
    )
    assert {r["drone"] for table in ("fusions", "truths") for r in rows(left_out, table)} == {0, 1}
    assert {r["drone"] for r in rows(scored, "fusions")} == {0, 1, 2}
    assert [r for r in rows(scored, "fusions") if r["drone"] != 2] == rows(left_out, "fusions")
    assert any(any(r["coverage_grid"]) for r in rows(sees, "descriptors", drone=2))
    assert rows(sees, "transmissions", drone=2)


def test_telemetry_and_report_call_a_station_one() -> None:
    record = recorded("relay")
    kinds = {
        drone: message.type
        for _, drone, message in Stream(record.scenario, ORIGIN).add(record.tables)
        if message.get_type() == "HEARTBEAT"
    }
    assert kinds == {**dict.fromkeys(range(4), mavlink2.MAV_TYPE_QUADROTOR), 4: mavlink2.MAV_TYPE_GCS}
    html = page(record)
    assert "<tr><td>station 4</td><td>mains</td><td></td><td></td><td>–</td><td>–</td><td>on</td></tr>" in html
    assert "<tr><td>drone 3</td>" in html


def test_what_a_station_cannot_do_is_refused() -> None:
    leaves = "events=[{kind: drone_leaves, at_s: 1, drone: 2}]"
    reserve = "mission.groups=[{drones: [1, 2], phases: [{}], reserve: [1]}]"
    flies = "must be a drone that flies"
    for station, what, words in (
        (STATION, leaves, f"events.0.drone: 2, {flies}, it is a ground station on mains power"),
        (BATTERY, leaves, f"events.0.drone: 2, {flies}, it is a ground station"),
        (STATION, reserve, f"mission.groups.0.drones.1: 2, {flies} where there is a reserve, it is a ground station"),
    ):
        with pytest.raises(SortieError) as refused:
            example("fleet.drones=3", station, what)
        assert words in str(refused.value)
