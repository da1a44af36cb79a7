"""What it is worth to send, with each map, the boxes that its sender found when it fused the maps of its peers (`make figures FIGURE=sent_boxes`).

The plan, committed before any of these frames and flights was looked at. The idea was tried on 50 scenes of the validation
split of benchmark seed 0, in two scenes of seed 12, and in 6 s over town 101.

- Frames. The test split of benchmark seed 13, 120 scenes with one fleet-frame of five egos each; its layouts occur in no training.
  Intervals over scenes. Each drone fuses its own look and what its four peers send of the same moment, through the detector
  that flies. Then it sends the boxes that it found to the four, and each drone joins them with its own. On still frames
  no time passes between the two.
- Ways. Silence, averaged boxes (each drone's by its own look alone), maps in four shares of the cells, and codes of 10 B in two;
  maps and codes with and without the boxes; boxes, whole maps and codes with corrected poses as well.
- Flights. `track_target` for 16 s, scored once a second, in eight towns, 111 to 118, with as many seeds: `silence`, `boxes`, and
  with a received budget of a twentieth `all-4` and `codes`, without and with `perception.maps_bring_boxes`. AP of the full
  scene; the unit is the flight.
- Time. One ego with four whole maps, without and with the boxes of its four peers, and with the coarse network, in turn (now in
  `corrected_boxes.py`).

Expected:
1. Whole maps with boxes beat averaged boxes by 3 points; where poses are corrected, by 2.
2. A fiftieth of the cells with boxes beats averaged boxes by 2 points, and as codes by 1.
3. In flight boxes add 5 points to a twentieth of the cells, which are then better than `boxes`.
4. In flight codes of a twentieth of the cells with boxes are better than `boxes`.
Added after the frames were measured, and before this was: the same maps with the boxes of each sender's own look, on the same frames.
They cost no further fusing, and part of the gain may come from any boxes. Expected: they gain half of what boxes of fused maps gain
with whole maps, and most of it with codes of a fiftieth of the cells; boxes of fused maps are a point better with either.

Time:
5. An ego with four maps and the boxes takes at most 1.1 times as long as without the boxes, and 1.6 times as long as with
   the coarse network.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from research.benchmark.difficulty import Difficulty
from research.benchmark.scenes import draw_captures, draw_scene
from research.validation.stored import Column, Table, points
from sortie.perception import budget
from sortie.perception.ground_truth import ground_truth
from sortie.perception.metrics.ap import Matched, average_precision, match
from sortie.perception.metrics.bootstrap import compare, rank
from sortie.perception.network.detector import TorchDetector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.intervals import mean_interval, percentile_interval, resamples
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Perception
from sortie.sim.engine.sortie import run_sortie
from sortie.sim.results.outcome import outcome

WEIGHTS = Path("fine.safetensors")
BENCH_SEED, SCENES = 13, 120
AREA_M = (-60.0, -60.0, 60.0, 60.0)
SHORT = ("duration_s=16", "perception.sample_rate_hz=1", f"perception.weights={WEIGHTS}")
TOWNS = range(111, 119)
CODE_BYTES = 10


@dataclass(frozen=True, slots=True)
class Way:
    """One way to share on still frames."""

    sent: str
    """A representation, or none."""
    rho: float = 1.0
    boxes: bool = False
    """Whether the boxes of fused maps are sent as well."""
    matched: bool = False

    @property
    def label(self) -> str:
        """In words."""
        maps = f"{'codes of 10 B' if self.sent == 'codes' else 'maps'}, ρ = {self.rho:g}"
        label = {"none": "silence", "detections": "averaged boxes"}.get(self.sent, maps)
        return label + ", with boxes" * self.boxes + ", corrected poses" * self.matched


MAPS = (*(Way("features", rho) for rho in (0.02, 0.05, 0.25, 1.0)), *(Way("codes", rho) for rho in (0.02, 0.05)))
MATCHED = Way("features", matched=True), Way("codes", 0.02, matched=True)
WAYS = (
    Way("none"), Way("detections"), *(w for way in MAPS for w in (way, replace(way, boxes=True))),
    Way("detections", matched=True), *(w for way in MATCHED for w in (way, replace(way, boxes=True))),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Found:
    """What one way found: one of each for every ego of every scene."""

    matched: list[Matched]
    received_b: list[float]
    """What an ego received, without headers."""


def frames(scenes: int, ways: Sequence[Way] = WAYS, seed: int = BENCH_SEED) -> Mapping[Way, Found]:
    """Every way on the test frames."""
    found = {way: Found([], []) for way in ways}
    for k in range(scenes):
        scene, fleet = frame(k, Difficulty(), seed)
        truths = [ground_truth(scene.cars_at(c.t_s).table(), c.true_pose) for c in fleet]
        alone: list[Boxes] = []
        for matched in dict.fromkeys(way.matched for way in ways):
            detector = TorchDetector(scene, Perception(match_poses=matched, code_bytes=CODE_BYTES), k, WEIGHTS)
            alone = alone or detector.detect([(ego, []) for ego in fleet])
            for way in (w for w in ways if w.matched == matched):
                looks = alone if way.sent == "detections" or (way.matched and way.sent != "none") else None
                sent = None
                fused = detector.detect([(ego, list(shares(way, ego, fleet))) for ego in fleet])
                if way.boxes:
                    sent, egos = fused, range(len(fleet))
                    fused = detector.detect([(fleet[i], [*shares(way, fleet[i], fleet), *found_by_others(i, fleet, sent)]) for i in egos])  # fmt: skip
                found[way].matched.extend(match(b, truth) for b, truth in zip(fused, truths, strict=True))
                found[way].received_b.extend(_received_b(way, i, (looks, sent), len(fleet)) for i in range(len(fleet)))
    return found


def frame(k: int, difficulty: Difficulty, seed: int) -> tuple[SceneModel, Sequence[Capture]]:
    """A scene of the test split, and a fleet's captures in it."""
    scene = SceneModel(draw_scene(seed, "test", k, difficulty), None, AREA_M)
    return scene, draw_captures(seed, "test", k, 0, difficulty)


def shares(way: Way, ego: Capture, fleet: Sequence[Capture]) -> Iterator[Share]:
    """What the peers of an ego send it."""
    for peer in fleet if way.sent != "none" else ():
        if peer is not ego:
            yield Share(peer, way.sent, way.rho, None, 1.0)


def found_by_others(ego: int, fleet: Sequence[Capture], found: Sequence[Boxes]) -> list[Share]:
    """The boxes that the peers found and sent."""
    return [Share(c, "detections", 0.0, None, 1.0, boxes=found[i]) for i, c in enumerate(fleet) if i != ego]


def _received_b(way: Way, ego: int, sent: Sequence[Sequence[Boxes] | None], drones: int) -> float:
    maps_b = 0
    if way.sent in ("features", "codes"):
        maps_b = budget.content_bytes(way.sent, cells=budget.cells_in(way.rho), code_bytes=CODE_BYTES)
    boxes = sum(len(b) for each in sent if each is not None for i, b in enumerate(each) if i != ego)
    return (drones - 1) * maps_b + budget.content_bytes("detections", boxes=boxes)


def frame_table(found: Mapping[Way, Found]) -> Table:
    """AP of each way, and its differences."""
    egos = len(found[WAYS[0]].matched)
    scene = np.repeat(np.arange(egos // 5), 5)
    rows: list[list[object]] = []
    for way, its in found.items():
        ap = average_precision(its.matched), *percentile_interval(rank(its.matched, scene).ap(resamples(egos // 5)))
        others = Way("detections", matched=way.matched), replace(way, boxes=False)
        over = [
            points(compare(found[other].matched, its.matched, scene)) if other != way and way.sent != "none" else None
            for other in others
        ]
        rows.append([way.label, float(np.mean(its.received_b)), ap, *over])
    columns = [Column("shared"), Column("an ego receives in a frame", ",.1f", " kB", 1e-3), Column("AP@0.5", ".3f")]
    names = "over averaged boxes, same poses", "gain from the boxes"
    columns += [Column(name, "+.1f", factor=100) for name in names]
    about = f"{SCENES} frames of the test split of benchmark seed {BENCH_SEED}, five egos each; intervals over scenes."
    return Table(columns, rows, about)  # type: ignore[arg-type]


OWN = Way("features"), Way("codes", 0.02)
"""Ways that are measured with the boxes of each sender's own look as well."""


def own_look_table(ways: Sequence[Way] = OWN, seed: int = BENCH_SEED, scenes: int = SCENES) -> Table:
    """Maps and codes with the boxes of the sender's own look, beside those of fused maps, on the same frames.

    Args: `ways`, all with estimated poses or all with corrected ones.
    """
    matched = ways[0].matched
    averaged = Way("detections", matched=matched).label
    found: dict[str, list[Matched]] = {}
    for k in range(scenes):
        scene, fleet = frame(k, Difficulty(), seed)
        truths = [ground_truth(scene.cars_at(c.t_s).table(), c.true_pose) for c in fleet]
        detector = TorchDetector(scene, Perception(code_bytes=CODE_BYTES, match_poses=matched), k, WEIGHTS)

        def joined(way: Way, boxes: Sequence[Boxes]) -> list[Boxes]:
            jobs = [(ego, [*shares(way, ego, fleet), *found_by_others(i, fleet, boxes)]) for i, ego in enumerate(fleet)]  # noqa: B023
            return detector.detect(jobs)  # noqa: B023

        alone = detector.detect([(ego, []) for ego in fleet])
        made = {averaged: joined(Way("none"), alone)}
        for way in ways:
            fused = detector.detect([(ego, list(shares(way, ego, fleet))) for ego in fleet])
            made[f"{way.label}, with boxes of the own look"] = joined(way, alone)
            made[f"{way.label}, with boxes"] = joined(way, fused)
        for label, each in made.items():
            found.setdefault(label, []).extend(match(b, truth) for b, truth in zip(each, truths, strict=True))
    scene_of = np.repeat(np.arange(scenes), 5)
    rows: list[list[object]] = []
    for label, its in found.items():
        ap = average_precision(its), *percentile_interval(rank(its, scene_of).ap(resamples(scenes)))
        own = f"{label} of the own look"
        over = [points(compare(found[other], its, scene_of)) if other in found and other != label else None
                for other in (averaged, own)]  # fmt: skip
        rows.append([label, ap, *over])
    names = "over averaged boxes", "over boxes of the own look"
    columns = [Column("shared"), Column("AP@0.5", ".3f"), *(Column(name, "+.1f", factor=100) for name in names)]
    about = f"The {scenes} frames of the table before; intervals over scenes."
    return Table(columns, rows, about)  # type: ignore[arg-type]


def draw(table: Table, path: Path) -> None:
    """AP over the bytes that an ego receives, from the table of frames."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    axes = figure.subplots()
    rows = {str(label): (received_b * 1e-3, ap) for label, received_b, ap, *_ in table.rows}
    axes.axhline(rows[Way("none").label][1][0], color="#7a7d85", lw=1, ls=":", label="silence")
    kinds = {"maps": ("features", "o"), "codes of 10 B": ("codes", "^"), "averaged boxes": ("detections", "s")}
    for kind, (sent, marker) in kinds.items():
        for boxes, colour in ((False, "#7a7d85"), (True, "#1d6f80")):
            ways = (w for w in WAYS if (w.sent, w.boxes, w.matched) == (sent, boxes, False))
            chosen = [rows[way.label] for way in ways]
            if chosen:
                x, (ap, low, high) = [v[0] for v in chosen], np.array([v[1] for v in chosen]).T
                label = kind + ", with boxes of fused maps" * boxes
                axes.errorbar(x, ap, yerr=[ap - low, high - ap], color=colour, marker=marker, capsize=2, label=label)
    axes.set_xscale("log")
    axes.set_xlabel("content that an ego receives in a frame from four peers, kB (logarithmic)")
    axes.set_ylabel("AP@0.5")
    axes.grid(alpha=0.3)
    figure.legend(fontsize=8, ncols=3, loc="outside lower center")
    figure.savefig(path, dpi=110)


BUDGET = "policy.params={received_budget: 0.05}"
BOXES = "perception.maps_bring_boxes=true"
ARMS: Mapping[str, tuple[str, ...]] = {
    "silence": ("silence",),
    "boxes": ("boxes",),
    "all-4, ρ = 0.05": ("all-4", BUDGET),
    "all-4, ρ = 0.05, with boxes": ("all-4", BUDGET, BOXES),
    "codes, ρ = 0.05": ("codes", BUDGET),
    "codes, ρ = 0.05, with boxes": ("codes", BUDGET, BOXES),
}


def flight_table() -> Table:
    """AP of the full scene in flight."""
    flights = {arm: [flown(town, *changes) for town in TOWNS] for arm, changes in ARMS.items()}
    ap = {arm: [each for each, _ in its] for arm, its in flights.items()}
    rows: list[list[object]] = []
    for arm, each in ap.items():
        others = "silence", "boxes", arm.replace(", with boxes", "")
        over = [None if other == arm else interval(np.subtract(each, ap[other]).tolist()) for other in others]
        rows.append([arm, float(np.mean([mbps for _, mbps in flights[arm]])), interval(each), *over])
    columns = [Column("policy"), Column("the fleet sends", ".2f", " MB/s"), Column("AP of the full scene", ".3f")]
    columns += [Column(name, "+.1f", factor=100) for name in ("over silence", "over `boxes`", "gain from the boxes")]
    about = f"`track_target` for 16 s, scored once a second; towns and seeds {TOWNS[0]} to {TOWNS[-1]}; intervals over flights."
    return Table(columns, rows, about)  # type: ignore[arg-type]


def flown(town: int, policy: str, *changes: str) -> tuple[float, float]:
    """AP of the full scene, and the payloads that the fleet sends, MB/s."""
    first = ("policy.params={}", f"policy.name={policy}", f"perception.scene.seed={town}")
    scenario = load("track_target", [*SHORT, *first, *changes])
    record = run_sortie(scenario, None, town)
    sent_b = record.tables["transmissions"]["payload_bytes"].to_numpy().sum()
    return float(outcome(record)["ap50"]["full_scene"]), float(sent_b / scenario.duration_s * 1e-6)


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """The mean over flights, with its interval."""
    found = mean_interval(values)
    return found.mean, found.low, found.high


def tables(picture: Path) -> dict[str, Table]:
    """What is found on still frames. Args: `picture`, file of the plot."""
    found = frame_table(frames(SCENES))
    draw(found, picture)
    return {"sent_frames": found}
