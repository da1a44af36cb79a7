"""A flight that tests of playback read, flown once in each process; and what a recording holds."""

from __future__ import annotations

import dataclasses
import math
from collections import defaultdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rerun.chunk import RrdReader
from sim_examples import example

from sortie.sim.engine.sortie import run_sortie
from sortie.sim.playback.recording import save_rrd, scene_of
from sortie.sim.results.record import TABLES, SortieRecord

DURATION_S = 8.0
EVENTS = "events=[{kind: link_drop, at_s: 4, drone: 2, loss_db: 60}, {kind: drone_lost, at_s: 6, drone: 3}]"
Rows = dict[str, dict[str, list[tuple[float, int, Any]]]]
"""entity → component → (time s, frame, value), in order of time; static ones at NaN."""


@cache
def flown() -> SortieRecord:
    """Eight seconds in which a phase changes, a link drops and a drone is lost; with sightings, and rows at 5 s."""
    return with_sightings(on_the_second(run_sortie(example(f"duration_s={DURATION_S}", EVENTS))))


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


def drawn(record: SortieRecord, folder: Path) -> Rows:
    save_rrd(record, folder / "drawn.rrd")
    return read(folder / "drawn.rrd")


def series(rows: Rows, path: str) -> list[tuple[float, float]]:
    return [(t_s, value[0]) for t_s, _, value in rows[path]["Scalars:scalars"]]


def with_tables(record: SortieRecord, **changed: pa.Table) -> SortieRecord:
    return dataclasses.replace(record, tables={**record.tables, **changed})


class Kept:
    """A canvas that keeps what is drawn."""

    def __init__(self) -> None:
        self.still: dict[str, Any] = {}
        self.rows: dict[str, list[tuple[float, list[Any]]]] = {}

    def static(self, path: str, *shown: Any) -> None:
        self.still[path] = shown[0]

    def columns(self, path: str, t_s: Any, columns: Any) -> None:
        for column in columns:
            name = column.component_descriptor().component.split(":")[1]
            values = column.as_arrow_array().to_pylist()
            known = self.rows.setdefault(f"{path} {name}", [])
            known += zip(np.asarray(t_s, float).tolist(), values, strict=True)
