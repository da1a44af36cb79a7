"""What boxes of fused maps are worth where poses are corrected, too (`make figures FIGURE=corrected_frames`, `corrected_flights`,
`corrected_times`).

The plan, committed before any of these frames and flights was looked at. Receivers used to detect in each map that came, to
correct poses by the boxes that they found so. Now the boxes of the sender's own look go with its map for that
(`perception.match_poses`). It was tried on 40 frames of benchmark seed 13.

- Frames. The test split of benchmark seed 14, 120 scenes with one fleet-frame of five egos each; its layouts occur in no training.
  Intervals over scenes. As in `sent_boxes.py`: each drone fuses, sends what it found, and joins what the others found.
- Ways. With estimated poses: silence, averaged boxes, whole maps without and with boxes. With corrected poses: averaged boxes, and
  whole maps, a twentieth of the cells, and codes of 10 B in a twentieth, each without and with boxes.
- Flights. `track_target` for 16 s, scored once a second, in eight towns, 121 to 128, with as many seeds: `silence`, `boxes`, `boxes` with
  corrected poses, and `all-4` with a received budget of a twentieth, with boxes and corrected poses. AP of the full scene; the
  unit is the flight.
- Time. One ego with four whole maps, by the coarse network and by the fine one, and by this with the boxes of its four peers, with
  estimated and with corrected poses, in turn. All drones' own looks are there already, as each sends what it saw.

Expected:
1. Where poses are corrected, whole maps with boxes beat averaged boxes by 3 points.
2. A twentieth of the cells with boxes beats them by 2 points, and as codes by 1.5.
3. In flight a twentieth with boxes and corrected poses is 1.5 points better than `boxes` with corrected poses, and has less
   than twice the AP of `silence`.
4. An ego with four maps, boxes and corrected poses takes at most 1.5 times as long as the coarse network with four maps.

Added after the frames were measured, and before this was: on the same frames and with corrected poses, the boxes of the own look, which
come with each map in any case, are joined as well, in place of boxes of fused maps (`FIGURE=corrected_own_look`). Expected: whole
maps are then 2.5 points better than averaged boxes, and a point worse than with boxes of fused maps; codes of a
twentieth 1.5 points better, and half a point worse.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from research.benchmark.difficulty import Difficulty
from research.validation.sent_boxes import (
    BOXES,
    BUDGET,
    WEIGHTS,
    Way,
    flown,
    found_by_others,
    frame,
    frames,
    interval,
    own_look_table,
    shares,
)
from research.validation.stored import Column, Table, points
from sortie.perception.metrics.ap import average_precision
from sortie.perception.metrics.bootstrap import compare, rank
from sortie.perception.network.detector import TorchDetector
from sortie.scenarios.intervals import percentile_interval, resamples
from sortie.scenarios.schema import Perception

BENCH_SEED, SCENES = 14, 120
TOWNS = range(121, 129)
REPEATS = 60
SENT = ("features", 1.0), ("features", 0.05), ("codes", 0.05)
WAYS = (
    Way("none"), Way("detections"), *(Way("features", boxes=boxes) for boxes in (False, True)),
    Way("detections", matched=True), *(Way(sent, rho, boxes, matched=True) for sent, rho in SENT for boxes in (False, True)),
)  # fmt: skip


def frame_table() -> Table:
    """AP of each way on still frames, and its differences."""
    found = frames(SCENES, WAYS, BENCH_SEED)
    egos = len(found[WAYS[0]].matched)
    scene = np.repeat(np.arange(egos // 5), 5)
    rows: list[list[object]] = []
    for way, its in found.items():
        ap = average_precision(its.matched), *percentile_interval(rank(its.matched, scene).ap(resamples(egos // 5)))
        others = Way("detections", matched=way.matched), Way(way.sent, way.rho, matched=way.matched)
        over = [
            points(compare(found[other].matched, its.matched, scene)) if other != way and way.sent != "none" else None
            for other in others
        ]
        rows.append([way.label, float(np.mean(its.received_b)), ap, *over])
    columns = [Column("shared"), Column("an ego receives in a frame", ",.1f", " kB", 1e-3), Column("AP@0.5", ".3f")]
    columns += [Column(name, "+.1f", factor=100) for name in ("over averaged boxes, same poses", "gain from the boxes")]
    about = (
        f"{egos // 5} frames of the test split of benchmark seed {BENCH_SEED}, five egos each; intervals over scenes."
    )
    return Table(columns, rows, about)  # type: ignore[arg-type]


CORRECTED = "perception.match_poses=true"
ARMS: Mapping[str, tuple[str, ...]] = {
    "silence": ("silence",),
    "boxes": ("boxes",),
    "boxes, corrected poses": ("boxes", CORRECTED),
    "all-4, ρ = 0.05, with boxes, corrected poses": ("all-4", BUDGET, BOXES, CORRECTED),
}


def flight_table() -> Table:
    """AP of the full scene in flight."""
    flights = {arm: [flown(town, *changes) for town in TOWNS] for arm, changes in ARMS.items()}
    ap = {arm: [each for each, _ in its] for arm, its in flights.items()}
    silence = float(np.mean(ap["silence"]))
    rows: list[list[object]] = []
    for arm, each in ap.items():
        others = "silence", "boxes", "boxes, corrected poses"
        over = [None if other == arm else interval(np.subtract(each, ap[other]).tolist()) for other in others]
        mbps = float(np.mean([mbps for _, mbps in flights[arm]]))
        rows.append([arm, mbps, interval(each), float(np.mean(each)) / silence, *over])
    columns = [Column("policy"), Column("the fleet sends", ".2f", " MB/s"), Column("AP of the full scene", ".3f")]
    columns += [Column("times silence", ".2f")]
    names = "over silence", "over `boxes`", "over `boxes`, corrected poses"
    columns += [Column(name, "+.1f", factor=100) for name in names]
    about = f"`track_target` for 16 s, scored once a second; towns and seeds {TOWNS[0]} to {TOWNS[-1]}; intervals over flights."
    return Table(columns, rows, about)  # type: ignore[arg-type]


def times() -> Table:
    """One ego that has four whole maps: fusion and detection by both networks, with boxes and with corrected poses, in turn."""
    scene, fleet = frame(0, Difficulty(), BENCH_SEED)
    whole = Way("features")
    maps = list(shares(whole, fleet[0], fleet))
    coarse, fine, corrected = (
        TorchDetector(scene, Perception(match_poses=matched), 0, weights)
        for weights, matched in ((Path("disconet.safetensors"), False), (WEIGHTS, False), (WEIGHTS, True))
    )
    sent = fine.detect([(ego, list(shares(whole, ego, fleet))) for ego in fleet])
    bringing = [*maps, *found_by_others(0, fleet, sent)]
    each = {
        "coarse network": (coarse, maps),
        "fine network": (fine, maps),
        "fine network, with boxes": (fine, bringing),
        "fine network, with boxes, corrected poses": (corrected, bringing),
    }
    took_s: dict[str, list[float]] = {what: [] for what in each}
    for _ in range(REPEATS + 1):
        for what, (detector, its) in each.items():
            begin_s = time.perf_counter()
            detector.detect([(fleet[0], its)])
            took_s[what].append(time.perf_counter() - begin_s)
    rounds = np.array([its[1:] for its in took_s.values()])  # the first one encodes
    rows: list[list[object]] = [
        [what, statistics.median(its), float(np.median(its / rounds[0])), float(np.median(its / rounds[1]))]
        for what, its in zip(each, rounds, strict=True)
    ]
    columns = [Column("fused"), Column("one ego with four maps", ".0f", " ms", 1e3)]
    columns += [Column(f"times the {network} one", ".2f") for network in ("coarse", "fine")]
    about = f"Medians of {REPEATS} rounds, also of the ratios, which are of one round each. Every drone's own map and boxes are computed before."
    return Table(columns, rows, about)  # type: ignore[arg-type]


def own_look() -> Table:
    """Whole maps, and codes of a twentieth, with the boxes of each sender's own look."""
    return own_look_table((Way("features", matched=True), Way("codes", 0.05, matched=True)), BENCH_SEED, SCENES)
