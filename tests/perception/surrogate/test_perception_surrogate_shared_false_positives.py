"""False alarms that stand in the world: how many, for whom, and found again in what a fleet saw."""

from dataclasses import replace

import numpy as np
import pytest
from perception_examples import capture, cross

from research.benchmark.scenes import model_of
from research.calibrate.plan import scene_model
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.surrogate.features import CaptureColumns
from sortie.perception.surrogate.model import SHIPPED, load
from sortie.perception.surrogate.shared_false_positives import TILE_M, SharedFalsePositives
from sortie.perception.types import Capture
from sortie.scenarios.schema import Perception, Scene


def fleet(*at: tuple[float, float]) -> CaptureColumns:
    return CaptureColumns.of([capture(x, y, yaw=0.3, drone=k) for k, (x, y) in enumerate(at)])


def test_as_many_things_lie_in_a_square_as_are_expected_there() -> None:
    counts = []
    for town in range(60):
        things = SharedFalsePositives(town).about(fleet((0, 0)), 30.0)
        assert (things.rarity < 30.0).all()
        counts.append([int((things.there[0] & (things.rarity < most)).sum()) for most in (10.0, 30.0)])
    mean, variance = np.mean(counts, axis=0), np.var(counts, axis=0)
    np.testing.assert_allclose(mean, [10, 30], rtol=0.15)
    np.testing.assert_allclose(variance, [10, 30], rtol=0.5)  # Poisson: as thrown


def test_things_are_spread_over_their_tiles_by_two_draws_and_turned_by_a_third() -> None:
    """Each even in 0 … 1, and none tells of another."""
    several = [SharedFalsePositives(town).about(fleet((0, 0)), 40.0) for town in range(20)]
    xy = np.concatenate([things.xy_m for things in several]) / TILE_M % 1.0
    draws = np.column_stack([xy, np.concatenate([things.yaw_rad for things in several]) / (2 * np.pi)]).T
    np.testing.assert_allclose(draws.mean(axis=1), 0.5, atol=0.03)
    np.testing.assert_allclose(np.corrcoef(draws), np.eye(3), atol=0.1)


def test_things_stand_where_they_stand_whichever_drones_look() -> None:
    town = SharedFalsePositives(7)
    alone, both = town.about(fleet((300, -200)), 20.0), town.about(fleet((-500, 0), (300, -200)), 20.0)
    seen = both.there[1]
    here = np.lexsort(alone.xy_m[alone.there[0]].T)
    there = np.lexsort(both.xy_m[seen].T)
    np.testing.assert_array_equal(alone.xy_m[alone.there[0]][here], both.xy_m[seen][there])
    np.testing.assert_array_equal(alone.key[alone.there[0]][here], both.key[seen][there])
    assert not np.array_equal(SharedFalsePositives(8).about(fleet((300, -200)), 20.0).xy_m, alone.xy_m)


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
