"""The thermal camera against its formula and the scene's geometry: probabilities, places, draws, false alarms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from perception_examples import capture

from sortie.perception.classes import PERSON, PERSON_SIZE_M
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.walkers import Walkers
from sortie.perception.thermal import NOBODY, Sighting, boxes_of, found_probability, in_cone, look, looked_at
from sortie.scenarios.schema import Person, Scene, Thermal

BARE = SceneModel(Scene(building_density=0.0, tree_density=0.0), None, (0.0, 0.0, 80.0, 80.0)).height_field
NOBODY_THERE = np.zeros((0, 2))
PEOPLE_M = np.array([[x, y] for x in (30.0, 40.0, 50.0) for y in (30.0, 40.0, 50.0)])


@pytest.mark.parametrize("error_m", [0.0, 3.0])
@pytest.mark.parametrize("height_m", [60.0, 70.0, 80.0])
def test_a_person_is_found_by_the_true_distance_and_placed_by_the_believed_one(error_m: float, height_m: float) -> None:
    """The camera looks from where the drone is; it errs by its own error, beside that of its drone."""
    camera = Thermal(
        near_probability=0.95, half_range_m=75.0, range_width_m=9.0, position_error_m=error_m, false_alarms_per_min=0
    )
    person = np.array([[50.0, 35.0]])
    at = capture(40.0, 40.0, height_m, t_s=3.25, est=(90.0, -20.0, height_m, 0.0))
    found = [s for k in range(800) for s in look(camera, person, BARE, at, k, 0.1, (1, 0))]
    distance_m = math.dist((50.0, 35.0, 0.0), (40.0, 40.0, height_m))
    p = 0.95 / (1 + math.exp((distance_m - 75.0) / 9.0))
    assert float(found_probability(distance_m, camera)) == pytest.approx(p)
    assert abs(len(found) - 800 * p) < 4 * math.sqrt(800 * p * (1 - p))
    for s in found:
        assert (s.t_s, s.score, s.person) == (3.25, pytest.approx(p), 0)
    off = np.array([(s.x_m - 100.0, s.y_m - -25.0) for s in found])
    assert off.std() == pytest.approx(error_m, rel=0.12)
    assert np.abs(off.mean(axis=0)).max() <= 4 * error_m / math.sqrt(len(found)) + 1e-9


def test_a_roof_hides_a_person_and_the_cone_ends() -> None:
    camera = Thermal(false_alarms_per_min=0, near_probability=1, half_range_m=500)
    field = SceneModel(Scene(), None, (0.0, 0.0, 80.0, 80.0)).height_field
    steps = np.arange(1.0, 79.0, 2.0)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    found = {s.person for s in look(camera, grid, field, capture(40.0, 40.0, 60.0), 0, 0.1, (1, 0))}
    roofed = set(np.flatnonzero(~field.open(grid[:, 0], grid[:, 1])).tolist())
    inside = set(np.flatnonzero(np.hypot(*(grid - 40.0).T) <= 60 * math.tan(math.radians(35))).tolist())
    assert roofed & inside
    assert found <= inside - roofed
    assert len(found) > 0.2 * len(inside)
    assert set(np.flatnonzero(in_cone(grid, (40.0, 40.0, 60.0), camera)).tolist()) == inside


def test_a_walker_waits_walks_and_stays() -> None:
    walkers = Walkers([Person(waypoints_m=((0.0, 0.0), (0.0, 14.0)), begin_s=5.0)])
    at = [tuple(walkers.at(t_s)[0]) for t_s in (0.0, 5.0, 10.0, 99.0)]
    assert at == [(0, 0), (0, 0), (0, pytest.approx(7.0)), (0, 14)]


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


# --- false alarms ---------------------------------------------------------------------------------------


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
    """About where the drone believes to be, as many in each ring and sector of one area."""
    camera = Thermal(false_alarms_per_min=600, half_range_m=70.0, range_width_m=9.0)
    found = alarms(camera, 1000, 1.0)
    assert len(found) > 950
    away_m = np.array([(s.x_m - 47.0, s.y_m - 40.0) for s in found])
    share = (away_m**2).sum(axis=1) / (60.0 * math.tan(math.radians(camera.field_of_view_deg / 2))) ** 2
    assert share.max() < 1.0
    rings = np.histogram(share, bins=8, range=(0, 1))[0]
    sectors = np.histogram(np.arctan2(away_m[:, 1], away_m[:, 0]), bins=8, range=(-np.pi, np.pi))[0]
    for counts in (rings, sectors):
        wanted = len(found) / 8
        assert ((counts - wanted) ** 2 / wanted).sum() < 29.9  # chi square, seven degrees: one in ten thousand
    for s, off_m in zip(found, np.hypot(*away_m.T), strict=True):
        p = camera.near_probability / (1 + math.exp((math.hypot(off_m, 60.0) - 70.0) / 9.0))
        assert (s.score, s.t_s, s.person) == (pytest.approx(p), 12.5, NOBODY)


def sightings(
    frames: int, drone: int = 0, off: tuple[float, float] = (0.0, 0.0), key: tuple[int, int] = (1, 0), **camera: Any
) -> list[list[Any]]:
    at = capture(40.0, 40.0, 95.0, drone=drone, est=(40.0 + off[0], 40.0 + off[1], 95.0, 0.0))
    thermal = Thermal(**{"near_probability": 1.0, "half_range_m": 97.0, "range_width_m": 4.0, **camera})
    return [look(thermal, PEOPLE_M, BARE, at, k, 0.1, key) for k in range(frames)]


def test_whatever_a_thermal_camera_reports_is_off_by_as_much_as_its_drone() -> None:
    """People and false alarms alike."""
    plain = sightings(60, false_alarms_per_min=300, position_error_m=1.0)
    moved = sightings(60, off=(25.0, -40.0), false_alarms_per_min=300, position_error_m=1.0)
    kinds = set()
    for one, other in zip(plain, moved, strict=True):
        assert [s.person for s in one] == [s.person for s in other]
        for a, b in zip(one, other, strict=True):
            kinds.add(a.person == NOBODY)
            assert (b.x_m - a.x_m, b.y_m - a.y_m) == pytest.approx((25.0, -40.0))
            assert a.score == b.score
    assert kinds == {True, False}


def test_thermal_draws_are_of_each_drone_frame_person_seed_and_replication() -> None:
    def found(**how: Any) -> np.ndarray:
        rows = sightings(300, false_alarms_per_min=0, **how)
        return np.array([[any(s.person == p for s in frame) for p in range(9)] for frame in rows])

    every = [found(), found(drone=1), found(key=(2, 0)), found(key=(1, 1))]
    columns = np.concatenate(every, axis=1).T.astype(float)
    assert 0.2 < columns.mean() < 0.8
    correlation = np.corrcoef(columns)
    np.fill_diagonal(correlation, 0.0)
    assert np.abs(correlation).max() < 0.28
    shifted = [np.corrcoef(c[:-1], c[1:])[0, 1] for c in columns]  # one frame and the next
    assert np.abs(shifted).max() < 0.28
    alarms = [
        np.array([any(s.person == NOBODY for s in f) for f in sightings(400, false_alarms_per_min=400, **how)], float)
        for how in ({}, {"drone": 1}, {"key": (2, 0)}, {"key": (1, 1)})
    ]
    between = np.corrcoef(alarms)
    np.fill_diagonal(between, 0.0)
    assert np.abs(between).max() < 0.25


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
