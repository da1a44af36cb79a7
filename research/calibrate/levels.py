"""The last step of a fit: AP on the fitted scenes is matched to the torch detector's, group by group of jobs.

Networks that are fitted twice, from other starts, differ by 0.01 of AP: many small errors of how sure boxes are and where they
lie. What is left of them is taken out where AP feels it most directly, in how far boxes lie off: residuals are made longer or
shorter, by a factor for each of their pools, until the AP of every group of runs is met.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from research.calibrate.collect import DetectorRuns
from research.calibrate.correlation import scenes_of
from research.calibrate.plan import DetectorJob
from sortie.perception.metrics.ap import Matched, average_precision, match
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.surrogate.features import square
from sortie.perception.surrogate.model import FEW, KINDS, SQUARE, WHOLE, Parameters
from sortie.perception.types import Boxes
from sortie.scenarios.schema import Perception

Floats = NDArray[np.float64]

ROUNDS = 3
PROBE = 1.05
"""A factor on the residuals, to measure their cost in AP."""
GENTLE = 0.1
"""AP that residuals e times as long cost at the least: a smaller measured cost is mostly noise."""
DRAWS = 3
"""Replications of the surrogate. Many draws belong to a car and are the same for all drones, so few replications are a rough measure."""
BOUNDS = (0.7, 1.4)


def level(
    parameters: Parameters,
    recorded: Sequence[DetectorRuns],
    seed: int,
    threshold: float,
    report: Callable[[int, int], None],
) -> Parameters:
    """The parameters with residuals so long that every group's AP is the detector's; as they are where a group has no runs."""
    towns = scenes_of(recorded, seed)
    config = Perception(score_threshold=threshold)

    def detector(of: Parameters, k: int, draw: int) -> SurrogateDetector:
        scene, eyes = towns[k]
        return SurrogateDetector.of(scene, config, of, draw, eyes)

    runs = [_Runs.of(a, detector(parameters, a.scene, 0), threshold) for a in recorded]
    wanted = _by_group([pair for r in runs for pair in r.theirs])

    def over(factor: Floats) -> Floats:
        """By how much AP is too high."""
        some = longer(parameters, factor)
        found = [pair for r in runs for k in range(DRAWS) for pair in r.ours(detector(some, r.scene, k))]
        return np.nan_to_num(_by_group(found) - wanted)

    report(0, ROUNDS + 1)
    factor = np.ones(KINDS)
    now = over(factor)
    cost = np.maximum((now - over(factor * PROBE)) / np.log(PROBE), GENTLE)
    for k in range(ROUNDS):
        report(k + 1, ROUNDS + 1)
        factor = np.clip(factor * np.exp(now / cost), *BOUNDS)
        if k + 1 < ROUNDS:
            now = over(factor)
    report(ROUNDS + 1, ROUNDS + 1)
    return longer(parameters, factor)


def longer(parameters: Parameters, factor: Floats) -> Parameters:
    """Residuals of every pool so many times as long."""
    residuals = parameters.residuals.copy()
    residuals[..., :5] *= factor[:, None, None].astype(np.float32)
    return replace(parameters, residuals=residuals)


def group_of(job: DetectorJob) -> int | None:
    """The pool (`model.kind_of`) that most of the job's boxes draw residuals from: drones that fly square to the streets see
    square cars. None where it is no plain job: all it gets is of now, from everywhere, in full weight and at one budget."""
    along = int(square(np.asarray(job.ego.true_yaw_rad)) > SQUARE)
    if not job.shares:
        return along
    if job.unsent != "masked" or len({s.rho for s in job.shares}) > 1:
        return None
    for s in job.shares:
        if s.representation != "features" or s.roi or s.weight < 1.0 or s.missing or s.capture.t_s != job.ego.t_s:
            return None
    rho = job.shares[0].rho
    return 2 * (1 + (rho > FEW) + (rho > WHOLE)) + along


@dataclass(frozen=True, slots=True)
class _Runs:
    """The plain jobs of one moment: the group of each, the truth, and the detector's matches."""

    scene: int
    jobs: list[DetectorJob]
    groups: list[int]
    truths: list[Boxes]
    theirs: list[tuple[int, Matched]]

    @classmethod
    def of(cls, recorded: DetectorRuns, detector: SurrogateDetector, threshold: float) -> _Runs:
        found = [
            (j, g, b) for j, b in zip(recorded.jobs, recorded.boxes, strict=True) if (g := group_of(j)) is not None
        ]
        jobs, groups = [j for j, _, _ in found], [g for _, g, _ in found]
        truths = list(detector.truth_many([j.ego.t_s for j in jobs], [j.ego for j in jobs]))
        boxes = [b.take(b.score >= threshold) for _, _, b in found]
        theirs = [(g, match(b, t)) for g, b, t in zip(groups, boxes, truths, strict=True)]
        return cls(recorded.scene, jobs, groups, truths, theirs)

    def ours(self, detector: SurrogateDetector) -> list[tuple[int, Matched]]:
        """The surrogate's matches."""
        found = detector.detect_many([[(j.ego, j.shares)] for j in self.jobs])
        return [(g, match(b, t)) for g, b, t in zip(self.groups, found, self.truths, strict=True)]


def _by_group(matched: Sequence[tuple[int, Matched]]) -> Floats:
    """AP [kinds], NaN where there is nothing to find."""
    return np.array([average_precision([m for g, m in matched if g == k]) for k in range(KINDS)])
