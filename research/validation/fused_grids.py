"""What it is worth to fuse maps on the grids of all drones, with the fine network, and what limits a fleet (`make figures FIGURE=fused_grids`).

The plan, committed before any of these frames and flights was looked at. `perception.fused_grids` was tried on the validation
split of benchmark seed 0, in two flights over other towns, and at 45 m on 40 scenes of seed 7's test layouts.

- Frames. The test split of benchmark seed 12, 120 scenes with one fleet-frame of five egos each; its layouts occur in no training.
  Intervals over scenes. Every ego has its own look and what its four peers send of the same moment, through the detector that flies.
- Ways. Silence, averaged detections, feature maps at four shares of the cells, codes of 10 B in a twentieth of them; maps and codes
  on the ego's grid alone and on all grids; detections, whole maps and a twentieth of them with corrected poses as well.
- A control. The gain may come from grids and not from sharing. So each drone also places its own map on four further grids of its own
  (shifted by half a cell along each axis, turned by 45° and 90°), and sends the boxes that it finds on all five, joined.
- Flights. `track_target` for 16 s, scored once a second, in eight towns, 101 to 108, with as many seeds: `silence`, `boxes`, and `all-4`
  with whole maps and with a received budget of a twentieth, on the ego's grid and on all; `boxes` and that budget with corrected poses
  as well. AP of the full scene; the unit is the flight. Also which cars an ego and any drone can see, by straight lines.
- Lower fleets. 60 of the same test scenes as they are, and with all drones 45 m up; whole maps on the ego's grid. Cars are counted by
  how many of the five drones can see them, and recall is measured in each group.

Expected:
1. Whole maps on all grids beat averaged boxes by 3 points; where poses are corrected, by 1.
2. All grids add 3 points to whole maps and 4 to a twentieth of the cells, as poses are believed.
3. A twentieth of the cells on all grids is at least as good as averaged boxes, as poses are believed.
4. The control is 1 to 3 points better than averaged boxes, and whole maps on all grids are a point better than the control.
5. In flight all grids add 4 points to a twentieth of the cells, which stay below `boxes`; with corrected poses too.
6. At 45 m recall is what recall by the number of drones that see a car predicts from the usual altitude, within 1 point.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from research.benchmark.difficulty import Difficulty
from research.benchmark.scenes import draw_captures, draw_scene
from research.benchmark.visibility import SEEN, inside, visible
from research.validation.stored import Column, Table, points
from sortie.perception.geometry import FULL
from sortie.perception.ground_truth import ground_truth
from sortie.perception.joining import SourceBoxes, joined
from sortie.perception.metrics.ap import Matched, average_precision, match
from sortie.perception.metrics.bootstrap import compare, rank
from sortie.perception.network.detector import Jobs, TorchDetector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.intervals import mean_interval, percentile_interval, resamples
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Perception
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome

WEIGHTS = Path("fine.safetensors")
BENCH_SEED, SCENES, LOW_SCENES, LOW_M = 12, 120, 60, 45.0
TOWNS = range(101, 109)
SHORT = ("duration_s=16", "perception.sample_rate_hz=1", f"perception.weights={WEIGHTS}")
REPEATS = 30
AREA_M = (-60.0, -60.0, 60.0, 60.0)
FURTHER_GRIDS = ((0.8, 0.0, 0.0), (0.0, 0.8, 0.0), (0.0, 0.0, np.pi / 4), (0.0, 0.0, np.pi / 2))
"""Shift east and north, m, and turn, of the control's grids."""


@dataclass(frozen=True, slots=True)
class Way:
    """One way to share on still frames."""

    sent: str
    """A representation, none, or control."""
    rho: float = 1.0
    grids: str = "own"
    matched: bool = False

    @property
    def boxes(self) -> Way:
        """Averaged boxes with the same poses."""
        return Way("detections", matched=self.matched)

    @property
    def on_own(self) -> Way:
        """The same on the ego's grid alone."""
        return Way(self.sent, self.rho, "own", self.matched)

    @property
    def label(self) -> str:
        """In words."""
        boxes = {
            "none": "silence",
            "detections": "averaged boxes",
            "control": "averaged boxes, of five grids a drone",
        }
        maps = f"{'codes of 10 B' if self.sent == 'codes' else 'maps'}, ρ = {self.rho:g}"
        return boxes.get(self.sent, maps) + ", all grids" * (self.grids == "all") + ", corrected poses" * self.matched


RHO, MATCHED_RHO = (0.02, 0.05, 0.25, 1.0), (0.05, 1.0)
WAYS = (
    Way("none"), Way("detections"), Way("control"),
    *(Way("features", rho, grids) for rho in RHO for grids in ("own", "all")),
    *(Way("codes", 0.05, grids) for grids in ("own", "all")),
    Way("detections", matched=True),
    *(Way("features", rho, grids, True) for rho in MATCHED_RHO for grids in ("own", "all")),
)  # fmt: skip
Found = Mapping[Way, Sequence[Matched]]
"""One for each ego of each scene."""


def frames(scenes: int, ways: Sequence[Way] = WAYS) -> Found:
    """Every way on the test frames."""
    found: dict[Way, list[Matched]] = {way: [] for way in ways}
    difficulty = Difficulty()
    for k in range(scenes):
        scene, fleet = frame(k, difficulty)
        truths = [ground_truth(scene.cars_at(c.t_s).table(), c.true_pose) for c in fleet]
        for grids, matched in dict.fromkeys((way.grids, way.matched) for way in ways):
            config = Perception(fused_grids=grids, match_poses=matched, code_bytes=10)
            detector = TorchDetector(scene, config, k, WEIGHTS)
            for way in (w for w in ways if (w.grids, w.matched) == (grids, matched)):
                boxes = _control(detector, fleet) if way.sent == "control" else _detected(detector, way, fleet)
                found[way] += [match(b, truth) for b, truth in zip(boxes, truths, strict=True)]
    return found


def frame(k: int, difficulty: Difficulty, seed: int = BENCH_SEED) -> tuple[SceneModel, Sequence[Capture]]:
    """A scene of the test split, and a fleet's captures in it."""
    scene = SceneModel(draw_scene(seed, "test", k, difficulty), None, AREA_M)
    return scene, draw_captures(seed, "test", k, 0, difficulty)


def _detected(detector: TorchDetector, way: Way, fleet: Sequence[Capture]) -> list[Boxes]:
    return detector.detect([(ego, list(_shares(way, ego, fleet))) for ego in fleet])


def _shares(way: Way, ego: Capture, fleet: Sequence[Capture]) -> Iterator[Share]:
    for peer in fleet if way.sent != "none" else ():
        if peer is not ego:
            yield Share(peer, way.sent, way.rho, None, 1.0)


def _control(detector: TorchDetector, fleet: Sequence[Capture]) -> list[Boxes]:
    """Averaged boxes, of drones that each place their own map on further grids."""
    own: list[Boxes] = []
    for drone in fleet:
        (x, y, z), yaw, share = drone.est_position_m, drone.est_yaw_rad, Share(drone, "features", 1.0, None, 1.0)
        grids = [
            drone._replace(est_position_m=(x + east_m, y + north_m, z), est_yaw_rad=yaw + turn, looked=False)
            for east_m, north_m, turn in FURTHER_GRIDS
        ]
        alone, *others = detector.detect([(drone, []), *((grid, [share]) for grid in grids)])
        sources = [SourceBoxes(b, 1.0, grid.est_pose) for b, grid in zip(others, grids, strict=True)]
        own.append(joined(drone.est_pose, alone, False, sources, "average"))
    sources = [SourceBoxes(b, 1.0, c.est_pose) for b, c in zip(own, fleet, strict=True)]
    return [joined(c.est_pose, own[k], False, sources[:k] + sources[k + 1 :], "average") for k, c in enumerate(fleet)]


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
            for other in (way.boxes, way.on_own, Way("control"))
        ]
        rows.append([way.label, ap, *over])
    names = "over averaged boxes, same poses", "gain from all grids", "over boxes of five grids"
    columns = [Column("shared"), Column("AP@0.5", ".3f"), *(Column(name, "+.1f", factor=100) for name in names)]
    return Table(columns, rows, about)  # type: ignore[arg-type]


def lower_table(scenes: int = LOW_SCENES) -> Table:
    """Recall by how many drones see a car, at the usual altitude and lower, and what the first predicts for the second."""
    usual, low = (_recall(scenes, d) for d in (Difficulty(), Difficulty(altitude_m=(LOW_M, LOW_M))))
    rows: list[list[object]] = []
    for by in range(6):
        each = [(cars[by] / cars.sum(), hits[by] / cars[by]) for cars, hits in (usual, low)]
        rows.append([str(by), *each[0], *each[1]])
    all_usual, all_low = (hits.sum() / cars.sum() for cars, hits in (usual, low))
    rows.append(["all", 1.0, all_usual, 1.0, all_low])
    predicted = float((usual[1] / usual[0] * low[0]).sum() / low[0].sum())
    rows.append(["all, predicted by the recall at 55 to 65 m", None, None, 1.0, predicted])
    columns = [Column("drones that see a car")]
    for where in ("55 to 65 m", f"{LOW_M:g} m"):
        columns += [Column(f"cars, {where}", ".0f", " %", 100), Column(f"recall, {where}", ".3f")]
    about = f"{scenes} frames of the test split of benchmark seed {BENCH_SEED}; whole maps on the ego's grid; every box that is kept counts."
    return Table(columns, rows, about)  # type: ignore[arg-type]


def _recall(scenes: int, difficulty: Difficulty) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Cars by how many drones see them, 0 … 5, and how many of these are found."""
    cars_by, hits_by = np.zeros(6), np.zeros(6)
    for k in range(scenes):
        scene, fleet = frame(k, difficulty)
        boxes = _detected(TorchDetector(scene, Perception(), k, WEIGHTS), Way("features"), fleet)
        cars = scene.cars_at(fleet[0].t_s)
        seen_by = np.stack([visible(scene, c, cars) >= SEEN for c in fleet]).sum(axis=0)
        for ego, its in zip(fleet, boxes, strict=True):
            counted = inside(ego, cars, FULL.half_extent_m)
            truth = ground_truth(cars.table(), ego.true_pose)
            for by in range(6):
                which = seen_by[counted] == by
                cars_by[by] += which.sum()
                hits_by[by] += match(its, truth.take(which)).hit.sum()
    return cars_by, hits_by


BUDGET = "policy.params={received_budget: 0.05}"
ARMS: Mapping[str, tuple[str, ...]] = {
    "silence": ("silence",),
    "boxes": ("boxes",),
    "all-4": ("all-4",),
    "all-4, all grids": ("all-4", "perception.fused_grids=all"),
    "all-4, ρ = 0.05": ("all-4", BUDGET),
    "all-4, ρ = 0.05, all grids": ("all-4", BUDGET, "perception.fused_grids=all"),
    "boxes, corrected poses": ("boxes", "perception.match_poses=true"),
    "all-4, ρ = 0.05, corrected poses": ("all-4", BUDGET, "perception.match_poses=true"),
    "all-4, ρ = 0.05, all grids, corrected poses": ("all-4", BUDGET, "perception.fused_grids=all", "perception.match_poses=true"),
}  # fmt: skip


def flight_table() -> Table:
    """AP of the full scene in flight."""
    ap = {arm: [_flown(town, *changes) for town in TOWNS] for arm, changes in ARMS.items()}
    rows: list[list[object]] = []
    for arm, each in ap.items():
        its_boxes = "boxes" + ", corrected poses" * arm.endswith("poses")
        others = "silence", its_boxes, arm.replace(", all grids", "")
        over = [None if other == arm else interval(np.subtract(each, ap[other]).tolist()) for other in others]
        rows.append([arm, interval(each), *over])
    columns = [Column("policy"), Column("AP of the full scene", ".3f")]
    columns += [Column(name, "+.1f", factor=100) for name in ("over silence", "over `boxes`, same poses", "gain from all grids")]  # fmt: skip
    about = f"`track_target` for 16 s, scored once a second; towns and seeds {TOWNS[0]} to {TOWNS[-1]}; intervals over flights."
    return Table(columns, rows, about)  # type: ignore[arg-type]


def _flown(town: int, policy: str, *changes: str) -> float:
    first = ("policy.params={}", f"policy.name={policy}", f"perception.scene.seed={town}")
    scenario = load("track_target", [*SHORT, *first, *changes])
    return float(outcome(run_sortie(scenario, None, town))["ap50"]["full_scene"])


def seen_table() -> Table:
    """The shares of the cars that an ego sees, and that any of the five drones sees, in the same flights."""
    shares = [_seen(town) for town in TOWNS]
    rows: list[list[object]] = [[who, interval(each)] for who, each in zip(("the ego", "any of the five"), np.transpose(shares), strict=True)]  # fmt: skip
    about = "The flights over towns 101 to 108 above, at every scored moment; by line of sight, without any detector; intervals over flights."
    return Table([Column("who sees a car"), Column("share of the cars", ".1f", " %", 100)], rows, about)  # type: ignore[arg-type]


def _seen(town: int) -> tuple[float, float]:
    cars_seen = np.zeros(3)

    class Counting(TorchDetector):
        def begin(self, jobs: Jobs) -> Callable[[], list[Boxes]]:
            egos = [ego for ego, _ in jobs]
            for cars in {ego.t_s: self._scene.cars_at(ego.t_s) for ego in egos}.values():
                seen = np.stack([visible(self._scene, ego, cars) >= SEEN for ego in egos])
                for ego, own in zip(egos, seen, strict=True):
                    counted = inside(ego, cars, FULL.half_extent_m)
                    cars_seen[:] += counted.sum(), own[counted].sum(), seen.any(axis=0)[counted].sum()
            return lambda: [Boxes.empty()] * len(egos)

    scenario = load("track_target", [*SHORT, f"perception.scene.seed={town}", "policy.name=silence", "policy.params={}"])  # fmt: skip
    run_sortie(scenario, None, town, detector_of=lambda scene, config, seed, _: Counting(scene, config, seed, WEIGHTS))
    return float(cars_seen[1] / cars_seen[0]), float(cars_seen[2] / cars_seen[0])


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """The mean over flights, with its interval."""
    found = mean_interval(values)
    return found.mean, found.low, found.high


def times() -> Table:
    """One ego that has four whole maps: fusion and detection, on its own grid and on all, in turn."""
    scene, fleet = frame(0, Difficulty())
    job = [(fleet[0], list(_shares(Way("features"), fleet[0], fleet)))]
    detectors = {grids: TorchDetector(scene, Perception(fused_grids=grids), 0, WEIGHTS) for grids in ("own", "all")}
    took_s: dict[str, list[float]] = {grids: [] for grids in detectors}
    for _ in range(REPEATS + 1):
        for grids, detector in detectors.items():
            begin_s = time.perf_counter()
            detector.detect(job)
            took_s[grids].append(time.perf_counter() - begin_s)
    median_s = {grids: statistics.median(each[1:]) for grids, each in took_s.items()}  # the first one encodes
    rows: list[list[object]] = [[grids, took, took / median_s["own"]] for grids, took in median_s.items()]
    columns = [
        Column("grids"),
        Column("one ego with four maps", ".0f", " ms", 1e3),
        Column("times its own grid", ".1f"),
    ]
    return Table(columns, rows, f"Medians of {REPEATS}; the maps are encoded already.")  # type: ignore[arg-type]


def tables() -> dict[str, Table]:
    """All of it."""
    about = f"{SCENES} frames of the test split of benchmark seed {BENCH_SEED}, five egos each; intervals over scenes."
    found = frame_table(frames(SCENES), about)
    return {
        "grid_frames": found,
        "grid_flights": flight_table(),
        "seen_in_flight": seen_table(),
        "lower_fleet": lower_table(),
    }
