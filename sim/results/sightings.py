"""Detections of each scored fusion matched to the cars that were there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from sortie.perception.classes import CAR, TargetClass
from sortie.perception.metrics.ap import Matched, match, ranked
from sortie.perception.types import Boxes
from sortie.scenarios.disc import Disc
from sortie.sim.results.record import classes_in
from sortie.sim.results.regions import Regions


@dataclass(frozen=True, slots=True)
class Sighting:
    """One ego's fusion: `hits` are detected targets, `false` detections without one, `missed` targets without a detection.

    Boxes say of which class they are. `full` and `mission` are the matches behind the AP of cars; `mission` is None while there is no mission disc.
    """

    t_s: float
    drone: int
    hits: Boxes
    false: Boxes
    missed: Boxes
    full: Matched
    mission: Matched | None


def sightings(tables: Mapping[str, pa.Table], regions: Regions) -> Iterator[Sighting]:
    """Judge every fusion in `tables["fusions"]`. Its boxes stand in the box tables in the same order.

    Cars about drones that left the air belong to no fusion and are left out.

    Args:
        tables: `fusions`, `detections` and `truths`, whole or a slice of whole fusions.
        regions: the mission discs.
    """
    fusions = tables["fusions"]
    flying = np.isin(_fusion_of(tables["truths"]), _fusion_of(fusions))
    boxes, truths = _boxes(tables["detections"]), _boxes(tables["truths"].filter(pa.array(flying)))
    at, truth_at = 0, 0
    discs = regions.at(fusions["t_s"].to_numpy(), fusions["drone"].to_numpy())
    rows = zip(*(fusions[c].to_pylist() for c in ("t_s", "drone", "detections", "truths")), discs, strict=True)
    for t_s, drone, count, truth_count, disc in rows:
        own = boxes.take(np.arange(at, at + count))
        truth = truths.take(np.arange(truth_at, truth_at + truth_count))
        at, truth_at = at + count, truth_at + truth_count
        whole = match(own, truth)
        own = ranked(own)  # the order of whole.hit
        hits = own.take(whole.hit)
        missed = Boxes.join([_missed(truth.of_class(kind), hits.of_class(kind)) for kind in TargetClass])
        false = own.take(~whole.hit)
        if own.kind.any() or truth.kind.any():
            own, truth = own.of_class(CAR), truth.of_class(CAR)
            whole = match(own, truth)
        mission = None if np.isnan(disc[2]) else match(own, truth, Disc(*disc.tolist()))
        yield Sighting(t_s, drone, hits, false, missed, whole, mission)


def _missed(truth: Boxes, hits: Boxes) -> Boxes:
    """The cars that no hit stands for; each hit stands for one car, together at the least distance."""
    away = ((truth.xy_m[:, None, :] - hits.xy_m[None, :, :]) ** 2).sum(axis=-1)
    left = np.ones(len(truth), bool)
    left[linear_sum_assignment(away)[0]] = False
    return truth.take(left)


def _fusion_of(table: pa.Table) -> NDArray[np.complex128]:
    """Time and drone of each row, as one number."""
    return np.asarray(table["t_s"].to_numpy() + 1j * table["drone"].to_numpy())


def _boxes(table: pa.Table) -> Boxes:
    column = {c: table[c].to_numpy() for c in table.column_names}
    return Boxes(
        np.column_stack([column["x_m"], column["y_m"]]),
        np.column_stack([column["length_m"], column["width_m"]]),
        column["yaw_rad"],
        column.get("score", np.ones(table.num_rows)),
        kind=classes_in(table),
    )
