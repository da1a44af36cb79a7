"""What tests of the surrogate's fit share."""

from __future__ import annotations

from collections.abc import Callable

from sortie.perception.surrogate.collect import DetectorRuns
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.surrogate.model import Parameters
from sortie.perception.surrogate.plan import Question, moment, scene_model
from sortie.scenarios.schema import Perception


def asked(
    parameters: Parameters, scenes: int, takes: Callable[[Question], bool] | None = None, draw: int = 5
) -> list[DetectorRuns]:
    """What a surrogate would have answered where the detector is asked, of a drone alone or of the jobs that it `takes`;
    `draw` of its luck."""
    out = []
    for scene in range(scenes):
        jobs = [j for j in moment(0, "fit", scene, 0) if (takes(j) if takes else not j.shares)]
        detector = SurrogateDetector.of(scene_model(0, "fit", scene), Perception(score_threshold=0.1), parameters, draw)
        boxes = list(detector.detect_many([[(j.ego, j.shares)] for j in jobs]))
        out.append(DetectorRuns("fit", scene, jobs, boxes, {}))
    return out
