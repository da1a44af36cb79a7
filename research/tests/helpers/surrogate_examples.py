"""What tests of the surrogate's fit share."""

from __future__ import annotations

from collections.abc import Callable

from research.calibrate.collect import DetectorRuns
from research.calibrate.plan import DetectorJob, moment, scene_model
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.surrogate.model import Parameters
from sortie.scenarios.schema import Perception


def detector_runs(
    parameters: Parameters, scenes: int, takes: Callable[[DetectorJob], bool] | None = None, draw: int = 5
) -> list[DetectorRuns]:
    """Detector runs made by a surrogate: those of drones alone, or of the jobs that `takes` accepts; `draw` keys its draws."""
    out = []
    for scene in range(scenes):
        jobs = [j for j in moment(0, "fit", scene, 0) if (takes(j) if takes else not j.shares)]
        detector = SurrogateDetector.of(scene_model(0, "fit", scene), Perception(score_threshold=0.1), parameters, draw)
        boxes = list(detector.detect_many([[(j.ego, j.shares)] for j in jobs]))
        out.append(DetectorRuns("fit", scene, jobs, boxes, {}))
    return out
