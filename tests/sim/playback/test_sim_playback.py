"""Playback: what a recording holds is what the record says."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from played_flight import Rows, drawn, flown, series, with_tables
from rerun.chunk import RrdReader
from sim_examples import example

from sortie.sim.playback.event_lane import NOTHING
from sortie.sim.playback.recording import save_rrd, scene_of
from sortie.sim.results.accuracy import matched
from sortie.sim.results.outcome import outcome
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.sentences import decision_in_words


@pytest.fixture(scope="module")
def record() -> SortieRecord:
    return flown()


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> Rows:
    return drawn(flown(), tmp_path_factory.mktemp("rrd"))


def test_there_is_one_recording_with_its_layout(record: SortieRecord, tmp_path: Path) -> None:
    save_rrd(record, tmp_path / "a.rrd")
    reader = RrdReader(tmp_path / "a.rrd")
    assert [e.application_id for e in reader.recordings()] == ["sortie"]
    layout = reader.blueprints()
    assert len(layout) == 1
    batches = [k.to_record_batch() for k in reader.stream(store=layout[0]).to_chunks()]

    def column(name: str) -> list[Any]:
        return sorted(v for b in batches if name in b.schema.names for (v,) in b[name].to_pylist())

    views = ["2D", "2D", "3D", "StateTimeline", "TextDocument", "TextLog", *["TimeSeries"] * 9]
    assert column("ViewBlueprint:class_identifier") == views
    assert column("TimePanelBlueprint:timeline") == ["sim_time"]


SHOWN = """
/about /links/heard /links/numbers /lanes/events /lanes/phase /log/decisions /log/events /plots/age/p99_ms /plots/ap/full_scene /plots/ap/mission
/plots/lost/percent /plots/medium/busy_percent /plots/traffic/features_delivered /world/cars/moving /world/cars/parked
/world/fleet /world/links /world/mission /world/mission/disc /world/target /world/broken /world/town/buildings
/world/town/ground /world/town/trees
"""


def test_every_entity_that_the_layout_shows_is_there(rows: Rows) -> None:
    each = [
        "world/drones",
        "world/footprints",
        "world/trails",
        "plots/battery",
        "plots/energy",
        "plots/goodput",
        "plots/ap_of",
    ]
    expected = {f"/{folder}/{i}" for folder in each for i in range(5)}
    expected |= {f"/world/seen/{i}/{kind}" for i in range(5) for kind in ("found", "missed", "false")}
    expected |= {f"/lanes/drone_{i}" for i in range(5)}
    assert expected | set(SHOWN.split()) <= set(rows)


def test_drones_are_where_the_record_has_them_on_both_timelines(rows: Rows, record: SortieRecord) -> None:
    states = [s for s in record.tables["states"].to_pylist() if s["drone"] == 1]
    drawn = rows["/world/drones/1"]["Transform3D:translation"]
    assert len(drawn) == len(states) == record.scenario.frames
    for frame, (state, (t_s, drawn_frame, place)) in enumerate(zip(states, drawn, strict=True)):
        assert (t_s, drawn_frame) == (pytest.approx(state["t_s"], abs=1e-9), frame)
        assert place[0] == pytest.approx([state["x_m"], state["y_m"], state["z_m"]], rel=1e-6)
    turned = rows["/world/drones/1"]["Transform3D:quaternion"][33][2][0]
    assert turned == pytest.approx([states[33][q] for q in ("qx", "qy", "qz", "qw")], abs=1e-6)


def test_a_footprint_is_what_70_degrees_see(rows: Rows, record: SortieRecord) -> None:
    state = record.tables["states"].filter(pc.equal(record.tables["states"]["drone"], 0)).to_pylist()[20]
    assert rows["/world/footprints/0"]["Transform3D:scale"][20][2][0][0] == pytest.approx(
        state["z_m"] * math.tan(math.radians(35)), rel=1e-6
    )
    assert rows["/world/footprints/0"]["Transform3D:translation"][20][2][0][:2] == pytest.approx(
        [state["x_m"], state["y_m"]], rel=1e-6
    )


def test_a_lost_drone_lies_where_it_fell_and_sees_nothing(rows: Rows, record: SortieRecord) -> None:
    states = [s for s in record.tables["states"].to_pylist() if s["drone"] == 3]
    last = max(k for k, s in enumerate(states) if s["airborne"])
    fallen = [place[0] for _, _, place in rows["/world/drones/3"]["Transform3D:translation"]][last + 1 :]
    assert len(fallen) == len(states) - last - 1 > 0
    for place in fallen:
        assert place == pytest.approx([states[last]["x_m"], states[last]["y_m"], 0.3], rel=1e-6)
    level = [turn[0] for _, _, turn in rows["/world/drones/3"]["Transform3D:quaternion"]][last + 1 :]
    assert set(map(tuple, level)) == {(0.0, 0.0, 0.0, 1.0)}
    t_s, _, boxes = rows["/world/seen/3/found"]["Boxes3D:centers"][-1]
    assert (t_s, boxes) == (states[last + 1]["t_s"], [])
    assert rows["/world/drones/3/name"]["Points3D:labels"][-1][2] == ["3 · down"]


def test_events_and_phase_changes_are_marked_on_the_plots_and_in_the_log(rows: Rows, record: SortieRecord) -> None:
    for plot in ("ap", "battery", "goodput", "traffic", "age", "lost", "medium"):
        assert series(rows, f"/plots/{plot}/marks/event") == [(4.0, 0.0), (6.0, 0.0)]
        assert series(rows, f"/plots/{plot}/marks/phase") == [(3.0, 0.0)]
    happened = [(4.0, ["drone 2: links of 2 lose 60 dB"]), (6.0, ["drone 3: fell silent"])]
    assert [(t_s, v) for t_s, _, v in rows["/lanes/events"]["StateChange:state"]] == [*happened, (8.0, [NOTHING])]
    assert [(t_s, v) for t_s, _, v in rows["/log/events"]["TextLog:text"]] == happened
    assert [v for _, _, v in rows["/log/events"]["TextLog:level"]] == [["WARN"]] * 2


def test_the_disc_and_the_target_follow_the_mission(rows: Rows, record: SortieRecord) -> None:
    mission = record.tables["mission"].to_pylist()
    there = [m for m in mission if not math.isnan(m["region_radius_m"])]
    assert [(t_s, len(v)) for t_s, _, v in rows["/world/mission/disc"]["LineStrips3D:strips"]] == [(3.0, 10)]
    drawn = rows["/world/mission"]["Transform3D:translation"]
    assert [v[0][:2] for _, _, v in drawn] == [
        pytest.approx([m["region_x_m"], m["region_y_m"]], rel=1e-6) for m in there
    ]
    assert {v[0][0] for _, _, v in rows["/world/mission"]["Transform3D:scale"]} == {32.0}
    assert [v[0][:2] for _, _, v in rows["/world/target"]["Transform3D:translation"]] == [
        pytest.approx([m["target_x_m"], m["target_y_m"]], rel=1e-6, abs=1e-6) for m in mission
    ]
    assert [(t_s, v) for t_s, _, v in rows["/lanes/phase"]["StateChange:state"]] == [
        (0.0, ["search"]),
        (3.0, ["track"]),
        (8.0, [NOTHING]),
    ]


def test_every_car_in_range_is_found_or_missed_and_every_box_is_a_car_or_false(
    rows: Rows, record: SortieRecord
) -> None:
    judged = matched(record, mission=False)
    counts = {
        kind: {
            (round(t_s, 6), i): len(v)
            for i in range(5)
            for t_s, _, v in rows[f"/world/seen/{i}/{kind}"]["Boxes3D:centers"]
        }
        for kind in ("found", "missed", "false")
    }
    fusions = record.tables["fusions"].to_pylist()
    assert len(fusions) > 70
    for fusion in fusions:
        key = (round(fusion["t_s"], 6), fusion["drone"])
        assert counts["found"][key] + counts["missed"][key] == fusion["truths"]
        assert counts["found"][key] + counts["false"][key] == fusion["detections"]
        assert counts["found"][key] == judged[fusion["t_s"], fusion["drone"]].hit.sum()
    assert sum(counts["missed"].values()) > 0
    # a missed car is drawn in full yellow, a false alarm's red is as dark as its score is low
    assert {x for _, _, v in rows["/world/seen/0/missed"]["Boxes3D:colors"] for x in v} == {0xFFC828FF}
    reds = {x >> 24 for _, _, v in rows["/world/seen/0/false"]["Boxes3D:colors"] for x in v}
    assert 0.25 * 255 < min(reds) < max(reds) < 0.75 * 255


def test_a_drone_that_waits_for_its_turn_shows_no_boxes(record: SortieRecord, tmp_path: Path) -> None:
    """At each scored moment two of three wait, and their boxes are of an earlier time."""
    perception = record.scenario.perception.model_copy(update={"egos": 1})
    scenario = record.scenario.model_copy(update={"perception": perception})
    turn = {t_s: k % 3 for k, t_s in enumerate(sorted(set(record.tables["fusions"]["t_s"].to_pylist())))}

    def in_turn(name: str) -> pa.Table:
        table = record.tables[name]
        rows = zip(table["t_s"].to_pylist(), table["drone"].to_pylist(), strict=True)
        return table.filter(pa.array([turn[t_s] == drone for t_s, drone in rows]))

    tables = {name: in_turn(name) for name in ("fusions", "truths", "detections")}
    turns = drawn(dataclasses.replace(with_tables(record, **tables), scenario=scenario), tmp_path)
    for drone in range(3):
        shown = {round(t_s, 6): v for t_s, _, v in turns[f"/world/seen/{drone}/found"]["Boxes3D:centers"]}
        last: list[Any] = []
        for t_s, scored in turn.items():
            last = shown.get(round(t_s, 6), last)
            assert bool(last) == (scored == drone), (drone, t_s)


def test_moving_cars_are_the_scene_s(rows: Rows, record: SortieRecord) -> None:
    scene, frame = scene_of(record), 41
    place = record.tables["states"].slice(frame * 5, 5)
    # drone 3 is still up, so the middle of the fleet is that of the record
    x, y = (float(np.mean(place[k].to_numpy())) for k in ("x_m", "y_m"))
    cars = scene.moving_cars(frame / 10.0)
    near = cars.where(np.hypot(cars.x_m - x, cars.y_m - y) <= 160.0)
    drawn = rows["/world/cars/moving"]["Boxes3D:centers"][frame][2]
    assert len(drawn) == len(near) > 5
    assert [d[:2] for d in drawn] == [
        pytest.approx(p, rel=1e-6, abs=1e-5) for p in zip(near.x_m, near.y_m, strict=True)
    ]
    assert len(rows["/world/cars/parked"]["Boxes3D:centers"][0][2]) == len(scene.parked_cars)


# --- the log ----------------------------------------------------------------------------------------------


def test_the_log_has_one_line_a_transition_in_words(rows: Rows, record: SortieRecord) -> None:
    expected = outcome(record)["transitions"]
    lines = rows["/log/decisions"]["TextLog:text"]
    assert len(lines) == len(expected) > 5
    assert [line for _, _, (line,) in lines] == [decision_in_words(t) for t in expected]
    assert any("drone 2 → 0" in line and "goodput" in line and t_s > 4.0 for t_s, _, (line,) in lines)


def test_a_transition_in_words() -> None:
    change = {"drone": 2, "peers": [1, 4], "to": "detections at 2 Hz", "reason": "goodput 3.1 < 5 Mb/s"}
    assert decision_in_words(change) == "drone 2 → 1, 4: detections at 2 Hz, because goodput 3.1 < 5 Mb/s"
    assert decision_in_words({**change, "peers": [1], "to": "nothing", "reason": ""}) == "drone 2 → 1: nothing"


def test_the_map_has_the_fleet_where_it_flew_with_north_up(rows: Rows, record: SortieRecord) -> None:
    scene, n = scene_of(record), record.scenario.fleet.drones
    x0, _, _, y1 = scene.rect
    states = record.tables["states"].to_pylist()
    drawn = rows["/map/drones"]["Points2D:positions"]
    assert len(drawn) == record.scenario.frames
    for frame in (0, 20, 50):
        expected = [[s["x_m"] - x0, y1 - s["y_m"]] for s in states[n * frame : n * (frame + 1)]]
        assert np.allclose(drawn[frame][2], expected, atol=1e-2)
    rings = {t_s: v for t_s, _, v in rows["/map/mission"]["LineStrips2D:strips"]}
    assert rings[2.5] == []
    region = next(m for m in record.tables["mission"].to_pylist() if m["t_s"] == pytest.approx(5.0))
    (ring,) = rings[5.0]
    assert np.allclose(np.mean(ring[:-1], axis=0), [region["region_x_m"] - x0, y1 - region["region_y_m"]], atol=1e-2)
    assert len(rows["/map/trails"]["LineStrips2D:strips"][-1][2]) == n


def test_a_jammer_is_shown_while_it_is_on(record: SortieRecord, tmp_path: Path) -> None:
    jam = example("duration_s=3", "events=[{kind: jam, at_s: 1, until_s: 2, position_m: [10, 20, 5]}]").events
    jammed = dataclasses.replace(record, scenario=record.scenario.model_copy(update={"events": jam}))
    rows = drawn(jammed, tmp_path)
    shown = [(t_s, v) for t_s, _, v in rows["/world/jammers"]["Points3D:positions"]]
    assert shown == [(1.0, [[10.0, 20.0, 5.0]]), (2.0, [])]
    x0, _, _, y1 = scene_of(record).rect
    assert np.allclose(rows["/map/jammers"]["Points2D:positions"][0][2], [[10 - x0, y1 - 20]], atol=1e-3)
