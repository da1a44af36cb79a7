"""How misses hang together in a fleet: until the boxes of all drones joined gain what the detector's own gain.

What one pair of drones has in common tells too little: a car that two miss is missed by the others as well, more often
than pairs let expect. So the parts of the luck that are a car's own (`Parameters.alike`) are raised together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from perception.ap import Matched, average_precision, match
from perception.surrogate.collect import Asked
from perception.surrogate.detector import SurrogateDetector, join
from perception.surrogate.model import Parameters
from perception.surrogate.plan import draw_scene, scene_model
from perception.types import Capture, Share
from scenarios.schema import Perception

FACTORS = (1.0, 1.5, 2.0, 2.5, 3.0, 3.5)
MOST = 0.95
REPEATS = 2


def hang_together(
    parameters: Parameters, asked: Sequence[Asked], seed: int, threshold: float, tell: Callable[[int, int], None]
) -> Parameters:
    """The parameters with `alike` times that factor of 1 … 3.5 with which joined boxes gain most nearly what they should."""
    wanted, found = _gain(parameters, asked, seed, threshold, own=True), list[float]()
    for k, factor in enumerate(FACTORS):
        tell(k, len(FACTORS))
        found.append(_gain(_times(parameters, factor), asked, seed, threshold))
        if found[-1] <= wanted:
            break
    tell(len(FACTORS), len(FACTORS))
    # gains fall with the factor; the noise of few scenes apart
    falling = np.minimum.accumulate(found)
    return _times(parameters, float(np.interp(-wanted, -falling, FACTORS[: len(found)])))


def _times(parameters: Parameters, factor: float) -> Parameters:
    return replace(parameters, alike=np.minimum(parameters.alike * factor, MOST).astype(np.float32))


def _gain(parameters: Parameters, asked: Sequence[Asked], seed: int, threshold: float, *, own: bool = False) -> float:
    """AP of every drone's boxes joined with all others', minus AP of each alone: the surrogate's, or the detector's `own`."""
    alone, together = list[Matched](), list[Matched]()
    config = Perception(score_threshold=threshold)
    for a in asked:
        scene = scene_model(draw_scene(seed, a.split, a.scene))
        answers = [(j.ego, b) for j, b in zip(a.jobs, a.boxes, strict=True) if not j.shares]
        egos = [ego for ego, _ in answers]
        shares = [_from_others(ego, egos) for ego in egos]
        for repeat in range(1 if own else REPEATS):
            detector = SurrogateDetector.of(scene, config, parameters, scene.config.seed, repeat)
            truths = detector.truth_many([e.t_s for e in egos], egos)
            if own:
                boxes = [b.take(b.score >= threshold) for _, b in answers]
            else:
                boxes = list(detector.detect_many([[(ego, ())] for ego in egos]))
            by_drone = dict(zip(egos, boxes, strict=True))
            alone += [match(b, t) for b, t in zip(boxes, truths, strict=True)]
            together += [match(join(b, s, by_drone), t) for b, s, t in zip(boxes, shares, truths, strict=True)]
    return average_precision(together) - average_precision(alone)


def _from_others(ego: Capture, egos: Sequence[Capture]) -> tuple[Share, ...]:
    """Boxes from every drone that looks at the same moment."""
    return tuple(Share(o, "detections", 1.0, None, 1.0) for o in egos if o is not ego and o.t_s == ego.t_s)
