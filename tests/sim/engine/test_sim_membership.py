"""Drones that join late, go home, come back, and reserves that take over."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sim_examples import example

from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

HERE = "fleet.formation.altitude_m=30"


def flown(*overrides: str) -> SortieRecord:
    return run_sortie(example(HERE, *overrides))


def airborne(record: SortieRecord, drone: int) -> list[tuple[float, bool]]:
    """When it begins to fly, or stops."""
    rows = [r for r in record.tables["states"].to_pylist() if r["drone"] == drone]
    changes = [rows[0]] + [b for a, b in pairwise(rows) if a["airborne"] != b["airborne"]]
    return [(round(r["t_s"], 6), r["airborne"]) for r in changes]


def rows(record: SortieRecord, table: str, **where: Any) -> list[dict[str, Any]]:
    return [r for r in record.tables[table].to_pylist() if all(r[k] == v for k, v in where.items())]


def test_a_drone_that_joins_late_is_on_the_ground_until_then() -> None:
    record = flown("events=[{kind: drone_joins, at_s: 2, drone: 3}]")
    assert airborne(record, 3) == [(0.0, False), (2.0, True)]
    assert min(r["t_s"] for r in rows(record, "descriptors", drone=3)) == pytest.approx(2.0, abs=0.02)
    spent = [r["spent_j"] for r in rows(record, "states", drone=3)]
    assert spent[19] == 0.0
    assert spent[-1] > 100
    assert outcome(record)["mission"]["flown_share"] == pytest.approx(
        1 - 2 / (5 * record.scenario.duration_s), abs=1e-6
    )
    heard = [r for r in rows(record, "directives", peer=3) if r["representation"] != "nothing"]
    assert heard
    assert min(r["t_s"] for r in heard) > 2.0
    assert [r["text"] for r in rows(record, "events", drone=3)] == ["takes off"]


def test_the_others_fly_as_if_a_drone_that_never_joins_were_not_there() -> None:
    """Before it joins it takes no airtime and no energy; the links of the others are decided without it."""
    late = flown("events=[{kind: drone_joins, at_s: 5.5, drone: 4}]")
    links = {(r["drone"], r["peer"]) for r in rows(late, "directives") if r["t_s"] < 5.4}
    assert links
    assert not any(4 in link for link in links)


def test_a_drone_that_goes_home_publishes_landing_and_descends() -> None:
    record = flown("events=[{kind: drone_leaves, at_s: 1, drone: 2}]", "mission.descent_mps=10")
    phases = [r["phase"] for r in rows(record, "descriptors", drone=2) if r["t_s"] > 1.05]
    assert set(phases) == {"landing"}
    states = rows(record, "states", drone=2)
    height = np.array([r["z_m"] for r in states])
    assert height[10] == pytest.approx(30, abs=2)
    assert np.diff(height[10:38]).mean() == pytest.approx(-1.0, abs=0.1)
    (_, _), (down_s, still) = airborne(record, 2)
    assert not still
    assert down_s == pytest.approx(4.0, abs=0.3)
    assert [r["kind"] for r in rows(record, "events", drone=2)] == ["drone_leaves", "landed"]


def test_a_lost_drone_comes_back_and_is_heard_and_served_again() -> None:
    record = flown("events=[{kind: drone_lost, at_s: 1, drone: 1}, {kind: drone_joins, at_s: 4, drone: 1}]")
    assert airborne(record, 1) == [(0.0, True), (1.0, False), (4.0, True)]
    assert not rows(record, "drops")
    sent = [r["t_sent_s"] for r in rows(record, "transmissions", drone=1)]
    assert not [t for t in sent if 1.2 < t < 4.0]
    assert [t for t in sent if t > 4.5]
    scored = [r["t_s"] for r in rows(record, "fusions", drone=1)]
    assert not [t for t in scored if 1.2 < t < 4.0]


def test_a_reserve_takes_over_when_a_battery_goes_home() -> None:
    record = flown(
        "duration_s=8",
        "mission.groups=[{drones: [0, 1, 2, 3, 4], reserve: [4], phases: [{phase: track, region: {radius_m: 30}}]}]",
        "mission.handover_soc=0.5",
        "mission.descent_mps=10",
        "fleet.overrides=[{drone: 1, initial_soc: 0.504}]",
    )
    assert [now for _, now in airborne(record, 4)] == [False, True]
    leaves = rows(record, "events", drone=1, kind="drone_leaves")[0]["t_s"]
    joins = rows(record, "events", drone=4, kind="drone_joins")[0]
    assert joins["t_s"] == leaves > 0
    assert joins["text"] == "takes over from drone 1"
    assert {r["phase"] for r in rows(record, "descriptors", drone=4)} == {"track"}
    assert {r["phase"] for r in rows(record, "descriptors", drone=1) if r["t_s"] > leaves + 0.1} == {"landing"}


def test_a_reserve_takes_over_from_a_lost_drone_once() -> None:
    record = flown(
        "mission.groups=[{drones: [1, 3, 4], reserve: [3, 4], phases: [{phase: search}]}]",
        "events=[{kind: drone_lost, at_s: 1, drone: 1}]",
    )
    assert [r["drone"] for r in rows(record, "events", kind="drone_joins")] == [3]
    assert airborne(record, 4) == [(0.0, False)]


def test_a_reserve_that_an_event_sent_up_takes_over_from_nobody_and_is_replaced_as_others_are() -> None:
    """Drone 2 flies already when drone 0 is lost, so 3 takes over; 2 goes home at its charge as any other."""
    record = flown(
        "mission.groups=[{drones: [0, 1, 2, 3], reserve: [2, 3], phases: [{phase: search}]}]",
        "events=[{kind: drone_joins, at_s: 1, drone: 2}, {kind: drone_lost, at_s: 2, drone: 0}]",
        "fleet.overrides=[{drone: 2, initial_soc: 0.5005}]",
        "mission.handover_soc=0.5",
    )
    joined = rows(record, "events", kind="drone_joins")
    assert [(r["t_s"], r["drone"], r["text"]) for r in joined] == [
        (1.0, 2, "takes off"),
        (2.0, 3, "takes over from drone 0"),
    ]
    assert [r["drone"] for r in rows(record, "events", kind="drone_leaves")] == [2]


def test_an_empty_drone_stays_down() -> None:
    record = flown("events=[{kind: drone_joins, at_s: 2, drone: 3}]", "fleet.overrides=[{drone: 3, initial_soc: 0.05}]")
    assert airborne(record, 3) == [(0.0, False)]
    assert [r["kind"] for r in rows(record, "events", drone=3)] == ["stays_down"]


def test_it_is_the_same_record_again() -> None:
    events = "events=[{kind: drone_leaves, at_s: 1, drone: 2}, {kind: drone_joins, at_s: 3, drone: 3}]"
    assert flown(events).fingerprint == flown(events).fingerprint


def test_a_drone_that_came_home_flies_at_the_formations_height_when_it_joins_again() -> None:
    leaves, joins = ("{{kind: drone_{}, at_s: {}, drone: 2}}".format(*e) for e in (("leaves", 1), ("joins", 5)))
    record, stayed = flown(f"events=[{leaves}, {joins}]", "mission.descent_mps=10"), flown()
    height_m, level_m = ([r["z_m"] for r in rows(each, "states", drone=2)] for each in (record, stayed))
    assert max(height_m[42:50]) < 1.0
    assert height_m[50:] == level_m[50:]
    assert {r["phase"] for r in rows(record, "descriptors", drone=2) if r["t_s"] > 5.0} == {"track"}


def test_a_descent_that_was_cut_short_does_not_end_a_later_one() -> None:
    events = [("leaves", 0.5), ("lost", 1), ("joins", 2), ("leaves", 2.5)]
    text = ", ".join(f"{{kind: drone_{kind}, at_s: {at_s}, drone: 2}}" for kind, at_s in events)
    record = flown(f"events=[{text}]", "mission.descent_mps=10")
    assert rows(record, "events", drone=2, kind="landed")[0]["t_s"] == pytest.approx(5.5, abs=0.3)


def test_a_recorded_drone_descends_to_the_ground_and_takes_off_with_its_recorded_charge(tmp_path: Path) -> None:
    """Its trace climbs 3 m/s and says nothing about going home."""
    lines = [f"{k},2,{5 * k},5,{30 + 3 * k},{0.9 - 0.02 * k}" for k in range(11)]
    (tmp_path / "flight.csv").write_text("\n".join(["t_s,drone,x_m,y_m,z_m,soc", *lines]))
    trace = f"fleet.trace={tmp_path / 'flight.csv'}"
    home = flown("events=[{kind: drone_leaves, at_s: 1, drone: 2}]", "mission.descent_mps=10", trace)
    assert rows(home, "states", drone=2)[-1]["z_m"] <= 1.0
    late = rows(flown("events=[{kind: drone_joins, at_s: 3, drone: 2}]", trace), "states", drone=2)
    current_a = [r["current_a"] for r in late if r["airborne"]]
    assert max(current_a[1:]) < 1.1 * min(current_a[1:])


def test_a_drone_that_descends_keeps_its_slot_and_its_rate_of_descent() -> None:
    """Its policy would rather look from elsewhere; moves that were granted before go on, level ones only."""
    record = flown(
        "policy={name: vantage}",
        "mission.target.waypoints_m=[[-60, 60], [200, 60]]",
        "mission.phases=[{phase: track, region: {radius_m: 32}}]",
        "events=[{kind: drone_leaves, at_s: 1, drone: 2}, {kind: drone_joins, at_s: 2, drone: 3}]",
    )
    states = [r for r in rows(record, "states", drone=2) if r["t_s"] > 1.2]
    assert rows(record, "events", kind="viewpoint", drone=3), "the fleet's flight is computed again during the descent"
    assert {r["vz_mps"] for r in states} == {-3.0}


def test_nobody_takes_over_from_a_drone_that_is_yet_to_join() -> None:
    record = flown(
        "mission.groups=[{drones: [1, 3, 4], reserve: [4], phases: [{phase: search}]}]",
        "events=[{kind: drone_joins, at_s: 2, drone: 3}, {kind: drone_lost, at_s: 4, drone: 3}]",
    )
    joined = rows(record, "events", kind="drone_joins")
    assert [(r["t_s"], r["drone"], r["text"]) for r in joined] == [
        (2.0, 3, "takes off"),
        (4.0, 4, "takes over from drone 3"),
    ]


def test_a_drone_that_came_back_is_not_scored_where_it_was_lost() -> None:
    events = "events=[{kind: drone_lost, at_s: 1, drone: 1}, {kind: drone_joins, at_s: 3.07, drone: 1}]"
    record = flown(events, "perception={detector: surrogate, sample_rate_hz: 10}")
    scored = [r["t_s"] for r in rows(record, "fusions", drone=1)]
    assert min(t for t in scored if t > 2.0) == pytest.approx(3.2, abs=0.02)
