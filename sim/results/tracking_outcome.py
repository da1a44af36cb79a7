"""HOTA of a sortie: a tracker over the boxes that each drone has after fusion, judged by which car is which.

Each drone's tracker takes in its boxes at every scored instant. Its confirmed tracks that got a box at an instant are what
the drone reports then. One drone's flight is one sequence, and all sequences are judged together.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sortie.perception.classes import PERSON
from sortie.perception.metrics.hota import Followed, hota_of
from sortie.perception.motion import Tracks
from sortie.perception.tracking.tracker import step
from sortie.perception.types import Boxes
from sortie.sim.results.box_rows import Columns, Key, columns_of, fusion_blocks, fusions_of, kinds_of
from sortie.sim.results.section import Flown, OutcomeSection, Share, figure
from sortie.sim.results.spool import InTime, batches


class TrackingOutcome(OutcomeSection):
    hota: Share | None = figure(
        "HOTA (higher order tracking accuracy, Luiten et al. 2021), the mean over 19 limits of overlap, 0.05 to 0.95. "
        "A tracker follows each drone's boxes after fusion; its confirmed tracks are judged by rotated IoU on the "
        "ground, over all cars within range. Null where the detector does not know which car is which, and where "
        "drones take turns at being scored: a tracker needs all boxes of its drone."
    )
    det_a: Share | None = figure("DetA, its part that judges detection.")
    ass_a: Share | None = figure("AssA, its part that judges whether tracks keep to their cars.")

    @classmethod
    def compute(cls, flown: Flown) -> dict[str, float | None]:
        tables, scenario = flown.tables, flown.scenario
        value = None
        if not scenario.takes_turns and tables["fusions"].num_rows and _is_known(tables):
            value = hota_of(_followed(tables, scenario.fleet.drones, scenario.duration_s))
        return dict.fromkeys(cls.model_fields) if value is None else value._asdict()


def _is_known(tables: Mapping[str, pa.Table]) -> bool:
    """Whether the detector knew which car is which."""
    for piece in batches(tables, "truths"):
        own = {name: piece[name].to_numpy() for name in piece.schema.names if name in ("t_s", "car", "kind")}
        if np.any(own["car"][kinds_of(own) != PERSON] < 0):
            return False
    return True


def _followed(tables: Mapping[str, pa.Table], drones: int, end_s: float) -> Iterator[tuple[Followed, Followed]]:
    """What was there at the fusions that were scored, and what every drone's tracker makes of its boxes."""
    fusions = tables["fusions"]
    t_s, drone = fusions["t_s"].to_numpy(), fusions["drone"].to_numpy()
    truths, detections = InTime(tables, "truths"), InTime(tables, "detections")
    tracks, next_id, first = Tracks.empty(), np.zeros(drones, np.int64), 0
    for here, until_s in fusion_blocks(t_s, end_s):
        if here.start == here.stop:
            return  # the rest belongs to no fusion
        instants, instant = np.unique(t_s[here], return_inverse=True)
        keys = list(zip(t_s[here].tolist(), drone[here].tolist(), strict=True))
        frames = (first + instant) * drones + drone[here]  # of each fusion
        there, frame = _vehicles(columns_of(truths.before(until_s)), keys, frames)
        identity = there["car"].astype(np.int64) * drones + frame % drones
        cars = Followed(_as_rows(there), frame, identity, kinds_of(there))
        found, frame = _vehicles(columns_of(detections.before(until_s)), keys, frames)
        told = []
        for k, now_s in enumerate(instants.tolist(), first):
            looks_s = np.full(drones, np.nan)
            looks_s[frames[frames // drones == k] % drones] = now_s
            tracks, next_id, followed = _step(tracks, next_id, found, frame, looks_s, k)
            told.append(followed)
        yield cars, Followed(*(np.concatenate(c) for c in zip(*told, strict=True)))
        first += len(instants)


def _vehicles(rows: Columns, keys: Sequence[Key], frames: NDArray[np.int64]) -> tuple[Columns, NDArray[np.int64]]:
    """The boxes of cars and trucks at some fusions, frame by frame. A person has no useful overlap, by which HOTA judges."""
    at = fusions_of(keys, rows)
    wanted = np.flatnonzero((at >= 0) & (kinds_of(rows) != PERSON))
    frame = frames[at[wanted]]
    order = np.argsort(frame, kind="stable")
    return {name: values[wanted[order]] for name, values in rows.items()}, frame[order]


def _as_rows(rows: Columns) -> NDArray[np.float64]:
    return np.column_stack([rows[c] for c in ("x_m", "y_m", "length_m", "width_m", "yaw_rad")])


def _step(
    tracks: Tracks,
    next_id: NDArray[np.int64],
    found: Columns,
    frame: NDArray[np.int64],
    looks_s: NDArray[np.float64],
    k: int,
) -> tuple[Tracks, NDArray[np.int64], Followed]:
    """The fleet's trackers take in their boxes at instant `k`; what they report then."""
    drones = len(looks_s)
    here = slice(*np.searchsorted(frame, [k * drones, (k + 1) * drones]))
    own = {name: values[here] for name, values in found.items()}
    xy, size = (np.column_stack([own[a], own[b]]) for a, b in (("x_m", "y_m"), ("length_m", "width_m")))
    boxes = Boxes(xy, size, own["yaw_rad"], own["score"], kind=kinds_of(own))
    tracks, next_id, _ = step(tracks, boxes, frame[here] % drones, looks_s, next_id)
    seen = tracks.take(tracks.confirmed & (tracks.seen_s == np.nanmax(looks_s)))
    rows = np.column_stack([seen.xy_m, seen.size_m, seen.yaw_rad])
    return tracks, next_id, Followed(rows, k * drones + seen.owner, seen.id * drones + seen.owner, seen.kind)
