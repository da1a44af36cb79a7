"""HOTA of a sortie: a tracker over the boxes that each drone has after fusion, judged by which car is which.

Each drone's tracker takes in its boxes at every scored instant. Its confirmed tracks that got a box at an instant are what
the drone reports then. One drone's flight is one sequence, and all sequences are judged together.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from sortie.perception.classes import PERSON
from sortie.perception.metrics.hota import Followed, hota
from sortie.perception.motion import Tracks
from sortie.perception.tracking.tracker import step
from sortie.perception.types import Boxes
from sortie.sim.results.record import SortieRecord, classes_in


def tracking_outcome(record: SortieRecord) -> dict[str, float | None]:
    """The section `tracking` of the outcome; null without a detector, a car, or a detector that knows which car is which."""
    fusions = record.tables["fusions"]
    truths, detections = (_vehicles(record.tables[name]) for name in ("truths", "detections"))
    nothing: dict[str, float | None] = {"hota": None, "det_a": None, "ass_a": None}
    if not fusions.num_rows or np.any(truths["car"].to_numpy() < 0):
        return nothing
    drones = record.scenario.fleet.drones
    key = fusions["t_s"].to_numpy() + 1j * fusions["drone"].to_numpy()
    instants, instant = np.unique(key.real, return_inverse=True)
    frame_of = dict(zip(key.tolist(), (instant * drones + key.imag.astype(np.int64)).tolist(), strict=True))
    cars = _followed(truths, truths["car"].to_numpy(), frame_of, drones)
    value = hota(cars, _tracked(detections, instants, frame_of, drones))
    return nothing if value is None else value._asdict()


def _vehicles(table: pa.Table) -> pa.Table:
    """The boxes of cars and trucks. A person has no useful overlap, by which HOTA judges."""
    kind = classes_in(table)
    return table.filter(pa.array(kind != PERSON)) if kind.any() else table


def _followed(table: pa.Table, identity: np.ndarray, frame_of: dict[complex, int], drones: int) -> Followed:
    """The boxes of a table at the fusions that were scored."""
    frame = _frames(table, frame_of)
    scored = frame >= 0
    boxes = np.column_stack([table[c].to_numpy() for c in ("x_m", "y_m", "length_m", "width_m", "yaw_rad")])
    return Followed(boxes[scored], frame[scored], identity[scored] * drones + frame[scored] % drones)


def _frames(table: pa.Table, frame_of: dict[complex, int]) -> np.ndarray:
    key = table["t_s"].to_numpy() + 1j * table["drone"].to_numpy()
    return np.array([frame_of.get(k, -1) for k in key.tolist()], np.int64)


def _tracked(table: pa.Table, instants: np.ndarray, frame_of: dict[complex, int], drones: int) -> Followed:
    """What every drone's tracker makes of its boxes."""
    column = {c: table[c].to_numpy() for c in table.column_names}
    frame = _frames(table, frame_of)
    order = np.argsort(frame, kind="stable")
    xy, size = (np.column_stack([column[a], column[b]])[order] for a, b in (("x_m", "y_m"), ("length_m", "width_m")))
    boxes, frame = (
        Boxes(xy, size, column["yaw_rad"][order], column["score"][order], kind=classes_in(table)[order]),
        frame[order],
    )
    looked = np.full((len(instants), drones), np.nan)
    scored = np.array(list(frame_of.values()), np.int64)
    looked[scored // drones, scored % drones] = instants[scored // drones]
    first = np.searchsorted(frame, np.arange(len(instants) + 1) * drones)
    tracks, next_id, told = Tracks.empty(), np.zeros(drones, np.int64), []
    for k, looks_s in enumerate(looked):
        here = slice(first[k], first[k + 1])
        tracks, next_id, _ = step(tracks, boxes.take(here), frame[here] % drones, looks_s, next_id)
        seen = tracks.take(tracks.confirmed & (tracks.seen_s == instants[k]))
        told.append(
            (
                np.column_stack([seen.xy_m, seen.size_m, seen.yaw_rad]),
                k * drones + seen.owner,
                seen.id * drones + seen.owner,
            )
        )
    return Followed(*(np.concatenate(c) for c in zip(*told, strict=True)))
