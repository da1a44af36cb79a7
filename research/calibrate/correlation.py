"""The correlation of misses, localisation errors and false positives between the drones of a fleet.

Pairs of drones do not suffice for misses: a car that two drones miss is missed by the others more often than pairs predict.
So the shares of cars with a draw of their own (`Parameters.alike`) are raised together, until the joined boxes of all drones
gain as much AP as the torch detector's. For false positives, the number of other drones that have the same one is counted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from research.calibrate.collect import DetectorRuns
from research.calibrate.plan import scene_model
from research.calibrate.rows import assign_boxes
from sortie.perception.geometry import in_square
from sortie.perception.joining import NMS_IOU, Rule, SourceBoxes, joined
from sortie.perception.metrics.ap import Matched, average_precision, match
from sortie.perception.metrics.overlap import iou_pairs, near_pairs
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.surrogate.features import CaptureColumns, Eyes
from sortie.perception.surrogate.model import Parameters
from sortie.perception.types import Boxes
from sortie.scenarios.schema import Perception

Change = Callable[[Parameters, float], Parameters]

FACTORS = (1.0, 1.5, 2.0, 2.5, 3.0, 3.5)
PARTS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
MOST = 0.95
REPEATS = 2


def scenes_of(recorded: Sequence[DetectorRuns], seed: int) -> dict[int, tuple[SceneModel, Eyes]]:
    """The fitted scenes by their index, with their `Eyes`; made once, as each takes part of a second."""
    scenes = {k: scene_model(seed, "fit", k) for k in dict.fromkeys(a.scene for a in recorded)}
    return {k: (scene, Eyes(scene)) for k, scene in scenes.items()}


def fit_correlation(
    parameters: Parameters,
    recorded: Sequence[DetectorRuns],
    seed: int,
    threshold: float,
    report: Callable[[int, int], None],
) -> Parameters:
    """The parameters with `alike` fitted so that joined boxes gain as much AP as the torch detector's.

    Suppressed boxes fix the correlation of misses: the shares of cars with their own draw take a factor of 1 … 3.5. Averaged
    boxes fix that of localisation errors: for a share of 0 … 0.5 of the cars all drones err to the same side. Each changes
    the other's gain a little, so the factor is fitted twice.
    """
    towns = scenes_of(recorded, seed)
    wanted = {rule: _gain(parameters, recorded, towns, threshold, rule, own=True) for rule in ("nms", "average")}
    steps = 2 * len(FACTORS) + len(PARTS)

    def best(base: Parameters, change: Change, values: Sequence[float], rule: Rule, done: int) -> Parameters:
        found = list[float]()
        for k, value in enumerate(values):
            report(done + k, steps)
            found.append(_gain(change(base, value), recorded, towns, threshold, rule))
            if found[-1] <= wanted[rule]:
                break
        # gains fall with either; the noise of few scenes apart
        falling = np.minimum.accumulate(found)
        return change(base, float(np.interp(-wanted[rule], -falling, values[: len(found)])))

    hung = best(parameters, _times, FACTORS, "nms", 0)
    hung = best(hung, _with_common, PARTS, "average", len(FACTORS))
    again = _with_common(parameters, float(hung.alike[3]))
    hung = best(again, _times, FACTORS, "nms", len(FACTORS) + len(PARTS))
    report(steps, steps)
    return hung


def _times(parameters: Parameters, factor: float) -> Parameters:
    shares = np.minimum(parameters.alike[:3] * factor, MOST)
    return replace(parameters, alike=np.append(shares, parameters.alike[3]).astype(np.float32))


def _with_common(parameters: Parameters, part: float) -> Parameters:
    return replace(parameters, alike=np.append(parameters.alike[:3], part).astype(np.float32))


def _gain(
    parameters: Parameters,
    recorded: Sequence[DetectorRuns],
    towns: Mapping[int, tuple[SceneModel, Eyes]],
    threshold: float,
    rule: Rule,
    *,
    own: bool = False,
) -> float:
    """AP of every drone's boxes joined with all others', minus AP of each alone: the surrogate's, or the detector's `own`."""
    alone, together = list[Matched](), list[Matched]()
    config = Perception(score_threshold=threshold)
    for a in recorded:
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
                others = [SourceBoxes(by_drone[o], 1.0, o.est_pose) for o in egos if o is not ego and o.t_s == ego.t_s]
                together.append(match(joined(ego.est_pose, by_drone[ego], False, others, rule), truth))
    return average_precision(together) - average_precision(alone)


def fit_shared_false_positives(recorded: Sequence[DetectorRuns], floor: float, seed: int) -> NDArray[np.float32]:
    """`Parameters.shared_false_positives` from the torch detector's false positives at places that all drones of a moment have in view."""
    seen, apart, turned = list[int](), list[float](), list[float]()
    others = 0
    for a in recorded:
        eyes = Eyes(scene_model(seed, a.split, a.scene))
        egos = [(j.ego, b.take(b.score >= floor)) for j, b in zip(a.jobs, a.boxes, strict=True) if not j.shares]
        looks = eyes.look(CaptureColumns.of([ego for ego, _ in egos]))
        # by where drones were: what they are wrong about that, they are wrong about in a sortie as well
        poses = [ego.true_pose for ego, _ in egos]
        alarms = [
            Boxes.placed(assign_boxes(ego, boxes, looks, np.flatnonzero(looks.capture == m), eyes)[2], poses[m])
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
    part, chance = estimate_shared(seen, others)
    # of two that put one thing off by as much each; medians, for some lie on one another by chance
    spread_m = np.median(apart) / np.sqrt(4 * np.log(2)) if apart else 0.0
    spread_rad = np.median(np.abs(turned)) / (np.sqrt(2) * ndtri(0.75)) if turned else 0.0
    return np.array([part, chance, spread_m, spread_rad], np.float32)


def estimate_shared(seen: Sequence[int], others: int) -> tuple[float, float]:
    """The share of false positives that are of shared things, and the chance that a drone has one of those.

    Chosen so that as many others have them, and as many pairs of others, as was counted on average.

    Args:
        seen: for each false positive, how many of the `others` that could have had it as well had it.
    """
    n = np.asarray(seen, dtype=np.float64)
    if not n.sum():
        return 0.0, 1.0
    pairs = float((n * (n - 1)).mean() / ((others - 1) * n.mean()))
    chance = min(1.0, max(pairs, float(n.mean()) / others))
    return float(n.mean()) / (others * chance), chance
