"""Options of the section `perception` that the surrogate takes over, and how many boxes it says it would send, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from perception_examples import capture, cross

from sortie.perception import budget
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Perception, Scene

SCENE = SceneModel(Scene(parked_density=0.4), None, (-60.0, -60.0, 60.0, 60.0))
FLEET = cross(10.0, 20.0, 0.3)


def detector(**options: object) -> SurrogateDetector:
    return SurrogateDetector(SCENE, Perception(**options), seed=3)  # type: ignore[arg-type]


def shares(kind: str = "features", rho: float = 0.03) -> list[Share]:
    return [Share(c, kind, rho, None, 1.0) for c in FLEET[1:]]


def equal(a: Boxes, b: Boxes) -> bool:
    return len(a) == len(b) and all(np.array_equal(getattr(a, n), getattr(b, n)) for n in Boxes.__slots__)


@pytest.mark.parametrize(
    ("kind", "option"),
    [
        ("features", {"unsent_cells": "zero"}),
        ("detections", {"join": "nms"}),
    ],
)
def test_an_option_changes_what_a_fleet_finds_and_nothing_that_a_drone_finds_alone(
    kind: str, option: dict[str, object]
) -> None:
    plain, other = detector(), detector(**option)
    assert not equal(*(d.detect([(FLEET[0], shares(kind))])[0] for d in (plain, other)))
    assert equal(*(d.detect([(FLEET[0], [])])[0] for d in (plain, other)))


def test_without_fusion_maps_are_as_if_they_had_not_come() -> None:
    off = detector(fusion="none")
    assert equal(off.detect([(FLEET[0], shares())])[0], off.detect([(FLEET[0], [])])[0])
    assert not equal(off.detect([(FLEET[0], [])])[0], detector().detect([(FLEET[0], shares())])[0])


def moved(c: Capture, **changes: object) -> Capture:
    return c._replace(**changes)


def test_without_compensation_a_late_map_lies_where_its_sender_believes_to_be_now() -> None:
    """As if it had believed so when it looked; a sender of which nothing newer is known stays where it was."""
    ego, now = FLEET[0], moved(FLEET[1], est_position_m=(31.5, 22.0, 60.0), est_yaw_rad=0.35)
    late = moved(FLEET[1], t_s=4.6, position_m=(27.0, 19.0, 60.0), est_position_m=(27.5, 19.5, 60.0))
    share = Share(late, "features", 1.0, None, 1.0)
    there = share._replace(capture=moved(late, est_position_m=now.est_position_m, est_yaw_rad=now.est_yaw_rad))
    keeps, corrects = detector(motion_compensation=False), detector()
    found = keeps.detect([(ego, [share]), (now, [])])[0]
    assert equal(found, corrects.detect([(ego, [there])])[0])
    assert not equal(found, corrects.detect([(ego, [share]), (now, [])])[0])
    assert equal(keeps.detect([(ego, [share])])[0], corrects.detect([(ego, [share])])[0])


def test_without_compensation_the_map_that_leads_for_a_drone_without_a_look_lies_where_its_sender_is_now() -> None:
    """As if it had believed so when it looked; the map that follows lies where it lay."""
    blind, now = FLEET[0]._replace(looked=False), moved(FLEET[1], est_position_m=(31.5, 22.0, 60.0), est_yaw_rad=0.35)
    late = moved(FLEET[1], t_s=4.6, position_m=(27.0, 19.0, 60.0), est_position_m=(27.5, 19.5, 60.0))
    lead, follows = Share(late, "features", 0.3, None, 1.0), Share(FLEET[2], "features", 0.5, None, 0.4)
    there = lead._replace(capture=moved(late, est_position_m=now.est_position_m, est_yaw_rad=now.est_yaw_rad))
    keeps, corrects = detector(motion_compensation=False), detector()
    for others in ([], [follows]):
        found = keeps.detect([(blind, [lead, *others]), (now, [])])[0]
        assert len(found) > 3
        assert equal(found, corrects.detect([(blind, [there, *others])])[0])
        assert not equal(found, corrects.detect([(blind, [lead, *others]), (now, [])])[0])


def test_of_many_draws_of_everything_each_has_cars_of_its_own_that_are_hard_and_false_positives_of_its_own() -> None:
    """Where every car has one draw for all, which of them are found is the town's draw; one draw is the same twice. Of the cars
    that a drone finds in either of two draws, about an eighth are found in one of them alone, here over five drones."""
    none_shared = np.array([0.0, 1.0, 0.0, 0.0], np.float32)
    hung = replace(detector().parameters, alike=np.ones(4, np.float32), shared_false_positives=none_shared)
    cars = SCENE.cars_at(FLEET[0].t_s)
    hits, alarms = [], []
    for k in (0, 1, 0):
        found, of_nobody = set(), set()
        for drone, boxes in enumerate(
            SurrogateDetector.of(SCENE, Perception(), hung, k).detect([(c, []) for c in FLEET])
        ):
            away = np.hypot(boxes.xy_m[:, 0, None] - cars.x_m, boxes.xy_m[:, 1, None] - cars.y_m)
            found |= {(drone, car) for car in away.argmin(axis=1)[away.min(axis=1) < 2.0].tolist()}
            of_nobody |= set(boxes.xy_m[away.min(axis=1) > 6.0, 0].tolist())
        hits.append(found)
        alarms.append(of_nobody)
    assert (hits[0], alarms[0]) == (hits[2], alarms[2])
    assert len(hits[0] ^ hits[1]) > 0.1 * len(hits[0] | hits[1])
    assert len(alarms[0]) > 1
    assert len(alarms[0] & alarms[1]) < 0.05 * len(alarms[0]), "the same sample of the pool by chance"


@pytest.mark.parametrize("threshold", [0.05, 0.33, 0.62])
def test_as_many_boxes_are_sent_as_cars_are_found_and_false_positives_come_on_average(threshold: float) -> None:
    """Of a disc inside the square, of one that leaves it, and of the whole, a disc as large; cars by the true place and the
    capture's time, the map's part by what the drone believes."""
    made = detector(score_threshold=threshold)
    at, found, alarms = made.parameters.boxes
    part_of = [np.interp(max(threshold, at[0]), at, y) for y in (found, alarms)]
    for t_s in (5.0, 11.0):
        ego = capture(10.0, 20.0, yaw=0.3, t_s=t_s, est=(30.0, 10.0, 60.0, 0.9))
        cars = SCENE.cars_at(t_s)
        whole = 204.8 / np.sqrt(np.pi)
        for disc in (None, Disc(30.0, 0.0, 45.0), Disc(70.0, 60.0, 50.0)):
            x, y, radius = (10.0, 20.0, whole) if disc is None else disc
            near = np.hypot(cars.x_m - x, cars.y_m - y) <= radius
            part = np.pi * radius**2 / 204.8**2
            if disc is not None and disc[0] == 70.0:
                ahead, left = (
                    np.cos(0.3) * (cars.x_m - 10.0) + np.sin(0.3) * (cars.y_m - 20.0),
                    np.cos(0.3) * (cars.y_m - 20.0) - np.sin(0.3) * (cars.x_m - 10.0),
                )
                near &= (np.abs(ahead) < 102.4) & (np.abs(left) < 102.4)
                part = budget.cells_sent(1.0, disc, 30.0, 10.0, 0.9) / 4096
            assert made.count_boxes(ego, disc) == min(round(near.sum() * part_of[0] + part * part_of[1]), 200)
