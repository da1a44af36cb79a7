"""What reading each map alone as well is worth, with the fine network (`make figures FIGURE=read_maps`).

The plan, committed before any of these frames and flights was looked at. `LEAST_READ` and the weight of the ego's boxes were
chosen on 12 frames of the validation split of benchmark seed 0, and one flight over another town was looked at.

- Frames. The test split of benchmark seed 10, 120 scenes with one fleet-frame of five egos each; its layouts occur in no training.
  Intervals over scenes. Every ego has its own look and what its four peers send of the same moment, through the detector that flies.
- Ways. Silence, averaged detections, a quarter of each map and whole maps; maps with and without `perception.read_maps`; all but
  silence and the quarter with and without `perception.match_poses`.
- Flights. `track_target` for 16 s, scored once a second, in eight towns, 81 to 88, with as many seeds: `boxes`, and `all-4` with and
  without reading; each with and without corrected poses. AP of the full scene; the unit is the flight.

Expected: whole maps that are read beat averaged boxes by 3 points, as poses are believed and where they are corrected; reading adds a
point to whole maps, and takes nothing from a quarter of them; in flight it raises the AP of `all-4`, which stays below that of `boxes`.

Measured twice: first with a score threshold of 0.1, then the default, and again with 0.25, the default now. Frames, flights, ways and
expectations are the same; this line was written before anything of the second time was looked at.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from stored import Column, Table, points

from sortie.perception.benchmark.difficulty import Difficulty
from sortie.perception.benchmark.scenes import draw_captures, draw_scene
from sortie.perception.ground_truth import ground_truth
from sortie.perception.metrics.ap import Matched, average_precision, match
from sortie.perception.metrics.bootstrap import compare, rank
from sortie.perception.network.detector import TorchDetector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Capture, Share
from sortie.scenarios.intervals import mean_interval, percentile_interval, resamples
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Perception
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome

WEIGHTS = Path("fine.safetensors")
BENCH_SEED, SCENES = 10, 120
TOWNS = range(81, 89)
AREA_M = (-60.0, -60.0, 60.0, 60.0)


@dataclass(frozen=True, slots=True)
class Way:
    """One way to share on still frames."""

    sent: str
    """A representation, or none."""
    rho: float = 0.0
    read: bool = False
    matched: bool = False

    @property
    def plain(self) -> Way:
        """The same maps, which are not read alone."""
        return Way(self.sent, self.rho, False, self.matched)

    @property
    def boxes(self) -> Way:
        """Averaged boxes with the same poses."""
        return Way("detections", matched=self.matched)

    @property
    def label(self) -> str:
        """In words."""
        name = {"none": "silence", "detections": "averaged boxes"}.get(self.sent) or (
            "whole maps" if self.rho == 1.0 else f"maps, ρ = {self.rho:g}"
        )
        return name + ", read alone too" * self.read + ", corrected poses" * self.matched


WAYS = (
    Way("none"),
    Way("detections"), Way("features", 0.25), Way("features", 0.25, read=True), Way("features", 1.0),
    Way("features", 1.0, read=True),
    Way("detections", matched=True), Way("features", 1.0, matched=True), Way("features", 1.0, read=True, matched=True),
)  # fmt: skip
Found = Mapping[Way, Sequence[Matched]]
"""One for each ego of each scene."""


def frames(scenes: int, ways: Sequence[Way] = WAYS) -> Found:
    """Every way on the test frames."""
    found: dict[Way, list[Matched]] = {way: [] for way in ways}
    difficulty = Difficulty()
    for k in range(scenes):
        scene = SceneModel(draw_scene(BENCH_SEED, "test", k, difficulty), None, AREA_M)
        fleet = draw_captures(BENCH_SEED, "test", k, 0, difficulty)
        truths = [ground_truth(scene.cars_at(c.t_s).table(), c.true_pose) for c in fleet]
        for options in dict.fromkeys((way.read, way.matched) for way in ways):
            config = Perception(read_maps=options[0], match_poses=options[1])
            detector = TorchDetector(scene, config, k, WEIGHTS)
            for way in (w for w in ways if (w.read, w.matched) == options):
                boxes = detector.detect([(ego, list(_shares(way, ego, fleet))) for ego in fleet])
                found[way] += [match(b, truth) for b, truth in zip(boxes, truths, strict=True)]
    return found


def _shares(way: Way, ego: Capture, fleet: Sequence[Capture]) -> Iterator[Share]:
    for peer in fleet if way.sent != "none" else ():
        if peer is not ego:
            yield Share(peer, way.sent, way.rho, None, 1.0)


def frame_table(found: Found, about: str) -> Table:
    """AP of each way, and its differences."""
    egos = len(found[WAYS[0]])
    scene = np.repeat(np.arange(egos // 5), 5)
    rows: list[list[object]] = []
    for way, its in found.items():
        ap = average_precision(its), *percentile_interval(rank(its, scene).ap(resamples(egos // 5)))
        over = [
            points(compare(found[other], its, scene))
            if other in found and other != way and way.sent != "none"
            else None
            for other in (way.boxes, way.plain)
        ]
        rows.append([way.label, ap, *over])
    columns = [Column("shared"), Column("AP@0.5", ".3f")]
    columns += [Column(name, "+.1f", factor=100) for name in ("over averaged boxes, same poses", "by reading")]
    return Table(columns, rows, about)  # type: ignore[arg-type]


ARMS = {
    (policy, read, matched): (policy, f"perception.read_maps={str(read).lower()}", f"perception.match_poses={str(matched).lower()}")
    for matched in (False, True)
    for policy, read in (("boxes", False), ("all-4", False), ("all-4", True))
}  # fmt: skip


def flight_table() -> Table:
    """AP of the full scene in flight."""
    ap = {arm: [_flown(town, *changes) for town in TOWNS] for arm, changes in ARMS.items()}
    rows: list[list[object]] = []
    for (policy, read, matched), each in ap.items():
        over = [
            None if other == (policy, read, matched) else _interval(np.subtract(each, ap[other]).tolist())
            for other in (("boxes", False, matched), (policy, False, matched))
        ]
        rows.append([policy + ", maps read alone too" * read + ", corrected poses" * matched, _interval(each), *over])
    columns = [Column("policy"), Column("AP of the full scene", ".3f")]
    columns += [Column(name, "+.1f", factor=100) for name in ("over `boxes`, same poses", "by reading")]
    about = f"`track_target` for 16 s, scored once a second; towns and seeds {TOWNS[0]} to {TOWNS[-1]}; intervals over flights."
    return Table(columns, rows, about)  # type: ignore[arg-type]


def _flown(town: int, policy: str, *changes: str) -> float:
    short = ("duration_s=16", "perception.sample_rate_hz=1", f"perception.weights={WEIGHTS}")
    scenario = load("track_target", [*short, f"perception.scene.seed={town}", *changes])
    return float(outcome(run_sortie(scenario, policy, town))["ap50"]["full_scene"])


def _interval(values: Sequence[float]) -> tuple[float, float, float]:
    found = mean_interval(values)
    return found.mean, found.low, found.high


def tables() -> dict[str, Table]:
    """All of it."""
    about = f"{SCENES} frames of the test split of benchmark seed {BENCH_SEED}, five egos each; intervals over scenes."
    return {"read_frames": frame_table(frames(SCENES), about), "read_flights": flight_table()}
