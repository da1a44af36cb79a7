"""Runs of the torch detector as rows to fit: each look, each fused car, and each false positive."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from research.calibrate.collect import DetectorRuns, captures_of
from research.calibrate.plan import scene_model
from sortie.perception import budget
from sortie.perception.geometry import to_local
from sortie.perception.scene.town import Floats
from sortie.perception.surrogate.exchange import (
    FeatureShares,
    Pairs,
    alarm_covariates,
    cell_of,
    covariates,
    mean_shift,
    pair,
)
from sortie.perception.surrogate.features import CaptureColumns, Eyes, Looks
from sortie.perception.types import Boxes

REACH_M = 2.5
"""A box within this of a car is of that car."""

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class FitRows:
    """Rows of one or more scenes.

    Looks (l): `look` [l, 19] covariates, `confidence` [l] of the car's best cell, `above` [l] the fraction of all cells that rank
    higher, `look_object` [l] which car of which scene, `look_cars` [l] how many its capture shows.
    Fusions (f): `fused` [f, 28] covariates, `score` [f] (0: no box), `offset` [f, 5] box against car (ahead, left, yaw, log
    length, log width), `xy_m` [f, 2] the car in the ego's frame, `heading` [f] and how it is turned there,
    `shift` [f, 2] the mean that its peers' maps are off.
    Jobs (j): `job` [j, …] covariates of false alarms; alarms (a): `alarm_job` [a], `alarm` [a, 6] (x, y of
    the ego's frame, length, width, yaw, score).
    """

    look: Array
    confidence: Array
    above: Array
    look_object: Array
    look_cars: Array
    fused: Array
    score: Array
    offset: Array
    xy_m: Array
    shift: Array
    heading: Array
    fused_job: Array
    fused_look: Array
    job: Array
    alarm_job: Array
    alarm: Array

    @classmethod
    def join(cls, several: list[FitRows]) -> FitRows:
        """All rows; jobs, looks and objects numbered on."""
        out: dict[str, list[Array]] = {f.name: [] for f in fields(cls)}
        jobs = looks = objects = 0
        for r in several:
            for f in fields(cls):
                shift = {"fused_job": jobs, "alarm_job": jobs, "fused_look": looks, "look_object": objects}.get(
                    f.name, 0
                )
                out[f.name].append(getattr(r, f.name) + shift)
            jobs, looks = jobs + len(r.job), looks + len(r.look)
            objects += int(r.look_object.max(initial=-1)) + 1
        return cls(**{name: np.concatenate(parts) for name, parts in out.items()})


def rows_of(recorded: DetectorRuns, floor: float, seed: int = 0) -> FitRows:
    """One moment's runs as rows; boxes below `floor` are dropped."""
    scene = scene_model(seed, recorded.split, recorded.scene)
    eyes = Eyes(scene)
    captures = captures_of(recorded.jobs)
    column = {c: i for i, c in enumerate(captures)}
    fleet = CaptureColumns.of(captures)
    looks = eyes.look(fleet)
    ranks = np.stack([recorded.ranks[c] for c in captures])
    r, c = cell_of(looks.xy_m)
    there = ranks[looks.capture[:, None], r, c]
    best = there.argmax(axis=1)
    n = np.arange(len(best))
    cell_r, cell_c = r[n, best], c[n, best]
    confidence = there[n, best]
    order = np.sort(ranks.reshape(len(captures), -1), axis=-1)
    above = np.array(
        [4096 - np.searchsorted(order[k], v, side="right") for k, v in zip(looks.capture, confidence, strict=True)]
    )

    jobs = [(j.ego, j.shares) for j in recorded.jobs]
    zeros = np.array([j.unsent == "zero" for j in recorded.jobs])
    exchange = FeatureShares.of(jobs, column)
    pairs = pair(exchange, looks, fleet)
    sent = _sent(recorded, pairs, cell_r, cell_c, column)
    rank = above[pairs.peer] / 4096.0
    fused = covariates(pairs, exchange, looks, confidence, sent, rank.astype(np.float32), zeros[pairs.row])
    late = np.array([any(not s.is_map for s in j.shares) for j in recorded.jobs])
    shift = mean_shift(pairs, exchange, sent)
    score, offset, alarms = [], [], []
    for m, (job, boxes) in enumerate(zip(recorded.jobs, recorded.boxes, strict=True)):
        mine = pairs.look[pairs.row == m]
        found, off, rest = assign_boxes(job.ego, boxes.take(boxes.score >= floor), looks, mine, eyes)
        score.append(found)
        offset.append(off)
        alarms.append(np.concatenate([np.full((len(rest), 1), m), rest], axis=1))
    keep = ~late[pairs.row]
    alarm = np.concatenate(alarms)
    alarm = alarm[~late[alarm[:, 0].astype(int)]]
    of_jobs = alarm_covariates(exchange, looks, fleet, zeros, scene.config)
    of_jobs[late] = np.nan  # boxes that were sent are worked out, not fitted
    return FitRows(
        looks.covariates, confidence, above / 4096.0, looks.car,
        np.bincount(looks.capture, minlength=len(captures))[looks.capture],
        fused[keep], np.concatenate(score)[keep], np.concatenate(offset)[keep], looks.xy_m[pairs.look][keep], shift[keep],
        (looks.yaw_rad[pairs.look] - fleet.yaw_rad[exchange.ego[pairs.row]])[keep],
        pairs.row[keep], pairs.look[keep], of_jobs, alarm[:, 0].astype(int), alarm[:, 1:],
    )  # fmt: skip


def _sent(
    recorded: DetectorRuns, pairs: Pairs, cell_r: Array, cell_c: Array, column: dict[Any, int]
) -> NDArray[np.bool_]:
    """Whether the cell of each pair's car was sent, by the detector's own choice."""
    sent = np.zeros(pairs.peer.shape, bool)
    for m, job in enumerate(recorded.jobs):
        mine = np.flatnonzero(pairs.row == m)
        slot = 0
        for s in job.shares:
            if not s.is_map or s.weight <= 0:
                continue
            mask = budget.select(recorded.ranks[s.capture], s.rho, s.roi, *s.capture.est_pose)
            peer = pairs.peer[mine, slot]
            sent[mine, slot] = (peer >= 0) & mask[cell_r[peer], cell_c[peer]]
            slot += 1
    return sent


def assign_boxes(ego: Any, boxes: Boxes, looks: Looks, mine: Array, eyes: Eyes) -> tuple[Array, Array, Array]:
    """Assign boxes to cars, best first: scores [cars] (0: none), offsets [cars, 5], and the false positives [a, 6]."""
    at: Floats = np.stack(to_local(boxes.xy_m[:, 0], boxes.xy_m[:, 1], ego.est_pose), axis=1)
    cars = looks.xy_m[mine]
    score, offset = np.zeros(len(mine)), np.zeros((len(mine), 5))
    rest = []
    car_yaw = looks.yaw_rad[mine] - ego.true_yaw_rad
    size = eyes.traffic.size_m[looks.car[mine]]
    for b in range(len(boxes)):  # they are best first
        away = np.hypot(*(cars - at[b]).T) + 1e3 * (score > 0)
        best = int(away.argmin()) if len(away) else -1
        turn = float(boxes.yaw_rad[b] - ego.est_yaw_rad)
        if best < 0 or away[best] > REACH_M:
            rest.append((*at[b], *boxes.size_m[b], turn, boxes.score[b]))
            continue
        score[best] = boxes.score[b]
        off = (turn - car_yaw[best] + np.pi / 2) % np.pi - np.pi / 2
        offset[best] = (*(at[b] - cars[best]), off, *np.log(boxes.size_m[b] / size[best]))
    return score, offset, np.array(rest).reshape(-1, 6)
