"""Playback: what a recording holds is what the record says, and drawing live is drawing the same."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
import rerun as rr
from rerun.chunk import RrdReader
from sim_examples import example

from sortie.perception.budget import CELL_M
from sortie.scenarios.link_state import SILENT_MBPS, is_tried
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.folders import RunError
from sortie.sim.playback import recording
from sortie.sim.playback.charts import OVER
from sortie.sim.playback.received import hatch
from sortie.sim.playback.recording import save_rrd, scene_of, spread_m
from sortie.sim.playback.viewer import LiveViewer, open_viewer, to_file, to_new_viewer
from sortie.sim.results.accuracy import accuracy, matched
from sortie.sim.results.link_traffic import LinkTraffic
from sortie.sim.results.outcome import outcome, transitions
from sortie.sim.results.palette import goodput_colours
from sortie.sim.results.record import TABLES, SortieRecord
from sortie.sim.results.sentences import decision_in_words

DURATION_S = 8.0
Rows = dict[str, dict[str, list[tuple[float, int, Any]]]]
"""entity → component → (time s, frame, value), in order of time; static ones at NaN."""


def scenario() -> Scenario:
    """Eight seconds in which a phase changes, a link drops and a drone is lost."""
    return example(
        f"duration_s={DURATION_S}",
        "events=[{kind: link_drop, at_s: 4, drone: 2, loss_db: 60}, {kind: drone_lost, at_s: 6, drone: 3}]",
    )


@pytest.fixture(scope="module")
def record() -> SortieRecord:
    return with_sightings(on_the_second(run_sortie(scenario())))


@pytest.fixture(scope="module")
def saved(record: SortieRecord, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rrd") / "sortie.rrd"
    save_rrd(record, path)
    return path


@pytest.fixture(scope="module")
def rows(saved: Path) -> Rows:
    return read(saved)


def on_the_second(record: SortieRecord) -> SortieRecord:
    """The record with a payload settled, and great ages read, at exactly 5 s, which belong to the second after it."""
    tables = dict(record.tables)
    for name, stamp, rows in (("transmissions", "t_done_s", 1), ("ages", "t_s", 8)):
        t_s = tables[name][stamp].to_numpy().copy()
        first = int(np.flatnonzero(t_s >= 5.0)[0])
        assert t_s[first] < 5.2
        t_s[first : first + rows] = 5.0
        index = tables[name].schema.get_field_index(stamp)
        tables[name] = tables[name].set_column(index, stamp, pa.array(t_s))
        if name == "ages":
            age_s = tables[name]["age_s"].to_numpy().copy()
            age_s[first : first + rows] = 9.0
            tables[name] = tables[name].set_column(2, "age_s", pa.array(age_s))
    return dataclasses.replace(record, tables=tables)


def with_sightings(record: SortieRecord) -> SortieRecord:
    """The record with made-up fusions at 2 Hz: two cars in three are found, and two boxes in ten stand for none."""
    scene, n = scene_of(record), record.scenario.fleet.drones
    states = record.tables["states"].to_pylist()
    rng = np.random.default_rng(0)
    made: dict[str, list[tuple[Any, ...]]] = {"fusions": [], "detections": [], "truths": []}
    for frame in range(0, record.scenario.frames, 5):
        for state in (s for s in states[frame * n : (frame + 1) * n] if s["airborne"]):
            t_s, i = state["t_s"] + 0.095, state["drone"]
            cars = scene.cars_at(t_s)
            cars = cars.where(np.hypot(cars.x_m - state["x_m"], cars.y_m - state["y_m"]) < 70.0)
            boxes = list(zip(cars.x_m, cars.y_m, cars.length_m, cars.width_m, cars.yaw_rad, strict=True))
            found = [(*b, rng.uniform(0.3, 0.9)) for k, b in enumerate(boxes) if k % 3]
            false = [
                (state["x_m"] + 9.0 * k, state["y_m"] + 31.0, 4.5, 1.8, 0.0, rng.uniform(0.1, 0.5)) for k in (0, 1)
            ]
            made["truths"] += [(t_s, i, *b, car) for b, car in zip(boxes, cars.ids.tolist(), strict=True)]
            made["detections"] += [(t_s, i, *b) for b in found + false]
            made["fusions"].append((t_s, i, [], [], [], [], len(found) + len(false), len(boxes)))
    tables = {
        name: pa.table(
            {c: pa.array(v, t) for (c, t), v in zip(TABLES[name].items(), zip(*r, strict=True), strict=True)}
        )
        for name, r in made.items()
    }
    perception = record.scenario.perception.model_copy(update={"detector": "torch"})
    flown = record.scenario.model_copy(update={"perception": perception})
    return dataclasses.replace(record, scenario=flown, tables={**record.tables, **tables})


def read(path: Path) -> Rows:
    """Everything that a recording holds."""
    found: Rows = defaultdict(lambda: defaultdict(list))
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        names = [n for n in batch.schema.names if n not in ("rerun.controls.RowId", "sim_time", "frame")]
        if "sim_time" in batch.schema.names:  # Python's own durations stop at microseconds
            index = batch.schema.get_field_index("sim_time")
            batch = batch.set_column(index, "sim_time", batch["sim_time"].cast(pa.int64()))
        for row in batch.to_pylist():
            t_s = row["sim_time"] / 1e9 if "sim_time" in row else math.nan
            for name in names:
                if row[name] is not None:
                    found[chunk.entity_path][name].append((t_s, row.get("frame", -1), row[name]))
    for components in found.values():
        for values in components.values():
            values.sort(key=lambda v: (v[0], v[1]))
    return found


def series(rows: Rows, path: str) -> list[tuple[float, float]]:
    return [(t_s, value[0]) for t_s, _, value in rows[path]["Scalars:scalars"]]


def slices(record: SortieRecord) -> list[tuple[float, dict[str, pa.Table]]]:
    """The record second by second, cut as rows come in a sortie: what is stamped up to and with the frame at t."""
    stamps = {"transmissions": "t_done_s", "energy": None}
    cut, before = [], -1.0
    for t_s in [float(t) for t in range(math.ceil(DURATION_S))] + [DURATION_S]:
        new = {}
        for name, table in record.tables.items():
            stamp = stamps.get(name, "t_s")
            if stamp is None:
                keep = pa.array([t_s == DURATION_S] * table.num_rows, pa.bool_())
            else:
                late = pc.and_(pc.is_nan(table[stamp]), t_s == DURATION_S)
                keep = pc.or_(pc.and_(pc.greater(table[stamp], before), pc.less_equal(table[stamp], t_s)), late)
            new[name] = table.filter(keep)
        cut.append((t_s, new))
        before = t_s
    return cut


# --- what the recording holds ----------------------------------------------------------------------


def test_there_is_one_recording_with_its_layout(saved: Path) -> None:
    reader = RrdReader(saved)
    assert [e.application_id for e in reader.recordings()] == ["sortie"]
    layout = reader.blueprints()
    assert len(layout) == 1
    chunks = reader.stream(store=layout[0]).to_chunks()

    def column(name: str) -> list[Any]:
        batches = [k.to_record_batch() for k in chunks]
        return sorted(v for b in batches if name in b.schema.names for (v,) in b[name].to_pylist())

    assert column("ViewBlueprint:class_identifier") == [
        "2D", "3D", "StateTimeline", "TextDocument", "TextLog", *["TimeSeries"] * 7,
    ]  # fmt: skip
    assert column("TimePanelBlueprint:timeline") == ["sim_time"]


def test_every_entity_that_the_layout_shows_is_there(rows: Rows, record: SortieRecord) -> None:
    n = record.scenario.fleet.drones
    each = ["world/drones", "world/footprints", "world/trails", "plots/battery", "plots/goodput"]
    expected = {f"/{folder}/{i}" for folder in each for i in range(n)}
    expected |= {f"/world/seen/{i}/{kind}" for i in range(n) for kind in ("found", "missed", "false")}
    expected |= {f"/lanes/drone_{i}" for i in range(n)}
    expected |= {
        "/about", "/lanes/events", "/lanes/phase", "/log/decisions", "/log/events", "/plots/age/p99_ms", "/plots/ap/full_scene",
        "/plots/ap/mission", "/plots/lost/percent", "/plots/medium/busy_percent", "/plots/traffic/features_delivered", "/world/cars/moving",
        "/world/cars/parked", "/world/fleet", "/world/links", "/world/mission", "/world/mission/disc", "/world/target",
        "/world/broken", "/world/town/buildings", "/world/town/ground", "/world/town/trees",
    }  # fmt: skip
    assert expected <= set(rows)


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


def test_batteries_are_the_record_s(rows: Rows, record: SortieRecord) -> None:
    for i in range(record.scenario.fleet.drones):
        states = [s for s in record.tables["states"].to_pylist() if s["drone"] == i]
        assert [v for _, v in series(rows, f"/plots/battery/{i}")] == [100.0 * s["soc"] for s in states]


def test_traffic_adds_up_to_the_bytes_of_the_record(rows: Rows, record: SortieRecord) -> None:
    sent = record.tables["transmissions"].to_pylist()
    for kind in ("features_delivered", "detections_delivered", "features_expired"):
        representation, fate = kind.split("_")
        size = sum(t["payload_bytes"] for t in sent if (t["representation"], t["status"]) == (representation, fate))
        if size or f"/plots/traffic/{kind}" in rows:
            drawn = sum(v for _, v in series(rows, f"/plots/traffic/{kind}"))
            assert drawn * 1e6 / 8 == pytest.approx(size), kind


def test_a_link_is_as_wide_as_its_traffic_and_as_green_as_its_goodput(rows: Rows, record: SortieRecord) -> None:
    frame, n = 35, record.scenario.fleet.drones
    t_s, links = frame / 10.0, [(i, j) for i in range(n) for j in range(n) if i != j]
    recent: dict[tuple[int, int], float] = defaultdict(float)
    for t in record.tables["transmissions"].to_pylist():
        if t_s - 1.0 <= t["t_done_s"] < t_s:
            recent[t["drone"], t["peer"]] += t["payload_bytes"] * 8e-6
    latest = {d["drone"]: d for d in record.tables["descriptors"].to_pylist() if d["t_s"] < t_s}
    radii = next(v for _, f, v in rows["/world/links"]["Arrows3D:radii"] if f == frame)
    colours = next(v for _, f, v in rows["/world/links"]["Arrows3D:colors"] if f == frame)
    assert len(radii) == len(links)
    assert sum(mbps > 0 for mbps in recent.values()) >= 4
    for (i, j), radius, colour in zip(links, radii, colours, strict=True):
        if recent[i, j]:
            assert radius == pytest.approx(-(1.5 + math.log2(1.0 + recent[i, j])), rel=1e-5)
            goodput = latest[i]["goodput_mbps"][j - (j > i)]
            r, g, b, a = goodput_colours(np.array(goodput)).tolist()
            assert colour == r << 24 | g << 16 | b << 8 | a
        else:
            assert radius == -0.75


@pytest.mark.parametrize(("rate_hz", "frame"), [(0.5, 3), (1.5, 6)])
def test_a_link_is_as_wide_at_rates_that_do_not_divide_a_second(rate_hz: float, frame: int, tmp_path: Path) -> None:
    """Mb/s over as many whole frames as come nearest to a second: 2 s at 0.5 Hz, 1.33 s at 1.5 Hz."""
    slow = run_sortie(example("duration_s=8", f"context.rate_hz={rate_hz}", "policy.dwell_s=0"), "all-4")
    save_rrd(slow, tmp_path / "slow.rrd")
    rows, t_s, window_s = read(tmp_path / "slow.rrd"), frame / rate_hz, max(1, round(rate_hz)) / rate_hz
    recent: dict[tuple[int, int], float] = defaultdict(float)
    for t in slow.tables["transmissions"].to_pylist():
        if t_s - window_s <= t["t_done_s"] < t_s:
            recent[t["drone"], t["peer"]] += t["payload_bytes"] * 8e-6 / window_s
    n = slow.scenario.fleet.drones
    expected = [recent[i, j] for i in range(n) for j in range(n) if i != j]
    assert min(expected) > 0
    radii = next(v for _, f, v in rows["/world/links"]["Arrows3D:radii"] if f == frame)
    assert radii == pytest.approx([-(1.5 + math.log2(1.0 + mbps)) for mbps in expected], rel=1e-5)


def test_a_frame_has_what_was_said_and_settled_before_it() -> None:
    """What is published or settled at its very instant is the next frame's; the second before it is that of its traffic."""
    said = {"t_s": [0.0, 1.0], "drone": [0, 0], "goodput_mbps": [[5.0], [7.0]]}
    settled = {"t_done_s": [0.0, 1.0], "drone": [0, 0], "peer": [1, 1], "payload_bytes": [125_000, 250_000]}
    t_s, tables = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5]), (pa.table(said), pa.table(settled))
    goodput, recent = LinkTraffic(2, 2.0).add(t_s, *tables)
    assert goodput[:, 0, 1].tolist() == [0.0, 5.0, 5.0, 7.0, 7.0, 7.0]
    assert recent[:, 0, 1].tolist() == [0.0, 1.0, 1.0, 2.0, 2.0, 0.0]
    assert not goodput[:, 1, 0].any()


def test_a_link_that_is_all_but_gone_is_crossed_out(rows: Rows, record: SortieRecord) -> None:
    n, descriptors = record.scenario.fleet.drones, record.tables["descriptors"].to_pylist()
    drawn = {frame: strips for _, frame, strips in rows["/world/broken"]["LineStrips3D:strips"]}
    assert min(drawn) > 40  # the links of drone 2 drop at 4 s
    for frame in (45, 55, 70):
        before = [d for d in descriptors if d["t_s"] < frame / 10.0]
        expected = set()
        for i, j in ((i, j) for i in range(n) for j in range(n) if i != j):
            known = [d["goodput_mbps"][j - (j > i)] for d in before if d["drone"] == i]
            if is_tried(known[-1]) and known[-1] < 1.0 and not (frame > 60 and 3 in (i, j)):
                expected.add(frozenset((i, j)))
        assert expected, frame
        assert len(drawn[frame]) == 4 * len(expected)  # four diagonals each
        places = [s for s in record.tables["states"].to_pylist() if round(s["t_s"] * 10) == frame]
        middles = {
            tuple(np.round(np.mean([[places[k][c] for c in ("x_m", "y_m", "z_m")] for k in pair], axis=0), 3).tolist())
            for pair in expected
        }
        assert {tuple(np.round(np.mean(strip, axis=0), 3).tolist()) for strip in drawn[frame]} == middles


def test_what_peers_sent_is_hatched_cell_by_cell(rows: Rows, record: SortieRecord) -> None:
    """As many cells as the payload carried, all of them in its region, in the sender's grid; wiped out a second later."""
    sent = record.tables["transmissions"].to_pylist()
    regions = record.tables["directives"].to_pylist()
    checked = 0
    for ego, peer in ((0, 1), (1, 0), (3, 4)):
        drawn = rows[f"/world/received/{ego}/{peer}/cells"]
        shapes = zip(*(drawn.get(f"Boxes3D:{k}", []) for k in ("centers", "half_sizes")), strict=True)
        for (t_s, _, centres), (_, _, halves) in shapes:
            came = [
                t for t in sent
                if (t["drone"], t["peer"], t["representation"], t["status"]) == (peer, ego, "features", "delivered")
                and t_s - 1.0 <= t["t_done_s"] < t_s
            ]  # fmt: skip
            if not centres:
                assert not came or max(came, key=lambda t: t["t_done_s"])["captured_s"] < 3.0
                continue
            last = max(came, key=lambda t: t["t_done_s"])
            cells = sum(round(2 * half[1] / CELL_M) for half in halves)
            assert abs(cells - last["cells"]) <= 12  # the sender reckoned with its own estimate of where it was
            disc = [
                d for d in regions if (d["drone"], d["peer"]) == (peer, ego) and d["t_s"] <= last["t_sent_s"]
            ][-1]  # fmt: skip
            away = [math.hypot(c[0] - disc["roi_x_m"], c[1] - disc["roi_y_m"]) for c in centres]
            assert max(away) <= disc["roi_radius_m"] + CELL_M
            checked += 1
    assert checked >= 5
    whole = rows["/world/received/0/1/whole_map"]["LineStrips3D:strips"]
    assert whole
    assert {len(v) for _, _, v in whole} <= {0, 1}


def test_of_a_payload_that_came_in_part_as_much_is_drawn_as_came(tmp_path: Path) -> None:
    """By area: rows of cells in a region, the square of a whole map."""
    flown = example("radio.framing=tiles", "radio.bursts={good_to_bad: 0.5, loss_bad: 0.9}", "fleet.drones=3")
    record = run_sortie(flown)
    save_rrd(record, tmp_path / "sortie.rrd")
    drawn = read(tmp_path / "sortie.rrd")
    sent, seen = record.tables["transmissions"].to_pylist(), {"cells": 0, "whole_map": 0}

    def last(ego: int, peer: int, t_s: float) -> dict[str, Any]:
        came = [
            t for t in sent
            if (t["drone"], t["peer"], t["representation"]) == (peer, ego, "features")
            and t["status"] in ("delivered", "partial") and t_s - 1.0 <= t["t_done_s"] < t_s
        ]  # fmt: skip
        return max(came, key=lambda t: t["t_done_s"])

    for ego, peer in ((i, j) for i in range(3) for j in range(3) if i != j):
        path = f"/world/received/{ego}/{peer}"
        for t_s, _, halves in drawn[f"{path}/cells"].get("Boxes3D:half_sizes", []):
            if halves and (row := last(ego, peer, t_s))["status"] == "partial":
                share = row["arrived_bytes"] / row["payload_bytes"]
                assert 0 < share < 1
                assert sum(2 * h[1] for h in halves) / CELL_M == pytest.approx(row["cells"] * share, abs=12)
                seen["cells"] += 1
        for t_s, _, strips in drawn[f"{path}/whole_map"].get("LineStrips3D:strips", []):
            if strips and (row := last(ego, peer, t_s))["status"] == "partial":
                share = row["arrived_bytes"] / row["payload_bytes"]
                side_m = math.dist(*strips[0][:2]) + 2 * 1.2 * peer
                assert (side_m / (64 * CELL_M)) ** 2 == pytest.approx(share, abs=1e-3)
                seen["whole_map"] += 1
    assert min(seen.values()) > 0


def test_a_hatch_covers_exactly_the_cells_of_the_region() -> None:
    """Against every cell's centre, turned and moved by hand; a turned sender's runs lie along its own left."""
    pose, region = (10.0, -20.0, 0.7), (25.0, -10.0, 32.0)
    runs = hatch(region, pose, 1)
    centres = (np.arange(64) - 31.5) * CELL_M
    forward, left = np.meshgrid(centres, centres, indexing="ij")
    x = pose[0] + math.cos(0.7) * forward - math.sin(0.7) * left
    y = pose[1] + math.sin(0.7) * forward + math.cos(0.7) * left
    inside = np.hypot(x - region[0], y - region[1]) <= 32.0
    assert runs[:, 4].sum() == inside.sum() == pytest.approx(math.pi * 32.0**2 / CELL_M**2, rel=0.03)
    assert (runs[:, 2] * 2 / CELL_M).tolist() == pytest.approx(inside.sum(axis=1)[inside.any(axis=1)].tolist())
    middle = [float(np.mean(left[i][inside[i]])) for i in np.flatnonzero(inside.any(axis=1))]
    own = -math.sin(0.7) * (runs[:, 0] - pose[0]) + math.cos(0.7) * (runs[:, 1] - pose[1])
    assert own.tolist() == pytest.approx(middle, abs=1e-9)
    ahead = math.cos(0.7) * (runs[:, 0] - pose[0]) + math.sin(0.7) * (runs[:, 1] - pose[1])
    strip = (1.5 / 4 - 0.5) * CELL_M  # the second of four strips, from the cell's centre
    assert ahead.tolist() == pytest.approx((centres[inside.any(axis=1)] + strip).tolist(), abs=1e-9)


def test_events_and_phase_changes_are_marked_on_the_plots(rows: Rows) -> None:
    for plot in ("ap", "battery", "goodput", "traffic", "age", "lost", "medium"):
        assert series(rows, f"/plots/{plot}/marks/event") == [(4.0, 0.0), (6.0, 0.0)]
        assert series(rows, f"/plots/{plot}/marks/phase") == [(3.0, 0.0)]
    assert [(t_s, v) for t_s, _, v in rows["/lanes/events"]["StateChange:state"]] == [
        (4.0, ["drone 2: links of 2 lose 60 dB"]),
        (6.0, ["drone 3: fell silent"]),
        (8.0, [OVER]),
    ]


def test_links_of_a_lost_drone_are_gone(rows: Rows) -> None:
    assert {len(v) for t_s, _, v in rows["/world/links"]["Arrows3D:vectors"] if t_s > 6.0} == {4 * 3}


def test_goodput_runs_from_red_by_yellow_to_green() -> None:
    colours = goodput_colours(np.array([0.0, SILENT_MBPS, 1.0, 10.0, 100.0, 1000.0]))[:, :2].tolist()
    assert colours == [[185, 190], [255, 45], [255, 45], [255, 230], [50, 230], [50, 230]]


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
        (8.0, [OVER]),
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


def test_a_drone_that_waits_for_its_turn_shows_no_boxes(tmp_path: Path) -> None:
    """Five drones, three at a time: at each scored moment the boxes of two are of an earlier time."""
    turns = run_sortie(example("duration_s=2.1", "perception.detector=surrogate", "perception.egos=3"))
    save_rrd(turns, tmp_path / "turns.rrd")
    rows, fusions = read(tmp_path / "turns.rrd"), turns.tables["fusions"].to_pylist()
    for drone in range(5):
        own_s = {f["t_s"] for f in fusions if f["drone"] == drone}
        shown = {round(t_s, 6): v for t_s, _, v in rows[f"/world/seen/{drone}/missed"]["Boxes3D:centers"]}
        last: list[Any] = []
        for t_s in sorted({f["t_s"] for f in fusions}):
            last = shown.get(round(t_s, 6), last)
            assert bool(last) == (t_s in own_s), (drone, t_s)


def test_accuracy_is_the_outcome_s_over_the_same_window(rows: Rows, record: SortieRecord) -> None:
    for name, path in (("full_scene", "/plots/ap/full_scene"), ("mission", "/plots/ap/mission")):
        drawn = dict(series(rows, path))
        assert drawn[8.0] == pytest.approx(accuracy(record, 3.0, 8.0)[name])
    assert min(dict(series(rows, "/plots/ap/mission"))) == 4.0


def test_the_age_of_descriptors_is_that_of_each_second(rows: Rows, record: SortieRecord) -> None:
    drawn = dict(series(rows, "/plots/age/p99_ms"))
    for second in (4.0, 5.0):
        ages = [a["age_s"] for a in record.tables["ages"].to_pylist() if second <= a["t_s"] < second + 1.0]
        assert drawn[second + 1.0] == pytest.approx(1e3 * np.percentile(ages, 99))


def test_the_share_of_lost_descriptors_is_that_of_each_second(rows: Rows, record: SortieRecord) -> None:
    drawn = dict(series(rows, "/plots/lost/percent"))
    assert sorted(drawn) == [float(second) for second in range(1, round(record.scenario.duration_s) + 1)]
    for second, percent in drawn.items():
        within = [r for r in record.tables["receptions"].to_pylist() if second - 1.05 <= r["t_s"] < second - 0.05]
        every = sum(sum(r.values()) - r["t_s"] for r in within)
        assert percent == pytest.approx(100.0 * (1.0 - sum(r["heard"] for r in within) / every))
    assert max(drawn.values()) > 5.0


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


# --- the log ---------------------------------------------------------------------------------------


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


def test_transitions_in_slices_are_those_of_the_whole(record: SortieRecord) -> None:
    carried: dict[tuple[int, int], str] = {}
    pieces = [t for _, new in slices(record) for t in transitions(new["directives"], carried)]
    assert pieces == outcome(record)["transitions"]


def test_events_warn(rows: Rows, record: SortieRecord) -> None:
    events = rows["/log/events"]
    assert [v for _, _, v in events["TextLog:level"]] == [["WARN"]] * record.tables["events"].num_rows
    assert [(t_s, v) for t_s, _, v in events["TextLog:text"]] == [
        (4.0, ["drone 2: links of 2 lose 60 dB"]),
        (6.0, ["drone 3: fell silent"]),
    ]


def test_a_lane_shows_the_best_that_a_drone_sends(rows: Rows) -> None:
    states = [(t_s, v) for t_s, _, (v,) in rows["/lanes/drone_2"]["StateChange:state"]]
    assert any(v.startswith("features") for t_s, v in states if t_s < 4.0)
    assert next(v for t_s, v in states if t_s > 4.0).startswith("detections at 2 Hz")
    *_, before, last, over = [(t_s, v) for t_s, _, (v,) in rows["/lanes/drone_3"]["StateChange:state"]]
    assert before[1].startswith("features")
    assert last == (6.0, "nothing")  # it was lost then, and nothing was decided on it any more
    assert over == (8.0, OVER)


def test_no_house_hides_the_mission_region(rows: Rows, record: SortieRecord) -> None:
    """Its second ring lies above every roof."""
    ((_, _, (ground, above, *posts)),) = rows["/world/mission/disc"]["LineStrips3D:strips"]
    roofs = rows["/world/town/buildings"]["Boxes3D:half_sizes"][0][2]
    assert {z for _, _, z in ground} == {0.0}
    assert [z for _, _, z in above] == pytest.approx([2 * max(half[2] for half in roofs) + 1.0] * len(above), rel=1e-5)
    assert len(posts) == 8


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


def test_a_jammer_is_shown_while_it_is_on(tmp_path: Path) -> None:
    jam = "events=[{kind: jam, at_s: 1, until_s: 2, position_m: [10, 20, 5]}]"
    flown = run_sortie(example("duration_s=3", jam))
    save_rrd(flown, tmp_path / "jam.rrd")
    rows = read(tmp_path / "jam.rrd")
    shown = [(t_s, v) for t_s, _, v in rows["/world/jammers"]["Points3D:positions"]]
    assert shown == [(1.0, [[10.0, 20.0, 5.0]]), (2.0, [])]
    x0, _, _, y1 = scene_of(flown).rect
    assert np.allclose(rows["/map/jammers"]["Points2D:positions"][0][2], [[10 - x0, y1 - 20]], atol=1e-3)


def test_the_camera_fits_the_fleet_that_flew(tmp_path: Path) -> None:
    """Two drones 400 m apart are 200 m from their middle; a ground station counts for nothing."""
    trace = "t_s,drone,x_m,y_m,z_m\n0,0,0,0,60\n0,1,400,0,60\n"
    (tmp_path / "far.csv").write_text(trace + "0,2,9000,0,2\n")
    settings = (f"fleet.trace={tmp_path}/far.csv", "fleet.ground=[{drone: 2}]", "perception.detector=none")
    assert spread_m(run_sortie(example("duration_s=2", "fleet.drones=3", *settings))) == pytest.approx(200.0)


# --- live ------------------------------------------------------------------------------------------


def test_live_draws_what_is_saved(rows: Rows, record: SortieRecord, tmp_path: Path) -> None:
    viewer = LiveViewer(to_file(tmp_path / "live.rrd"))
    viewer.begin(record.scenario, scene_of(record))
    for t_s, new in slices(record):
        viewer.second(t_s, new)
    viewer.close()
    assert_same(read(tmp_path / "live.rrd"), rows)


def test_a_long_sortie_is_drawn_in_blocks(
    rows: Rows, record: SortieRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording, "BLOCK_DRONE_S", 15.0)
    save_rrd(record, tmp_path / "blocks.rrd")
    assert_same(read(tmp_path / "blocks.rrd"), rows)


def test_each_block_is_on_disk_before_the_next_and_blocks_of_large_fleets_are_short(
    record: SortieRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a large fleet's recording fills the memory."""
    steps: list[object] = []
    monkeypatch.setattr(recording, "BLOCK_DRONE_S", 3.0 * record.scenario.fleet.drones)
    monkeypatch.setattr(recording.Playback, "add", lambda self, known_s, new: steps.append(known_s))
    flush = rr.RecordingStream.flush
    monkeypatch.setattr(rr.RecordingStream, "flush", lambda self: (steps.append("flush"), flush(self)))
    save_rrd(record, tmp_path / "blocks.rrd")
    assert steps == [3.0, "flush", 6.0, "flush", record.scenario.duration_s, "flush", "flush"]


def assert_same(live: Rows, rows: Rows) -> None:
    assert set(live) == set(rows)
    for entity, components in rows.items():
        assert set(live[entity]) == set(components), entity
        for name, values in components.items():
            if entity.startswith("/__properties"):
                continue
            if name.startswith("StateConfiguration"):  # told anew with every state that comes up
                assert live[entity][name][-1][2] == values[-1][2]
                continue
            got = live[entity][name]
            assert [(t, f) for t, f, _ in got if t == t] == [(t, f) for t, f, _ in values if t == t], (entity, name)
            for (t_s, _, a), (_, _, b) in zip(got, values, strict=True):
                assert same(a, b), (entity, name, t_s)


def same(a: Any, b: Any) -> bool:
    """Equal, up to rounding of sums."""
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=1e-5, abs_tol=1e-6) or (a != a and b != b)
    return bool(a == b)


def test_a_flight_that_is_watched_is_the_same_flight(tmp_path: Path) -> None:
    flown = example("duration_s=3")
    viewer = LiveViewer(to_file(tmp_path / "live.rrd"))
    watched = run_sortie(flown, observer=viewer)
    viewer.close()
    assert watched.fingerprint == run_sortie(flown).fingerprint
    assert len(read(tmp_path / "live.rrd")["/world/drones/0"]["Transform3D:translation"]) == flown.frames


def test_saving_changes_nothing_and_says_nothing(
    record: SortieRecord, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    before = record.fingerprint
    save_rrd(record, tmp_path / "sortie.rrd")
    assert record.fingerprint == before
    assert capfd.readouterr() == ("", "")  # Rerun tells of bad paths and values in log lines


def test_seconds_without_a_frame_are_drawn_while_a_drone_is_down(tmp_path: Path) -> None:
    """At 0.5 Hz every other second has none."""
    slow = example(
        "duration_s=4", "fleet.drones=2", "context.rate_hz=0.5", "events=[{kind: drone_lost, at_s: 2, drone: 1}]"
    )
    viewer = LiveViewer(to_file(tmp_path / "live.rrd"))
    flown = run_sortie(slow, observer=viewer)
    viewer.close()
    save_rrd(flown, tmp_path / "saved.rrd")
    live = read(tmp_path / "live.rrd")
    assert_same(live, read(tmp_path / "saved.rrd"))
    names = [label for _, _, (label,) in live["/world/drones/1/name"]["Points3D:labels"]]
    assert [name.endswith("down") for name in names] == [False, True]


@pytest.mark.parametrize("drones", [1, 12])
def test_small_and_large_fleets_are_drawn(drones: int, tmp_path: Path) -> None:
    save_rrd(run_sortie(example("duration_s=2.5", f"fleet.drones={drones}")), tmp_path / "sortie.rrd")
    drawn = read(tmp_path / "sortie.rrd")
    assert sum(e.startswith("/plots/battery/") and "marks" not in e for e in drawn) == drones
    if drones == 1:
        assert "/world/links" not in drawn
    else:  # idle links of a large fleet are left out
        assert max(len(v) for _, _, v in drawn["/world/links"]["Arrows3D:vectors"]) < drones * (drones - 1)
    busy = drawn["/plots/medium/busy_percent"]["Scalars:scalars"]
    assert [t_s for t_s, _, _ in busy] == [0.0, 1.0, 2.0]


# --- what can go wrong -----------------------------------------------------------------------------


def test_a_path_that_cannot_be_written_is_one_clear_error(record: SortieRecord, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    path = tmp_path / "file" / "sortie.rrd"
    with pytest.raises(RunError, match=r"file/sortie\.rrd: cannot be written: File exists$"):
        save_rrd(record, path)


def test_a_failed_save_leaves_nothing(record: SortieRecord, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    (tmp_path / "sortie.rrd").write_text("an older one")
    monkeypatch.setattr(recording.Playback, "add", fail)
    with pytest.raises(RunError, match=r"sortie\.rrd: cannot be written: No space left on device$"):
        save_rrd(record, tmp_path / "sortie.rrd")
    assert [p.name for p in tmp_path.iterdir()] == ["sortie.rrd"]
    assert (tmp_path / "sortie.rrd").read_text() == "an older one"


def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


def test_without_a_display_there_is_no_viewer(
    saved: Path, record: SortieRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    no_display(monkeypatch)
    with pytest.raises(
        RunError,
        match=r"^no display to show a viewer on; open .*sortie\.rrd elsewhere, .* --web-viewer --bind 127\.0\.0\.1 ",
    ):
        open_viewer(saved)
    with pytest.raises(RunError, match=r"^no display to show a viewer on; --live needs one"):
        LiveViewer().begin(record.scenario, scene_of(record))


def test_without_the_viewer_there_is_none(saved: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RunError, match=r"^no viewer: there is no rerun command beside"):
        open_viewer(saved)


def test_a_missing_recording_is_named(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"gone\.rrd: no recording there$"):
        open_viewer(tmp_path / "gone.rrd")


@pytest.mark.parametrize("live", [False, True])
def test_a_viewer_that_fails_is_quoted(
    live: bool, saved: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fake = tmp_path / "rerun"
    fake.write_text("#!/bin/sh\necho 'winit: no window for you' >&2\nexit 3\n")
    fake.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("DISPLAY", ":99")
    with pytest.raises(RunError, match=r"the viewer (failed|does not come up): winit: no window for you$"):
        to_new_viewer(rr.RecordingStream("test"), scenario()) if live else open_viewer(saved)


def test_a_recording_is_named_after_the_policy_that_flew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not after the scenario's own, which another one replaced."""
    named: list[str] = []
    monkeypatch.setattr(rr.RecordingStream, "send_recording_name", lambda self, name: named.append(name))
    save_rrd(run_sortie(example("duration_s=0.5", "mission.phases=[{}]"), "silence", 4), tmp_path / "a.rrd")
    assert named == ["example · silence · seed 4"]


def test_a_ground_station_is_drawn_as_a_mast_that_leaves_no_trail(tmp_path: Path) -> None:
    station = "fleet.ground=[{drone: 2, position_m: [0, 0, 6]}]"
    save_rrd(run_sortie(example("fleet.drones=3", "duration_s=1", station)), tmp_path / "s.rrd")
    drawn = read(tmp_path / "s.rrd")
    parts = {path for path in drawn if path.startswith("/world/drones/2/")}
    assert {"/world/drones/2/mast", "/world/drones/2/antenna"} <= parts
    assert not parts & {"/world/drones/2/rotors", "/world/drones/2/body"}
    assert "/world/trails/2" not in drawn
    assert "/world/footprints/2" not in drawn or not any("Strips" in name for name in drawn["/world/footprints/2"])
    assert "/world/drones/1/rotors" in drawn
