"""False alarms that stand in the world: how many, for whom, and found again in what a fleet saw."""

from dataclasses import replace

import numpy as np
import pytest
from perception_examples import capture, cross

from research.benchmark.scenes import model_of
from research.calibrate.plan import scene_model
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.surrogate.model import SHIPPED, load
from sortie.perception.types import Capture
from sortie.scenarios.schema import Perception, Scene


def test_alarms_come_as_often_whether_they_are_shared_or_not() -> None:
    base, towns, seen = load(SHIPPED), range(30), dict[float, float]()
    for part in (0.0, 0.9):
        planted = replace(base, shared_false_positives=np.array([part, 0.5, 0.5, 0.1], np.float32))
        count = 0
        for town in towns:
            model = scene_model(0, "fit", town)
            detector = SurrogateDetector.of(model, Perception(score_threshold=0.1), planted, 0)
            jobs: list[tuple[Capture, tuple[()]]] = [(c, ()) for c in cross(10.0, 20.0, 0.3)]
            count += sum(len(b) for b in detector.detect_many([jobs]))
        seen[part] = count / len(towns)
    assert seen[0.9] == pytest.approx(seen[0.0], rel=0.08)


def test_a_shared_false_positive_lies_alike_in_the_world_for_drones_of_every_heading() -> None:
    """All drones have each of them, and put them where they are: place and heading agree over an empty town."""
    everywhere = replace(load(SHIPPED), shared_false_positives=np.array([1.0, 1.0, 0.0, 0.0], np.float32))
    shared = 0
    for town in range(4):
        scene = model_of(Scene(seed=town, parked_density=0.0, moving_cars_per_km=0.0))
        detector = SurrogateDetector.of(scene, Perception(score_threshold=0.02), everywhere, 0)
        views = [capture(4.0 * k, -3.0 * k, yaw=yaw, drone=k) for k, yaw in enumerate((0.3, 1.2, -2.5))]
        first, *others = list(detector.detect_many([[(v, ()) for v in views]]))
        for other in others:
            away = np.hypot(*(first.xy_m[:, None] - other.xy_m[None]).transpose(2, 0, 1))
            i, j = np.nonzero(away < 0.01)
            shared += len(i)
            turned = (first.yaw_rad[i] - other.yaw_rad[j]) / np.pi
            np.testing.assert_allclose(turned, 2.0 * np.round(turned / 2.0), atol=1e-3)
    assert shared > 20
