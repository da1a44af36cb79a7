"""The declared thermal camera against its formula and the scene's geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.walkers import Walkers
from sortie.perception.thermal import NOBODY, found_probability, in_cone, look
from sortie.perception.types import Capture
from sortie.scenarios.schema import Person, Scene, Thermal

BARE = Scene(building_density=0.0, tree_density=0.0)
LEVEL = (0.0, 0.0, 0.0, 1.0)


def capture(height_m: float, drone: int = 0) -> Capture:
    at = (40.0, 40.0, height_m)
    return Capture(drone, 0.0, at, LEVEL, (41.0, 40.0, height_m), 0.0)


def scene(config: Scene = BARE) -> SceneModel:
    return SceneModel(config, None, (0.0, 0.0, 80.0, 80.0))


@pytest.mark.parametrize("height_m", [60.0, 90.0, 110.0])
def test_frames_in_which_a_person_is_found_follow_the_formula(height_m: float) -> None:
    camera, field = Thermal(false_alarms_per_min=0), scene().height_field
    person = np.array([[40.0, 40.0]])
    found = [s for k in range(1500) for s in look(camera, person, field, capture(height_m), k, 0.1, (1, 0))]
    p = 0.9 / (1 + math.exp((height_m - 90) / 12))
    assert float(found_probability(height_m, camera)) == pytest.approx(p)
    assert abs(len(found) / 1500 - p) < 4 * math.sqrt(p * (1 - p) / 1500)
    off = np.array([(s.x_m - 41.0, s.y_m - 40.0) for s in found])  # as far off as the drone itself
    assert np.abs(off.mean(axis=0)).max() < 4 / math.sqrt(len(found))
    assert np.abs(off.std(axis=0) - 1.0).max() < 0.2


def test_a_roof_hides_a_person_and_the_cone_ends() -> None:
    camera, model = Thermal(false_alarms_per_min=0, near_probability=1, half_range_m=500), scene(Scene())
    steps = np.arange(1.0, 79.0, 2.0)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    found = {s.person for s in look(camera, grid, model.height_field, capture(60.0), 0, 0.1, (1, 0))}
    roofed = set(np.flatnonzero(~model.height_field.open(grid[:, 0], grid[:, 1])).tolist())
    inside = set(np.flatnonzero(np.hypot(*(grid - 40.0).T) <= 60 * math.tan(math.radians(35))).tolist())
    assert roofed & inside
    assert found <= inside - roofed
    assert len(found) > 0.2 * len(inside)
    assert set(np.flatnonzero(in_cone(grid, (40.0, 40.0, 60.0), camera)).tolist()) == inside


def test_false_alarms_come_at_their_rate_and_are_nobody() -> None:
    camera, field = Thermal(false_alarms_per_min=30), scene().height_field
    found = [s for k in range(2000) for s in look(camera, np.zeros((0, 2)), field, capture(60.0), k, 0.1, (1, 0))]
    expected = 2000 * (1 - math.exp(-30 * 0.1 / 60))
    assert {s.person for s in found} == {NOBODY}
    assert abs(len(found) - expected) < 4 * math.sqrt(expected)


def test_a_walker_waits_walks_and_stays() -> None:
    walkers = Walkers([Person(waypoints_m=((0.0, 0.0), (0.0, 14.0)), begin_s=5.0)])
    at = [tuple(walkers.at(t_s)[0]) for t_s in (0.0, 5.0, 10.0, 99.0)]
    assert at == [(0, 0), (0, 0), (0, pytest.approx(7.0)), (0, 14)]


def test_far_beyond_a_sharp_range_nobody_is_found_and_nothing_overflows() -> None:
    assert float(found_probability(1000.0, Thermal(range_width_m=0.1))) == 0.0
