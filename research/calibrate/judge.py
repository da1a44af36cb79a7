"""The surrogate's error against the torch detector, on scenes that it was not fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from research.calibrate.collect import DetectorRuns
from research.calibrate.plan import THRESHOLD, DetectorJob, scene_model
from sortie.perception.metrics.ap import Matched, average_precision, match
from sortie.perception.metrics.bootstrap import compare, rank
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.surrogate.model import Parameters
from sortie.scenarios.disc import Disc
from sortie.scenarios.intervals import percentile_interval, resamples
from sortie.scenarios.schema import Perception

WITHIN = 0.02
"""The error of AP that a calibration is to keep."""
REPEATS = 4
IN_DISC = ", in the disc"
CONTRASTS = (
    ("alone", "all-4, ρ = 0.01"), ("alone", "all-4, ρ = 0.25"), ("alone", "all-4, ρ = 0.25, 32 m"), ("alone", "detections"),
    ("all-4, ρ = 0.05", "all-4, ρ = 0.25"), ("all-4, ρ = 0.25", "all-4, ρ = 1"), ("detections", "all-4, ρ = 0.25"),
    ("nearest 2, ρ = 0.5", "all-4, ρ = 0.25"), ("farthest 2, ρ = 0.5", "all-4, ρ = 0.25"),
    ("detections", "detections, averaged"), ("all-4, ρ = 1", "detections, averaged"),
    ("nearest 2, ρ = 0.5", "farthest 2, ρ = 0.5"), ("all-4, ρ = 0.25, 0.4 s older", "all-4, ρ = 0.25"),
    ("all-4, ρ = 0.25, zeros", "all-4, ρ = 0.25"),
    *((f"street: {a}{where}", f"street: {b}{where}") for where in ("", IN_DISC) for a, b in (
        ("alone", "all-4, ρ = 0.025"), ("alone", "detections"), ("all-4, ρ = 0.025", "all-4, ρ = 0.35"),
        ("detections", "all-4, ρ = 0.35"), ("detections", "detections, averaged"), ("all-4, ρ = 0.35", "detections, averaged"),
        ("all-4, ρ = 0.1, 32 m", "all-4, ρ = 0.1"),
    )),
)  # fmt: skip
"""Policies whose order is judged, in pairs."""


@dataclass(frozen=True, slots=True)
class LevelError:
    """One condition's AP@0.5 by both, on `egos` moments; the error with its 95 % interval by whole scenes."""

    condition: str
    torch: float
    surrogate: float
    error: float
    low: float
    high: float
    egos: int


@dataclass(frozen=True, slots=True)
class OrderKept:
    """AP of b minus AP of a by both; the torch detector's with its 95 % interval by whole scenes."""

    a: str
    b: str
    torch: float
    low: float
    high: float
    surrogate: float

    @property
    def significant(self) -> bool:
        return self.low > 0.0 or self.high < 0.0  # without an interval, of a single scene, it is not

    @property
    def kept(self) -> bool:
        """Whether the surrogate has the same sign, where the torch detector's contrast is significant."""
        return not self.significant or self.torch * self.surrogate > 0


@dataclass(frozen=True, slots=True)
class CalibrationVerdict:
    """All levels and orders."""

    levels: list[LevelError]
    orders: list[OrderKept]

    def facts(self) -> dict[str, Any]:
        """As JSON."""
        orders = [{**asdict(o), "significant": o.significant, "kept": o.kept} for o in self.orders]
        return {"levels": [asdict(v) for v in self.levels], "orders": orders}


def judge(parameters: Parameters, held_out: Sequence[DetectorRuns], seed: int = 0) -> CalibrationVerdict:
    """Both detectors' AP under every condition of the held-out scenes; the surrogate's over several replications."""
    theirs: dict[str, list[Matched]] = {}
    ours: dict[str, list[Matched]] = {}
    scenes: dict[str, list[int]] = {}
    drawn: dict[str, list[int]] = {}
    for recorded in held_out:
        scene = scene_model(seed, recorded.split, recorded.scene)
        truths = None
        for rules in dict.fromkeys((j.unsent, j.join) for j in recorded.jobs):
            config = Perception(unsent_cells=rules[0], join=rules[1], score_threshold=THRESHOLD)
            mine = [i for i, j in enumerate(recorded.jobs) if (j.unsent, j.join) == rules]
            for repeat in range(REPEATS):
                detector = SurrogateDetector.of(scene, config, parameters, repeat)
                if truths is None:
                    truths = list(
                        detector.truth_many([j.ego.t_s for j in recorded.jobs], [j.ego for j in recorded.jobs])
                    )
                jobs = [[(recorded.jobs[i].ego, recorded.jobs[i].shares)] for i in mine]
                for i, boxes in zip(mine, detector.detect_many(jobs), strict=True):
                    for name, disc in _regions(recorded.jobs[i]):
                        ours.setdefault(name, []).append(match(boxes, truths[i], disc))
                        drawn.setdefault(name, []).append(recorded.scene)
                        if repeat == 0:
                            found = recorded.boxes[i]
                            if recorded.jobs[i].join == "nms":  # weak boxes took no part in averaged ones
                                found = found.take(found.score >= THRESHOLD)
                            theirs.setdefault(name, []).append(match(found, truths[i], disc))
                            scenes.setdefault(name, []).append(recorded.scene)
    levels = [_level(name, theirs[name], ours[name], scenes[name], drawn[name]) for name in theirs]
    ap = {v.condition: v.surrogate for v in levels}
    orders = []
    for a, b in (pair for pair in CONTRASTS if ap.keys() >= set(pair)):
        d = compare(theirs[a], theirs[b], scenes[a])
        orders.append(OrderKept(a, b, d.delta, d.low, d.high, ap[b] - ap[a]))
    return CalibrationVerdict(levels, orders)


def _level(
    name: str, theirs: Sequence[Matched], ours: Sequence[Matched], scenes: Sequence[int], drawn: Sequence[int]
) -> LevelError:
    torch, surrogate = rank(theirs, scenes), rank(ours, drawn)
    weights = resamples(len(torch.truths))
    a, b = average_precision(theirs), average_precision(ours)
    low, high = percentile_interval(surrogate.ap(weights) - torch.ap(weights))
    return LevelError(name, a, b, b - a, low, high, len(theirs))


def _regions(job: DetectorJob) -> list[tuple[str, Disc | None]]:
    """Where the job's condition is judged, and under which name."""
    everywhere: list[tuple[str, Disc | None]] = [(job.condition, None)]
    return everywhere if job.disc is None else [*everywhere, (job.condition + IN_DISC, job.disc)]
