"""How misses and false alarms hang together in a fleet.

Of misses, what one pair of drones has in common tells too little: a car that two miss is missed by the others as well, more
often than pairs let expect. So the parts of the luck that are a car's own (`Parameters.alike`) are raised together, until the
boxes of all drones joined gain what the detector's own gain. Of false alarms it is counted how many others have the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from sortie.perception.geometry import in_square
from sortie.perception.joining import NMS_IOU, Rule, Told, joined
from sortie.perception.metrics.ap import Matched, average_precision, match
from sortie.perception.metrics.overlap import iou_pairs, near_pairs
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.collect import DetectorRuns
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.surrogate.features import CaptureColumns, Eyes
from sortie.perception.surrogate.model import Parameters
from sortie.perception.surrogate.plan import scene_model
from sortie.perception.surrogate.rows import claim
from sortie.perception.surrogate.shared_false_positives import in_common
from sortie.perception.types import Boxes
from sortie.scenarios.schema import Perception

Change = Callable[[Parameters, float], Parameters]

FACTORS = (1.0, 1.5, 2.0, 2.5, 3.0, 3.5)
PARTS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
MOST = 0.95
REPEATS = 2


def towns_of(asked: Sequence[DetectorRuns], seed: int) -> dict[int, tuple[SceneModel, Eyes]]:
    """The fitted scenes by their index, with who looks at them: a part of a second each, and asked for often."""
    scenes = {k: scene_model(seed, "fit", k) for k in dict.fromkeys(a.scene for a in asked)}
    return {k: (scene, Eyes(scene)) for k, scene in scenes.items()}


def hang_together(
    parameters: Parameters, asked: Sequence[DetectorRuns], seed: int, threshold: float, tell: Callable[[int, int], None]
) -> Parameters:
    """The parameters with `alike` such that joined boxes gain most nearly what they should.

    Suppressed ones tell how far misses hang together: the part of the cars with a luck of their own takes a factor of 1 … 3.5.
    Averaged ones tell how far errors of place do: of a part of 0 … 0.5 of the cars they have one sign for all. Each changes the other's gain a
    little, so the factor is looked for again.
    """
    towns = towns_of(asked, seed)
    wanted = {rule: _gain(parameters, asked, towns, threshold, rule, own=True) for rule in ("nms", "average")}
    steps = 2 * len(FACTORS) + len(PARTS)

    def best(base: Parameters, change: Change, values: Sequence[float], rule: Rule, done: int) -> Parameters:
        found = list[float]()
        for k, value in enumerate(values):
            tell(done + k, steps)
            found.append(_gain(change(base, value), asked, towns, threshold, rule))
            if found[-1] <= wanted[rule]:
                break
        # gains fall with either; the noise of few scenes apart
        falling = np.minimum.accumulate(found)
        return change(base, float(np.interp(-wanted[rule], -falling, values[: len(found)])))

    hung = best(parameters, _times, FACTORS, "nms", 0)
    hung = best(hung, _with_common, PARTS, "average", len(FACTORS))
    again = _with_common(parameters, float(hung.alike[3]))
    hung = best(again, _times, FACTORS, "nms", len(FACTORS) + len(PARTS))
    tell(steps, steps)
    return hung


def _times(parameters: Parameters, factor: float) -> Parameters:
    lucks = np.minimum(parameters.alike[:3] * factor, MOST)
    return replace(parameters, alike=np.append(lucks, parameters.alike[3]).astype(np.float32))


def _with_common(parameters: Parameters, part: float) -> Parameters:
    return replace(parameters, alike=np.append(parameters.alike[:3], part).astype(np.float32))


def _gain(
    parameters: Parameters,
    asked: Sequence[DetectorRuns],
    towns: Mapping[int, tuple[SceneModel, Eyes]],
    threshold: float,
    rule: Rule,
    *,
    own: bool = False,
) -> float:
    """AP of every drone's boxes joined with all others', minus AP of each alone: the surrogate's, or the detector's `own`."""
    alone, together = list[Matched](), list[Matched]()
    config = Perception(score_threshold=threshold)
    for a in asked:
        scene, eyes = towns[a.scene]
        answers = [(j.ego, b) for j, b in zip(a.jobs, a.boxes, strict=True) if not j.shares]
        egos = [ego for ego, _ in answers]
        for repeat in range(1 if own else REPEATS):
            detector = SurrogateDetector.of(scene, config, parameters, repeat, eyes)
            truths = detector.truth_many([e.t_s for e in egos], egos)
            if own:
                boxes = [b.take(b.score >= threshold) for _, b in answers]
            else:
                boxes = list(detector.detect_many([[(ego, ())] for ego in egos]))
            by_drone = dict(zip(egos, boxes, strict=True))
            alone += [match(b, t) for b, t in zip(boxes, truths, strict=True)]
            for ego, truth in zip(egos, truths, strict=True):
                others = [Told(by_drone[o], 1.0, o.est_pose) for o in egos if o is not ego and o.t_s == ego.t_s]
                together.append(match(joined(ego.est_pose, by_drone[ego], False, others, rule), truth))
    return average_precision(together) - average_precision(alone)


def seen_by_several(asked: Sequence[DetectorRuns], floor: float, seed: int) -> NDArray[np.float32]:
    """`Parameters.mirages` from the detector's own false alarms, where all drones of a moment have the place in view."""
    seen, apart, turned = list[int](), list[float](), list[float]()
    others = 0
    for a in asked:
        eyes = Eyes(scene_model(seed, a.split, a.scene))
        egos = [(j.ego, b.take(b.score >= floor)) for j, b in zip(a.jobs, a.boxes, strict=True) if not j.shares]
        looks = eyes.look(CaptureColumns.of([ego for ego, _ in egos]))
        # by where drones were: what they are wrong about that, they are wrong about in a sortie as well
        poses = [ego.true_pose for ego, _ in egos]
        alarms = [
            Boxes.placed(claim(ego, boxes, looks, np.flatnonzero(looks.capture == m), eyes)[2], poses[m])
            for m, (ego, boxes) in enumerate(egos)
        ]
        others = len(egos) - 1
        for m, mine in enumerate(alarms):
            rivals = [o for k, o in enumerate(alarms) if k != m]
            mine = mine.take(np.flatnonzero(in_square(mine.xy_m, poses).all(axis=1)))
            count = np.zeros(len(mine), int)
            for theirs in rivals:
                i, j = near_pairs(mine.table(), theirs.table())
                same = iou_pairs(mine.table()[i], theirs.table()[j]) > NMS_IOU
                i, j = i[same], j[same]
                count[np.unique(i)] += 1
                apart += np.hypot(*(mine.xy_m[i] - theirs.xy_m[j]).T).tolist()
                turned += np.sin(mine.yaw_rad[i] - theirs.yaw_rad[j]).tolist()
            seen += count.tolist()
    part, chance = in_common(seen, others)
    # of two that put one thing off by as much each; medians, for some lie on one another by chance
    spread_m = np.median(apart) / np.sqrt(4 * np.log(2)) if apart else 0.0
    spread_rad = np.median(np.abs(turned)) / (np.sqrt(2) * ndtri(0.75)) if turned else 0.0
    return np.array([part, chance, spread_m, spread_rad], np.float32)
