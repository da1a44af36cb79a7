"""What a thermal camera reports, field by field, against its description: times, places, probabilities, draws of false alarms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from perception_examples import capture

from sortie.perception.classes import PERSON, PERSON_SIZE_M
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.thermal import NOBODY, Sighting, boxes_of, look, looked_at
from sortie.scenarios.schema import Scene, Thermal

BARE = SceneModel(Scene(building_density=0.0, tree_density=0.0), None, (0.0, 0.0, 80.0, 80.0)).height_field
NOBODY_THERE = np.zeros((0, 2))


def alarms(camera: Thermal, frames: int, frame_s: float = 0.1, height_m: float = 60.0) -> list[Sighting]:
    """False alarms of a drone that truly hovers over (40, 40), and believes to be 7 m further east."""
    at = capture(40.0, 40.0, height_m, t_s=12.5, est=(47.0, 40.0, height_m, 0.0))
    return [s for k in range(frames) for s in look(camera, NOBODY_THERE, BARE, at, k, frame_s, (1, 0))]


@pytest.mark.parametrize(("frame_s", "per_min"), [(0.1, 60.0), (0.5, 60.0), (1.0, 20.0)])
def test_false_alarms_come_by_the_minute_whatever_a_frame_lasts(frame_s: float, per_min: float) -> None:
    found = alarms(Thermal(false_alarms_per_min=per_min), 1200, frame_s)
    p = 1 - math.exp(-per_min * frame_s / 60)
    assert abs(len(found) - 1200 * p) < 4 * math.sqrt(1200 * p * (1 - p))


def test_false_alarms_lie_evenly_in_the_cone_with_the_score_of_a_person_there() -> None:
    """About where the drone believes to be. Half of them lie in the inner half of the cone's area."""
    camera = Thermal(false_alarms_per_min=600, half_range_m=70.0, range_width_m=9.0)
    found = alarms(camera, 1000, 1.0)
    assert len(found) > 950
    away_m = np.array([math.hypot(s.x_m - 47.0, s.y_m - 40.0) for s in found])
    reach_m = 60.0 * math.tan(math.radians(camera.field_of_view_deg / 2))
    assert away_m.max() < reach_m
    assert np.mean(away_m < reach_m * math.sqrt(0.5)) == pytest.approx(0.5, abs=0.07)
    for s, off_m in zip(found, away_m, strict=True):
        distance_m = math.hypot(off_m, 60.0)
        assert s.score == pytest.approx(camera.near_probability / (1 + math.exp((distance_m - 70.0) / 9.0)))
        assert (s.t_s, s.person) == (12.5, NOBODY)


def test_a_false_alarm_is_drawn_by_numbers_of_its_own() -> None:
    """Whether person 0 is found says nothing of whether there is a false alarm."""
    camera = Thermal(
        near_probability=1.0, half_range_m=60.0, range_width_m=4.0, false_alarms_per_min=416
    )  # a half each
    at = capture(40.0, 40.0, 60.0)
    frames = [look(camera, np.array([[40.0, 40.0]]), BARE, at, k, 0.1, (1, 0)) for k in range(600)]
    table = np.array([[any(s.person == who for s in frame) for who in (0, NOBODY)] for frame in frames], float)
    assert table.mean(axis=0) == pytest.approx([0.5, 0.5], abs=0.08)
    assert abs(np.corrcoef(table.T)[0, 1]) < 0.16


@pytest.mark.parametrize("error_m", [0.0, 3.0])
def test_a_person_is_found_by_the_true_distance_and_placed_by_the_believed_one(error_m: float) -> None:
    """The camera looks from where the drone is; it errs by its own error, beside that of its drone."""
    camera = Thermal(
        near_probability=1.0, half_range_m=75.0, range_width_m=2.0, position_error_m=error_m, false_alarms_per_min=0
    )
    person = np.array([[50.0, 35.0]])
    at = capture(40.0, 40.0, 70.0, t_s=3.25, est=(90.0, -20.0, 70.0, 0.0))
    found = [s for k in range(400) for s in look(camera, person, BARE, at, k, 0.1, (1, 0))]
    distance_m = math.dist((50.0, 35.0, 0.0), (40.0, 40.0, 70.0))
    p = 1 / (1 + math.exp((distance_m - 75.0) / 2.0))
    assert 0.6 < p < 0.97
    assert abs(len(found) - 400 * p) < 4 * math.sqrt(400 * p * (1 - p))
    for s in found:
        assert (s.t_s, s.score, s.person) == (3.25, pytest.approx(p), 0)
    off = np.array([(s.x_m - 100.0, s.y_m - -25.0) for s in found])
    assert off.std() == pytest.approx(error_m, rel=0.12)
    assert np.abs(off.mean(axis=0)).max() <= 4 * error_m / math.sqrt(len(found)) + 1e-9


def test_the_ground_that_was_looked_at_is_the_cone_about_the_believed_place() -> None:
    at = capture(0.0, 0.0, 60.0, est=(12.0, -5.0, 50.0, 0.0))
    camera = Thermal(field_of_view_deg=90.0)
    assert looked_at(camera, at) == (12.0, -5.0, pytest.approx(50.0))
    assert looked_at(camera, capture(0.0, 0.0, 60.0, est=(12.0, -5.0, -2.0, 0.0))).radius_m == 0.0


def test_what_is_reported_are_boxes_of_people_best_first_that_do_not_say_who() -> None:
    found = [Sighting(1.0, 3.0, 4.0, 0.2, 5), Sighting(1.0, 6.0, 7.0, 0.9, NOBODY), Sighting(1.0, 8.0, 9.0, 0.5, 2)]
    boxes = boxes_of(found)
    np.testing.assert_allclose(boxes.table(), [[x, y, *PERSON_SIZE_M[:2], 0.0] for x, y in ((6, 7), (8, 9), (3, 4))])
    assert boxes.score == pytest.approx([0.9, 0.5, 0.2])
    assert boxes.kind.tolist() == [PERSON] * 3
    assert boxes.car.tolist() == [-1] * 3
    assert len(boxes_of([])) == 0
