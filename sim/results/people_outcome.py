"""Figures about people: what the thermal cameras found, and how well drones knew of people in their regions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from sortie.perception.classes import NEAR_M, PERSON
from sortie.perception.metrics.ap import Matched, average_precision, best_pairs, hits
from sortie.perception.thermal import in_cone
from sortie.scenarios.frames import frame_at, frames_at, instants
from sortie.sim.results.record import SortieRecord, classes_in
from sortie.sim.results.regions import Regions
from sortie.sim.results.section import Flown, OutcomeSection, Seconds, Share, figure

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class PeopleOutcome(OutcomeSection):
    ap_2m: Share | None = figure(
        "AP of people, pooled over drones and frames: what a drone's thermal camera reports, against everybody in its "
        "cone, hidden or not. A detection may be of a person within 2 m of it. `ap_by_class.person` is that of people "
        "after sharing."
    )
    located_share: Share | None = figure(
        "Share of people in a drone's region at a scored fusion of whom it had a box within 2 m, its own or a peer's."
    )
    located_alone_share: Share | None = figure("The same by the drone's own thermal camera in that frame.")
    in_region_drone_s: Seconds | None = figure("Time with people in regions of flying drones, summed over drones.")
    unknown_share: Share | None = figure("Share of that time in which the drone did not know it, itself or by peers.")
    unknown_longest_s: Seconds | None = figure("Longest unbroken time of one drone in which it did not know it.")
    false_alert_share: Share | None = figure(
        "Of a drone's time with nobody in its region, the share in which it took somebody to be there."
    )

    @classmethod
    def compute(cls, flown: Flown) -> dict[str, float | None]:
        record, perception = flown.record, flown.scenario.perception
        if not perception.people and perception.thermal is None:
            return dict.fromkeys(cls.model_fields)
        n, frame_s = record.scenario.fleet.drones, record.scenario.frame_s
        states = record.tables["states"]
        t_s = states["t_s"].to_numpy()[::n]
        fleet = record.scenario.fleet
        there = np.reshape(states["airborne"].to_numpy(zero_copy_only=False), (-1, n))
        flying = there & [fleet.station(drone) is None for drone in range(n)]
        people_m = _people(record.tables["people"], len(t_s), len(perception.people))
        discs = Regions(record.tables["mission"], record.scenario.mission).at(
            np.repeat(t_s, n), np.tile(range(n), len(t_s))
        )
        discs = discs.reshape(-1, n, 3)
        away_m = np.linalg.norm(people_m[:, None] - discs[:, :, None, :2], axis=-1)  # [T, N, people]
        present = (away_m <= discs[:, :, None, 2]).any(axis=-1) & flying
        known = _known(record.tables["alerts"], t_s, n, frame_s) & flying
        without = flying & ~np.isnan(discs[..., 2]) & ~present
        width_s = np.diff(t_s, append=record.scenario.duration_s)
        return {
            "ap_2m": None if perception.thermal is None else _average_precision(record, t_s, flying, people_m),
            **dict(zip(("located_share", "located_alone_share"), _located(record), strict=True)),
            "in_region_drone_s": _drone_s(present, width_s),
            "unknown_share": _share(present & ~known, present, width_s),
            "unknown_longest_s": _longest_s(present & ~known, width_s) if present.any() else None,
            "false_alert_share": _share(without & known, without, width_s),
        }


def _located(record: SortieRecord) -> tuple[float | None, float | None]:
    """Of the people in egos' regions at scored fusions, the shares that egos had a box of: after sharing, and alone."""
    fusions, truths, boxes = (record.tables[name] for name in ("fusions", "truths", "detections"))
    frame_s, sightings = record.scenario.frame_s, record.tables["sightings"]
    truths, boxes = (table.filter(pa.array(classes_in(table) == PERSON)) for table in (truths, boxes))
    t_s, drone, x_m, y_m = (truths[c].to_numpy() for c in ("t_s", "drone", "x_m", "y_m"))
    disc = Regions(record.tables["mission"], record.scenario.mission).at(t_s, drone)
    scored = set(zip(fusions["t_s"].to_pylist(), fusions["drone"].to_pylist(), strict=True))
    pairs = list(zip(t_s.tolist(), drone.tolist(), strict=True))
    flies = np.array([key in scored and record.scenario.fleet.station(key[1]) is None for key in pairs], bool)
    sought = flies & ((x_m - disc[:, 0]) ** 2 + (y_m - disc[:, 1]) ** 2 <= disc[:, 2] ** 2)
    here_m = np.column_stack([x_m, y_m])[sought]
    keys = list(zip(t_s[sought].tolist(), drone[sought].tolist(), strict=True))
    if not keys:
        return None, None
    alone = _places(sightings, [round(t / frame_s) for t in sightings["t_s"].to_pylist()])
    joined = _places(boxes, boxes["t_s"].to_pylist())
    frames = [(frame_at(t, frame_s), d) for t, d in keys]
    return _near(here_m, [joined.get(k) for k in keys]), _near(here_m, [alone.get(k) for k in frames])


def _places(table: pa.Table, moments: Sequence[float]) -> dict[tuple[float, int], list[tuple[float, float]]]:
    """Places by moment and drone."""
    out: dict[tuple[float, int], list[tuple[float, float]]] = {}
    columns = (table[c].to_pylist() for c in ("drone", "x_m", "y_m"))
    for moment, drone, x_m, y_m in zip(moments, *columns, strict=True):
        out.setdefault((moment, drone), []).append((x_m, y_m))
    return out


def _near(here_m: Floats, places: Sequence[list[tuple[float, float]] | None]) -> float:
    """The share of places [n, 2] that have one of their own list within `NEAR_M`."""
    found = [
        at is not None and bool((np.hypot(*(np.array(at) - here).T) <= NEAR_M).any())
        for here, at in zip(here_m, places, strict=True)
    ]
    return float(np.mean(found))


def _drone_s(what: Bools, width_s: Floats) -> float:
    """Time in which something is so, summed over drones; `what` [T, N], `width_s` [T]."""
    return float((width_s * what.sum(axis=1)).sum())


def _share(part: Bools, whole: Bools, width_s: Floats) -> float | None:
    return _drone_s(part, width_s) / _drone_s(whole, width_s) if whole.any() else None


def _longest_s(what: Bools, width_s: Floats) -> float:
    """The longest unbroken time of any drone; `what` [T, N], `width_s` [T]."""
    run_s, longest_s = np.zeros(what.shape[1]), 0.0
    for row, lasts_s in zip(what, width_s, strict=True):
        run_s = np.where(row, run_s + lasts_s, 0.0)
        longest_s = max(longest_s, float(run_s.max()))
    return longest_s


def _people(table: pa.Table, frames: int, people: int) -> Floats:
    """[T, people, 2]"""
    xy = np.column_stack([table["x_m"].to_numpy(), table["y_m"].to_numpy()])
    return xy.reshape(frames, people, 2)


def _known(alerts: pa.Table, t_s: Floats, drones: int, frame_s: float) -> Bools:
    """Whether each drone knew of a person at its decision in each frame, [T, N]."""
    out = np.zeros((len(t_s), drones), bool)
    at_s, whose, known = (alerts[c].to_numpy(zero_copy_only=False) for c in ("t_s", "drone", "known"))
    for drone in range(drones):
        mine = whose == drone
        # a drone decides within the frame
        last = np.searchsorted(frames_at(at_s[mine], frame_s), frames_at(t_s, frame_s), side="right") - 1
        out[:, drone] = np.concatenate([known[mine].astype(bool), [False]])[last]  # −1: none yet
    return out


def _average_precision(record: SortieRecord, t_s: Floats, looking: Bools, people_m: Floats) -> float | None:
    """AP of the sightings of each drone and frame, by distance on the ground; `looking` [T, N]: whose camera counts."""
    camera = record.scenario.perception.thermal
    assert camera is not None  # noqa: S101 (the caller asks for a camera's)
    n = looking.shape[1]
    states, table = record.tables["states"], record.tables["sightings"]
    position = np.stack([states[c].to_numpy() for c in ("x_m", "y_m", "z_m")], axis=-1).reshape(-1, n, 3)
    frame = np.searchsorted(instants(t_s), instants(table["t_s"].to_numpy()))
    image = frame * n + table["drone"].to_numpy()
    spots = np.column_stack([table["x_m"].to_numpy(), table["y_m"].to_numpy()])
    score: Any = table["score"].to_numpy()
    of_image: dict[int, list[int]] = {}
    for k, key in enumerate(image.tolist()):
        of_image.setdefault(key, []).append(k)
    matched = []
    for key in range(len(t_s) * n):
        at, drone = divmod(key, n)
        found = np.array(of_image.get(key, []), np.int64)
        truth = (
            people_m[at][in_cone(people_m[at], position[at, drone], camera)] if looking[at, drone] else people_m[:0, 0]
        )
        if not len(found) and not len(truth):
            continue
        away_m = np.linalg.norm(spots[found][:, None] - truth[None], axis=-1)
        i, j = np.nonzero(away_m <= NEAR_M)
        order = best_pairs(spots[found][i], score[found][i], truth[j], -away_m[i, j])
        matched.append(Matched(score[found], hits(len(found), i[order], j[order]), len(truth)))
    if not any(m.truths for m in matched):
        return None
    return average_precision(matched)
