"""The localisation errors of the surrogate's boxes, over the towns of its calibration."""

from __future__ import annotations

from pathlib import Path

from research.benchmark.scenes import DRONES
from research.calibrate import plan
from research.train.box_errors import Moment, errors_of
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.types import Capture
from sortie.scenarios.schema import Perception

SEED = 1
"""Of the towns."""


def moments(weights: Path, split: plan.Split, towns: int) -> list[Moment]:
    """The errors of five drones alone, twice over each town: anywhere, and along a street.

    Args:
        weights: a calibration's file.
        split: which of a calibration's towns.
        towns: the first so many.
    """
    out: list[Moment] = []
    for town in range(towns):
        scene = plan.scene_model(SEED, split, town)
        detector = SurrogateDetector(scene, Perception(detector="surrogate"), town, weights)
        for manner in range(len(plan.MANNERS)):
            fleet = _fleet(split, town, manner)
            cars = scene.cars_at(fleet[0].t_s).table()
            boxes = detector.detect([(ego, ()) for ego in fleet])
            out.append([errors_of(b, ego.est_pose, cars) for b, ego in zip(boxes, fleet, strict=True)])
    return out


def _fleet(split: plan.Split, town: int, manner: int) -> list[Capture]:
    """Five drones over a town, by their ids."""
    jobs = plan.moment(SEED, split, town, manner, condition_egos=DRONES)
    return sorted({j.ego for j in jobs if not j.shares}, key=lambda c: c.drone)
