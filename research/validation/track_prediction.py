"""What it is worth that receivers move late boxes and tracks to their own time (`make figures FIGURE=track_prediction`).

The plan, committed before anything was measured:

- Flights. `track_target` for 24 s in eight towns, 61 … 68, with as many seeds. The trackers' constants were chosen in
  towns 7, 8 and 9, the model of lateness in the calibration's towns; none of the eight is in either. Surrogate detector.
- Exchange. From 4 s on, twice a second, each of the five drones fuses its own look and one payload of each peer, all of one
  age: 0.1, 0.2, 0.5, 1 or 2 s. Its own look is of that moment. Nothing is sent by radio. Every drone's tracker takes in its own detections at 10, and the
  default 2, looks a second.
- Arms. Alone; the peers' detections where they were; the peers' detections moved by the receiver's own tracks; the peers'
  tracks where they were; the peers' tracks moved by their own velocity. What is not moved is weighed by its age
  (`sortie.perception.lateness`), as before there were tracks. Both rules of `perception.join`.
- Figures. AP@0.5 of the full scene by town; a gain is the mean of the towns' own differences from the same payloads not
  moved, with Student's interval over towns. HOTA of the boxes after fusion, by a tracker over them.
- Expected: nothing at 0.1 s, and at 1 s a gain of detections and of tracks whose intervals lie above zero.

HOTA was measured for suppressed boxes (`nms`) first. Added before it was measured for averaged ones, with everything else as it
was: moving raises HOTA at every age, of detections and of tracks; moved tracks have a higher HOTA than a drone alone at every
age, as under suppression; and every arm with peers has a higher HOTA under averaging than under suppression.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from research.validation.stored import Column, Table
from sortie.perception.joining import EgoSources, Rule, SourceBoxes, joined_many
from sortie.perception.metrics.ap import average_precision, match_many
from sortie.perception.metrics.hota import Followed, hota
from sortie.perception.motion import Tracks
from sortie.perception.tracking.following import boxes_of, motion_of, motion_of_boxes
from sortie.perception.tracking.tracker import step
from sortie.perception.tracking.wire import content
from sortie.perception.types import Boxes, Capture
from sortie.scenarios.intervals import mean_interval
from sortie.scenarios.reading.load import load
from sortie.sim.engine.pilot import plan_of
from sortie.sim.engine.sortie import build

TOWNS = range(61, 69)
AGES = (1, 2, 5, 10, 20)
"""In frames of 0.1 s."""
LOOKS_HZ = (10, 2)
BEGIN, END, EVERY = 40, 240, 5
"""The first and the last frame, and how many there are from one fusion to the next."""
RULES: tuple[Rule, ...] = ("nms", "average")
ARMS = ("alone", "detections", "detections, moved", "tracks", "tracks, moved")


class Flight(NamedTuple):
    """One town, frame by frame and drone by drone."""

    captures: list[list[Capture]]
    own: list[list[Boxes]]
    truth: list[list[Boxes]]
    tracks: Mapping[int, list[list[Tracks]]]
    """By looks a second: what each drone follows after each frame."""


class Result(NamedTuple):
    """One arm in one town."""

    ap: float
    hota: float


def flown(town: int) -> Flight:
    """Own detections of every frame, and trackers over them."""
    sets = ["perception.detector=surrogate", f"duration_s={END / 10}", f"perception.scene.seed={town}", f"seed={town}"]
    scenario = load("track_target", sets)
    parts = build(scenario, plan_of(scenario.policy), town)
    drones, detector = range(scenario.fleet.drones), parts.detector
    assert detector is not None
    captures = [[parts.world.sensed(drone, frame).capture for drone in drones] for frame in range(END)]
    own = [detector.detect([(capture, ()) for capture in moment]) for moment in captures]
    truth = [[detector.truth(capture.t_s, capture) for capture in moment] for moment in captures]
    return Flight(captures, own, truth, {hz: followed(captures, own, 10 // hz) for hz in LOOKS_HZ})


def followed(captures: Sequence[Sequence[Capture]], own: Sequence[Sequence[Boxes]], every: int) -> list[list[Tracks]]:
    """Each drone's tracks after each frame, where its tracker looks every so many frames."""
    n = len(own[0])
    tracks, next_id, out = Tracks.empty(), np.zeros(n, np.int64), []
    for frame, boxes in enumerate(own):
        if frame % every == 0:
            owner = np.repeat(np.arange(n), [len(b) for b in boxes])
            looks_s = np.array([capture.t_s for capture in captures[frame]])
            tracks, next_id, _ = step(tracks, Boxes.join(boxes), owner, looks_s, next_id)
        out.append([tracks.take(tracks.owner == drone) for drone in range(n)])
    return out


def received(flight: Flight, frame: int, ego: int, age: int, hz: int, arm: str) -> list[SourceBoxes]:
    """What the peers sent `age` frames ago."""
    out: list[SourceBoxes] = []
    for peer, capture in enumerate(flight.captures[frame - age]):
        if peer == ego or arm == "alone":
            continue
        age_s, kind, moved = age / 10, arm.partition(",")[0], arm.endswith("moved")
        velocity = variance = None
        if kind == "detections":
            boxes = flight.own[frame - age][peer]
            if moved:
                velocity, variance = motion_of_boxes(boxes, capture.t_s, age_s, flight.tracks[hz][frame][ego])
        else:
            tracks = content(flight.tracks[hz][frame - age][peer], None, capture.est_position_m, capture.t_s)
            boxes = boxes_of(tracks)
            if moved:
                velocity, variance = motion_of(tracks, age_s)
        cut = kind == "tracks"
        out.append(SourceBoxes(boxes, 1.0, capture.est_pose, None, cut, age_s, velocity, variance))
    return out


def judged(flight: Flight, age: int, hz: int, arm: str, rule: Rule) -> Result:
    """AP and HOTA of all drones' boxes after fusion."""
    frames, n = range(BEGIN, END, EVERY), len(flight.own[0])
    egos = [
        EgoSources(flight.captures[f][e].est_pose, flight.own[f][e], False, received(flight, f, e, age, hz, arm))
        for f in frames
        for e in range(n)
    ]
    found = joined_many(egos, rule)
    truth = [flight.truth[f][e] for f in frames for e in range(n)]
    ap = average_precision(match_many(found, truth))
    cars = Followed(
        np.concatenate([t.table() for t in truth]),
        np.repeat(np.arange(len(truth)), [len(t) for t in truth]),
        np.concatenate([t.car.astype(np.int64) * n + k % n for k, t in enumerate(truth)]),
        np.concatenate([t.kind for t in truth]),
    )
    value = hota(cars, tracked(found, [f / 10 for f in frames], n))
    assert value is not None
    return Result(ap, value.hota)


def tracked(found: Sequence[Boxes], instants_s: Sequence[float], drones: int) -> Followed:
    """A tracker over each drone's boxes after fusion: its confirmed tracks that got a box, as the outcome has them."""
    tracks, next_id, told = Tracks.empty(), np.zeros(drones, np.int64), []
    for k, t_s in enumerate(instants_s):
        boxes = found[k * drones : (k + 1) * drones]
        owner = np.repeat(np.arange(drones), [len(b) for b in boxes])
        tracks, next_id, _ = step(tracks, Boxes.join(boxes), owner, np.full(drones, t_s), next_id)
        seen = tracks.take(tracks.confirmed & (tracks.seen_s == t_s))
        box = np.column_stack([seen.xy_m, seen.size_m, seen.yaw_rad])
        told.append((box, k * drones + seen.owner, seen.id * drones + seen.owner, seen.kind))
    return Followed(*(np.concatenate(c) for c in zip(*told, strict=True)))


def measure(towns: Sequence[int] = TOWNS) -> dict[tuple[Rule, int, int, str], list[Result]]:
    """Every arm in every town, by rule, age in frames, looks a second and arm."""
    out: dict[tuple[Rule, int, int, str], list[Result]] = {}
    for town in towns:
        flight = flown(town)
        for rule in RULES:
            for age in AGES:
                for hz in LOOKS_HZ:
                    for arm in ARMS:
                        # boxes that stay where they were need no tracker, and alone there is no age
                        same = (rule, AGES[0], LOOKS_HZ[0], arm) if arm == "alone" else (rule, age, LOOKS_HZ[0], arm)
                        key = rule, age, hz, arm
                        known = arm in ("alone", "detections") and key != same
                        value = out[same][-1] if known else judged(flight, age, hz, arm, rule)
                        out.setdefault(key, []).append(value)
    return out


def tables(towns: Sequence[int] = TOWNS) -> dict[str, Table]:
    """AP with the gain of moving, and HOTA."""
    results = measure(towns)

    def mean(rule: Rule, age: int, hz: int, arm: str, which: int) -> float:
        return float(np.mean([r[which] for r in results[rule, age, hz, arm]]))

    def gain(rule: Rule, age: int, hz: int, kind: str) -> tuple[float, float, float]:
        pairs = zip(results[rule, age, hz, f"{kind}, moved"], results[rule, age, hz, kind], strict=True)
        estimate = mean_interval([moved.ap - stayed.ap for moved, stayed in pairs])
        return estimate.mean, estimate.low, estimate.high

    about = f"{len(towns)} towns, 24 s each, five drones; intervals over towns."
    ap = [
        [
            rule, age / 10, hz, mean(rule, age, hz, "alone", 0), mean(rule, age, hz, "detections", 0),
            gain(rule, age, hz, "detections"), mean(rule, age, hz, "tracks", 0), gain(rule, age, hz, "tracks"),
        ]
        for rule in RULES
        for hz in LOOKS_HZ
        for age in AGES
    ]  # fmt: skip
    columns = [
        Column("join"), Column("age", "g", " s"), Column("looks a second"), Column("AP alone", ".3f"),
        Column("detections as they were", ".3f"), Column("moved", "+.1f", factor=100),
        Column("tracks as they were", ".3f"), Column("moved ", "+.1f", factor=100),
    ]  # fmt: skip
    hotas = [[rule, age / 10, *(mean(rule, age, 2, arm, 1) for arm in ARMS)] for rule in RULES for age in AGES]
    return {
        "track_prediction": Table(columns, ap, about),
        "track_prediction_hota": Table(
            [Column("join"), Column("age", "g", " s"), *(Column(arm, ".3f") for arm in ARMS)], hotas, f"HOTA. {about}"
        ),
    }
