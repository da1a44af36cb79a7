"""The surrogate as a detector: limits, draws that do not depend on what was sent, one batch as many."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from perception_examples import cross

from research.calibrate.rows import assign_boxes
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.surrogate.features import CaptureColumns, Eyes
from sortie.scenarios.schema import Perception, Scene

BOUNDS = (-50.0, -50.0, 50.0, 50.0)


@pytest.fixture(scope="module")
def scene() -> SceneModel:
    return SceneModel(Scene(), None, BOUNDS)


@pytest.fixture(scope="module")
def detector(scene: SceneModel) -> SurrogateDetector:
    return SurrogateDetector(scene, Perception(), seed=3)


@pytest.mark.parametrize(("part", "low", "high"), [(0.0, 0.4, 0.68), (1.0, 0.8, 1.0)])
def test_boxes_of_a_car_lie_off_to_the_same_side_of_it_whoever_looks(
    detector: SurrogateDetector, part: float, low: float, high: float
) -> None:
    """Along the car, across it and in heading, in the car's own axes: what part of all pairs of drones agree on the side."""
    alike = np.append(detector.parameters.alike[:3], np.float32(part))
    planted = dataclasses.replace(detector.parameters, alike=alike)
    fleet = [*cross(-30.0, 0.0, 0.3), *cross(50.0, 20.0, 1.9)]  # cars between them are seen from two sides
    fleet = [c._replace(drone=k) for k, c in enumerate(fleet)]
    agreed = np.zeros((0, 3), bool)
    for town in range(4):
        scene = SceneModel(Scene(seed=town), None, (-60, -60, 60, 60))
        eyes = Eyes(scene)
        looks = eyes.look(CaptureColumns.of(fleet))
        some = SurrogateDetector.of(scene, Perception(), planted, 0)
        sides: dict[int, list[np.ndarray]] = {}
        for k, boxes in enumerate(some.detect([(c, ()) for c in fleet])):
            mine = np.flatnonzero(looks.capture == k)
            score, off, _ = assign_boxes(fleet[k], boxes, looks, mine, eyes)
            turn = looks.yaw_rad[mine] - fleet[k].true_yaw_rad
            along = np.cos(turn) * off[:, 0] + np.sin(turn) * off[:, 1]
            left = np.cos(turn) * off[:, 1] - np.sin(turn) * off[:, 0]
            for j in np.flatnonzero(score > 0):
                sides.setdefault(int(looks.car[mine[j]]), []).append(np.sign([along[j], left[j], off[j, 2]]))
        pairs = [a == b for of in sides.values() for a, b in itertools.combinations(of, 2)]
        agreed = np.concatenate([agreed, np.array(pairs).reshape(-1, 3)])
    assert len(agreed) > 500
    assert ((agreed.mean(axis=0) > low) & (agreed.mean(axis=0) < high)).all(), agreed.mean(axis=0)
