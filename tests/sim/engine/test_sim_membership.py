"""Drones that join late, go home, are lost, come back, and reserves that take over."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pytest
from recorded import recorded
from sim_examples import PATIENT, example

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord

HERE = ("fleet.formation.altitude_m=30", "mission.descent_mps=10")


def flown(*overrides: str, policy: Any = "silence") -> SortieRecord:
    """A flight of its own: what one drone does after the other is not in the recorded flight."""
    return run_sortie(example(*HERE, *overrides), policy)


def airborne(record: SortieRecord, drone: int) -> list[tuple[float, bool]]:
    """When it begins to fly, or stops."""
    rows = [r for r in record.tables["states"].to_pylist() if r["drone"] == drone]
    changes = [rows[0]] + [b for a, b in pairwise(rows) if a["airborne"] != b["airborne"]]
    return [(round(r["t_s"], 6), r["airborne"]) for r in changes]


def rows(record: SortieRecord, table: str, **where: Any) -> list[dict[str, Any]]:
    return [r for r in record.tables[table].to_pylist() if all(r[k] == v for k, v in where.items())]


def times(record: SortieRecord, table: str, drone: int, when: str = "t_s") -> np.ndarray:
    return np.array([r[when] for r in rows(record, table, drone=drone)])


def joined(record: SortieRecord) -> list[tuple[float, int, str]]:
    return [(round(r["t_s"], 1), r["drone"], r["text"]) for r in rows(record, "events", kind="drone_joins")]


# --- the recorded fleet: 3 joins at 2 s, 2 goes home at 1 s, 1 is away from 1 s to 4 s ------------


def test_a_drone_that_joins_late_is_on_the_ground_until_then() -> None:
    record = recorded("members")
    assert airborne(record, 3) == [(0.0, False), (2.0, True)]
    for table, when in (("descriptors", "t_s"), ("transmissions", "captured_s"), ("ages", "t_s")):
        assert times(record, table, 3, when).min() >= 2.0 - 1e-6, table
    spent = times(record, "states", 3, "spent_j")
    assert spent[19] == 0.0
    assert spent[-1] > 100
    links = {(r["drone"], r["peer"]) for r in rows(record, "directives") if r["t_s"] < 2.0}
    assert links
    assert not any(3 in link for link in links), "the others fly as if it were not there"
    heard = [r["t_s"] for r in rows(record, "directives", peer=3) if r["representation"] != "nothing"]
    assert min(heard) > 2.0
    down_s = airborne(record, 2)[1][0]
    flown_s = 5 * 6 - (2 + 3 + 6 - down_s)
    assert outcome(record)["mission"]["flown_share"] == pytest.approx(flown_s / 30, abs=1e-6)


def test_a_drone_that_goes_home_publishes_landing_and_descends() -> None:
    record = recorded("members")
    phases = {r["phase"] for r in rows(record, "descriptors", drone=2) if r["t_s"] > 1.05}
    assert phases == {"landing"}
    height_m = times(record, "states", 2, "z_m")
    assert height_m[10] == pytest.approx(30, abs=2)
    assert np.diff(height_m[10:38]).mean() == pytest.approx(-1.0, abs=0.1)
    (_, _), (down_s, still) = airborne(record, 2)
    assert not still
    assert down_s == pytest.approx(4.0, abs=0.3)
    assert [r["kind"] for r in rows(record, "events", drone=2)] == ["drone_leaves", "landed"]


def test_a_lost_drone_comes_back_and_is_heard_and_served_again() -> None:
    record = recorded("members")
    assert airborne(record, 1) == [(0.0, True), (1.0, False), (4.0, True)]
    assert not rows(record, "drops")
    for table, when in (("descriptors", "t_s"), ("transmissions", "t_sent_s"), ("ages", "t_s")):
        t_s = times(record, table, 1, when)
        assert not ((t_s > 1.0) & (t_s < 4.0)).any(), table
        assert (t_s > 4.5).any(), table
    assert [r for r in rows(record, "transmissions", peer=1, status="delivered") if r["t_sent_s"] > 4.5]


# --- drones that are gone ------------------------------------------------------------------------


def test_a_drone_that_is_gone_does_nothing_gets_nothing_spends_nothing_and_stays() -> None:
    """In one flight drone 1 is lost, 2 is empty, 3 loses its only cell, and 4 goes home.

    Also what it had looked at and was about to send: it is gone between its look and its sending.
    """

    def to_all(view: FleetView) -> list[Directive]:
        return [Directive(view.ego, p, Representation.FEATURES, 0.02, None, 10.0, reason="all") for p in view.peers]

    events = (
        "{kind: drone_lost, at_s: 2.02, drone: 1}",
        "{kind: battery_fault, at_s: 2.02, drone: 2, lost_fraction: 1}",
        "{kind: cell_failure, at_s: 2.02, drone: 3}",
        "{kind: drone_leaves, at_s: 1.02, drone: 4}",
    )
    record = flown(
        "duration_s=4",
        "fleet.drones=6",
        "fleet.formation={altitude_m: 10, spacing_m: 25}",
        "perception.compute_delay_s=0.04",
        "fleet.makes=[{name: one, drones: [3], battery: {cells: 1, cell_resistance_mohm: 0}}]",
        f"events=[{', '.join(events)}]",
        "mission.phases=[{}]",
        "policy.dwell_s=0",
        *PATIENT,
        policy=to_all,
    )
    gone_s = {1: 2.02, 2: 2.02, 3: 2.02, 4: airborne(record, 4)[1][0] - 1e-6}
    for drone, at_s in gone_s.items():
        for table, when in (
            ("descriptors", "t_s"),
            ("transmissions", "t_sent_s"),
            ("directives", "t_s"),
            ("ages", "t_s"),
        ):
            t_s = times(record, table, drone, when)
            assert (t_s < at_s).any(), table
            assert not (t_s > at_s).any(), (table, drone)
        to_it = [r for r in rows(record, "transmissions", peer=drone) if r["t_sent_s"] > at_s]
        assert to_it
        assert {r["reason"] for r in to_it} <= {"receiver_gone", "replaced", "deadline_queued", ""}
        assert "delivered" not in {r["status"] for r in to_it}
        after = [r for r in rows(record, "states", drone=drone) if r["t_s"] > at_s + 0.1]
        assert len(after) > 10
        for column in ("spent_j", "x_m", "y_m", "looks"):
            assert len({r[column] for r in after}) == 1, column
        for column in ("current_a", "vx_mps", "vy_mps", "vz_mps", "p_radps", "r_radps"):
            assert {r[column] for r in after} == {0.0}, column
    late = record.tables["receptions"].filter(
        pc.greater(record.tables["receptions"]["t_s"], max(gone_s.values()) + 0.1)
    )
    assert max(late["heard"].to_pylist()) <= 2, "two that publish to each other"


def test_who_limits_a_fleet_or_is_cut_off_is_named_by_its_number_where_some_are_gone(tmp_path: Path) -> None:
    """Drone 1 is gone. The best of slow drone 2's links is that to drone 3; then drone 3 is cut off."""
    links = [
        f"{t_s},{i},{j},{0 if t_s == 2.5 and 3 in (i, j) else 5 + (i + j) / 10 if 2 in (i, j) else 60}"
        for t_s in (0, 2.4, 2.5)
        for i in range(4)
        for j in range(4)
        if i != j
    ]
    file = tmp_path / "links.csv"
    file.write_text("\n".join(["t_s,sender,receiver,goodput_mbps", *links]) + "\n")
    lost = "events=[{kind: drone_lost, at_s: 0.5, drone: 1}]"
    record = flown("fleet.drones=4", "duration_s=5", "radio.relay_max_hops=2", f"radio.trace={file}", lost)
    found = {round(row["t_s"]): row for row in record.tables["topology"].to_pylist()}
    for t_s in (1, 2):
        assert {found[t_s]["bottleneck_sender"], found[t_s]["bottleneck_receiver"]} == {2, 3}
        assert found[t_s]["bottleneck_mbps"] == pytest.approx(5.5)
        assert (found[t_s]["connected"], found[t_s]["cut_drones"]) == (True, [])
    assert (found[4]["connected"], found[4]["cut_drones"]) == (False, [3])


# --- reserves ------------------------------------------------------------------------------------


def test_a_reserve_takes_over_when_a_battery_goes_home() -> None:
    record = flown(
        "duration_s=8",
        "mission.groups=[{drones: [0, 1, 2, 3, 4], reserve: [4], phases: [{phase: track, region: {radius_m: 30}}]}]",
        "mission.handover_soc=0.5",
        "fleet.overrides=[{drone: 1, initial_soc: 0.504}]",
    )
    assert [now for _, now in airborne(record, 4)] == [False, True]
    leaves_s = rows(record, "events", drone=1, kind="drone_leaves")[0]["t_s"]
    assert joined(record) == [(round(leaves_s, 1), 4, "takes over from drone 1")]
    assert leaves_s > 0
    assert {r["phase"] for r in rows(record, "descriptors", drone=4)} == {"track"}
    assert {r["phase"] for r in rows(record, "descriptors", drone=1) if r["t_s"] > leaves_s + 0.1} == {"landing"}


LOST_TWICE = (
    "{kind: drone_lost, at_s: 0.5, drone: 1}, {kind: drone_joins, at_s: 1, drone: 1},"
    "{kind: drone_lost, at_s: 1.5, drone: 1}"
)
SENT_UP = "{kind: drone_joins, at_s: 0.5, drone: 2}, {kind: drone_lost, at_s: 1, drone: 0}"
JOINS_LATE = "{kind: drone_joins, at_s: 0.5, drone: 3}, {kind: drone_lost, at_s: 1.5, drone: 3}"
TAKES_OVER: dict[str, tuple[str, str, str, list[tuple[float, int, str]]]] = {
    "once from a lost drone, and again when it came back": (
        "[1, 3, 4]",
        "[3, 4]",
        LOST_TWICE,
        [(0.5, 3, "takes over from drone 1"), (1.0, 1, "takes off"), (1.5, 4, "takes over from drone 1")],
    ),
    "not where an event sent it up before": (
        "[0, 1, 2, 3]",
        "[2, 3]",
        SENT_UP,
        [(0.5, 2, "takes off"), (1.0, 3, "takes over from drone 0")],
    ),
    "not from a drone that is yet to join": (
        "[1, 3, 4]",
        "[4]",
        JOINS_LATE,
        [(0.5, 3, "takes off"), (1.5, 4, "takes over from drone 3")],
    ),
}
"""A reserve takes over: the group's drones, its reserve, the events, and who takes off when."""


def test_a_reserve_takes_over_from_who_is_lost_and_from_nobody_else() -> None:
    wrong = {}
    for name, (drones, reserve, events, wanted) in TAKES_OVER.items():
        group = f"mission.groups=[{{drones: {drones}, reserve: {reserve}, phases: [{{phase: search}}]}}]"
        got = joined(flown("duration_s=2", group, f"events=[{events}]"))
        if got != wanted:
            wrong[name] = got
    assert wrong == {}


# --- descents ------------------------------------------------------------------------------------


def test_an_empty_drone_stays_down() -> None:
    joins = "events=[{kind: drone_joins, at_s: 1, drone: 1}]"
    record = flown(joins, "fleet.overrides=[{drone: 1, initial_soc: 0.05}]", "fleet.drones=2", "duration_s=2")
    assert airborne(record, 1) == [(0.0, False)]
    assert [r["kind"] for r in rows(record, "events", drone=1)] == ["stays_down"]


def test_a_drone_that_came_home_flies_at_the_formation_s_height_and_a_cut_descent_does_not_end_a_later_one() -> None:
    again = [("leaves", 1, 1), ("joins", 5, 1), ("leaves", 0.5, 0), ("lost", 1, 0), ("joins", 2, 0), ("leaves", 2.5, 0)]
    events = ", ".join(f"{{kind: drone_{kind}, at_s: {at_s}, drone: {drone}}}" for kind, at_s, drone in again)
    record, stayed = flown(f"events=[{events}]", "fleet.drones=2"), flown("fleet.drones=2")
    height_m, level_m = (times(each, "states", 1, "z_m") for each in (record, stayed))
    assert max(height_m[42:50]) < 1.0
    assert (height_m[50:] == level_m[50:]).all()
    assert {r["phase"] for r in rows(record, "descriptors", drone=1) if r["t_s"] > 5.0} == {"track"}
    assert rows(record, "events", drone=0, kind="landed")[0]["t_s"] == pytest.approx(5.5, abs=0.3)


def test_a_recorded_drone_descends_to_the_ground_and_takes_off_with_its_recorded_charge(tmp_path: Path) -> None:
    """Its trace climbs 3 m/s and has nothing about going home."""
    lines = [f"{k},1,{5 * k},5,{30 + 3 * k},{0.9 - 0.02 * k}" for k in range(11)]
    (tmp_path / "flight.csv").write_text("\n".join(["t_s,drone,x_m,y_m,z_m,soc", *lines]))
    trace = ("fleet.drones=2", f"fleet.trace={tmp_path / 'flight.csv'}")
    home = flown("events=[{kind: drone_leaves, at_s: 1, drone: 1}]", *trace)
    assert rows(home, "states", drone=1)[-1]["z_m"] <= 1.0
    late = rows(flown("events=[{kind: drone_joins, at_s: 3, drone: 1}]", *trace), "states", drone=1)
    current_a = [r["current_a"] for r in late if r["airborne"]]
    assert max(current_a[1:]) < 1.1 * min(current_a[1:])


def test_a_drone_that_descends_keeps_its_slot_and_its_rate_of_descent() -> None:
    """Its policy would rather look from elsewhere; moves that were granted before go on, level ones only."""
    record = flown(
        "mission={descent_mps: 3, target: {waypoints_m: [[-60, 60], [200, 60]]}}",
        "mission.phases=[{phase: track, region: {radius_m: 32}}]",
        "events=[{kind: drone_leaves, at_s: 1, drone: 2}, {kind: drone_joins, at_s: 2, drone: 3}]",
        policy="vantage",
    )
    states = [r for r in rows(record, "states", drone=2) if r["t_s"] > 1.2]
    assert rows(record, "events", kind="viewpoint", drone=3), "the fleet's flight is computed again during the descent"
    assert {r["vz_mps"] for r in states} == {-3.0}
