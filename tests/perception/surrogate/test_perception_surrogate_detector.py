"""The surrogate as a detector: its limits, one batch as many, what is sent, and options that it takes over."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np
import pytest
from perception_examples import EMPTY, capture, cross
from perception_examples import same as same_boxes
from wrong_rows import wrong_rows

from sortie.perception import budget
from sortie.perception.detectors import DetectsMany
from sortie.perception.geometry import in_square
from sortie.perception.metrics.ap import match
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.surrogate.exchange import received_only
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Perception, Scene

BOUNDS = (-50.0, -50.0, 50.0, 50.0)
TIMES = np.arange(2.0, 26.0, 2.0)


@pytest.fixture(scope="module")
def scene() -> SceneModel:
    return SceneModel(Scene(), None, BOUNDS)


@pytest.fixture(scope="module")
def detector(scene: SceneModel) -> SurrogateDetector:
    return SurrogateDetector(scene, Perception(), seed=3)


@pytest.fixture(scope="module")
def suppressing(scene: SceneModel) -> SurrogateDetector:
    """Its receivers keep boxes as they were sent."""
    return SurrogateDetector(scene, Perception(join="nms"), seed=3)


def shared(
    fleet: list[Capture], rho: float, weight: float = 1.0, kind: str = "features"
) -> list[tuple[Capture, list[Share]]]:
    return [(e, [Share(c, kind, rho, None, weight) for c in fleet if c is not e]) for e in fleet]


def moments(rho: float, weight: float = 1.0) -> list[list[tuple[Capture, list[Share]]]]:
    return [shared(cross(10.0, 20.0, 0.3, t_s=float(t)), rho, weight) for t in TIMES]


def same(a: Iterable[Boxes], b: Iterable[Boxes]) -> None:
    """Both lists are of equal boxes, one by one."""
    assert all(same_boxes(one, other) for one, other in zip(a, b, strict=True))


def test_it_has_the_detectors_interface_says_which_fit_it_is_of_and_renders_nothing(
    detector: SurrogateDetector,
) -> None:
    assert isinstance(detector, DetectsMany)
    assert detector.calibration.startswith("disconet-")
    message = "^the surrogate renders nothing: fly with perception.detector = torch to see camera views$"
    with pytest.raises(ValueError, match=message):
        detector.camera_views(capture())


def test_many_moments_at_once_are_one_after_the_other(detector: SurrogateDetector, scene: SceneModel) -> None:
    jobs_of_moments = moments(0.1)
    one_by_one = [boxes for moment in jobs_of_moments for boxes in detector.detect(moment)]
    same(list(detector.detect_many(jobs_of_moments)), one_by_one)
    same(one_by_one, [b for m in jobs_of_moments for b in SurrogateDetector(scene, Perception(), seed=3).detect(m)])


def test_boxes_come_best_first_and_above_the_threshold(scene: SceneModel) -> None:
    found = list(SurrogateDetector(scene, Perception(score_threshold=0.6), seed=3).detect_many(moments(0.25)))
    assert sum(map(len, found)) > 100
    for boxes in found:
        assert (np.diff(boxes.score) <= 0).all()
        assert (boxes.score >= np.float32(0.6)).all()


def test_sharing_finds_more_cars_and_more_cells_find_no_fewer(detector: SurrogateDetector) -> None:
    """On the average of 60 egos; a tenth of a car is chance."""

    def hits(rho: float) -> float:
        jobs_of_moments = moments(rho)
        egos = [e for m in jobs_of_moments for e, _ in m]
        truths = detector.truth_many([e.t_s for e in egos], egos)
        return float(
            np.mean([match(b, t).hit.sum() for b, t in zip(detector.detect_many(jobs_of_moments), truths, strict=True)])
        )

    found = [hits(rho) for rho in (0.0, 0.02, 0.1, 1.0)]
    assert found[-1] > found[0] + 0.5
    assert (np.diff(found) > -0.3).all(), found


def test_boxes_that_are_sent_are_the_peers_own(suppressing: SurrogateDetector) -> None:
    """What is joined is the ego's or the peer's, of tracks the best 12; a box goes only where another lies on it."""
    fleet = cross(10.0, 20.0, 0.3)
    own, theirs = suppressing.detect([(fleet[0], ()), (fleet[1], ())])
    inside = in_square(theirs.xy_m, [fleet[0].est_pose])[:, 0]
    for kind, most in (("detections", len(theirs)), ("tracks", 12)):
        joined = suppressing.detect(shared(fleet[:2], 1.0, kind=kind)[:1])[0]
        every = Boxes.join([own, theirs.take(np.flatnonzero(inside & (np.arange(len(theirs)) < most)))])
        kept = (every.xy_m[:, None] == joined.xy_m[None]).all(axis=-1)
        assert (kept.sum(axis=0) == 1).all()
        assert kept[len(own) :].any()
        lost = ~kept.any(axis=1)
        nearest = np.linalg.norm(every.xy_m[lost][:, None] - joined.xy_m[None], axis=-1).min(axis=1)
        assert (nearest < 6.0).all()


def test_another_fusion_is_refused(scene: SceneModel, detector: SurrogateDetector) -> None:
    with pytest.raises(
        ValueError, match=r"calibrated for fusion 'disconet', perception.fusion is 'fcooper', must be that or 'none'$"
    ):
        SurrogateDetector(scene, Perception(fusion="fcooper"), seed=3)
    card = {**detector.parameters.card, "fusion": "fcooper"}
    SurrogateDetector.of(scene, Perception(fusion="fcooper"), dataclasses.replace(detector.parameters, card=card), 3)


def test_false_alarms_are_those_of_drones_along_a_street_or_askew(detector: SurrogateDetector) -> None:
    """By their lengths, planted; a drone's own and those of things in the town alike."""

    pool = detector.parameters.alarm_pool.copy()
    pool[0, ..., 2], pool[1, ..., 2] = 3.0, 9.0
    for part in (0.0, 1.0):
        shared = np.array([part, 0.5, 0.5, 0.1], np.float32)
        planted = dataclasses.replace(detector.parameters, alarm_pool=pool, shared_false_positives=shared)
        some = SurrogateDetector.of(SceneModel(EMPTY, None, BOUNDS), Perception(), planted, 0)
        for heading, length_m in ((0.0, 9.0), (np.pi / 2, 9.0), (0.4, 3.0)):
            found = some.detect([(c, ()) for c in cross(10.0, 20.0, heading)])
            lengths = np.concatenate([b.size_m[:, 0] for b in found])
            assert len(lengths) > 5
            assert set(lengths.tolist()) == {length_m}, (part, heading)


def test_a_drone_without_a_look_has_what_its_peers_sent(suppressing: SurrogateDetector) -> None:
    """A whole map, from where it was made, is that drone's own; of a part it has the cells that came."""
    fleet = cross(10.0, 20.0, 0.3)
    peer, other = fleet[1], fleet[2]
    blind = peer._replace(drone=0, looked=False)
    whole, part = Share(peer, "raw", 1.0, None, 0.5), Share(peer, "features", 0.003, None, 0.5)
    disc = Disc(*peer.position_m[:2], 30.0)
    one, few, near, both, none, boxes, alone = suppressing.detect(
        [
            (blind, [whole]),
            (blind, [part]),
            (blind, [Share(peer, "features", 1.0, disc, 1.0)]),
            (blind, [whole, Share(other, "raw", 1.0, None, 0.5)]),
            (blind, []),
            (blind, [Share(peer, "detections", 0.0, None, 1.0)]),
            (peer, []),
        ]
    )
    inside = alone.take(in_square(alone.xy_m, [blind.est_pose])[:, 0])
    same([one], [inside])
    assert set(boxes.xy_m[:, 0]) <= set(inside.xy_m[:, 0])
    assert len(boxes) > 0.8 * len(inside)
    assert 0 < len(few) < len(one)
    assert 0 < len(near) < len(one)
    assert (np.hypot(*(near.xy_m - disc[:2]).T) <= 32.0).all()
    together = suppressing.detect([(peer, [Share(other, "raw", 1.0, None, 1.0)])])[0]
    same([both], [together.take(in_square(together.xy_m, [blind.est_pose])[:, 0])])
    assert len(none) == 0


# --- options --------------------------------------------------------------------------------------------

SCENE = SceneModel(Scene(parked_density=0.4), None, (-60.0, -60.0, 60.0, 60.0))
FLEET = cross(10.0, 20.0, 0.3)


def made(**options: object) -> SurrogateDetector:
    return SurrogateDetector(SCENE, Perception(**options), seed=3)


def test_an_option_changes_what_a_fleet_finds_and_nothing_that_a_drone_finds_alone() -> None:
    """Without fusion maps are as if they had not come."""
    for kind, option in (
        ("features", {"unsent_cells": "zero"}),
        ("features", {"fusion": "none"}),
        ("detections", {"join": "nms"}),
    ):
        shares = [Share(c, kind, 0.03, None, 1.0) for c in FLEET[1:]]
        plain, other = (d.detect([(FLEET[0], shares), (FLEET[0], [])]) for d in (made(), made(**option)))
        assert not same_boxes(plain[0], other[0])
        assert same_boxes(plain[1], other[1])
        assert same_boxes(*other) == (option == {"fusion": "none"})


@pytest.mark.parametrize("looked", [True, False])
def test_without_compensation_a_late_map_lies_where_its_sender_believes_to_be_now(looked: bool) -> None:
    """As if it had believed so when it looked. One of which nothing newer is known stays; a map that follows stays."""
    ego = FLEET[0]._replace(looked=looked)
    now = FLEET[1]._replace(est_position_m=(31.5, 22.0, 60.0), est_yaw_rad=0.35)
    late = FLEET[1]._replace(t_s=4.6, position_m=(27.0, 19.0, 60.0), est_position_m=(27.5, 19.5, 60.0))
    share, follows = Share(late, "features", 0.3, None, 1.0), Share(FLEET[2], "features", 0.5, None, 0.4)
    there = share._replace(capture=late._replace(est_position_m=now.est_position_m, est_yaw_rad=now.est_yaw_rad))
    keeps, corrects = made(motion_compensation=False), made()
    for others in ([], [follows]):
        found = keeps.detect([(ego, [share, *others]), (now, [])])[0]
        assert len(found) > 3
        assert same_boxes(found, corrects.detect([(ego, [there, *others])])[0])
        assert not same_boxes(found, corrects.detect([(ego, [share, *others]), (now, [])])[0])
        assert same_boxes(*(d.detect([(ego, [share, *others])])[0] for d in (keeps, corrects)))


def test_as_many_boxes_are_sent_as_cars_are_found_and_false_positives_come_on_average() -> None:
    """Of a disc inside the square, of one that leaves it, and of the whole, a disc as large.

    Cars count by the true place and the capture's time, the map's part by what the drone believes.
    """

    def check(threshold: float) -> None:
        some = made(score_threshold=threshold)
        at, found, alarms = some.parameters.boxes
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
                assert some.count_boxes(ego, disc) == min(round(near.sum() * part_of[0] + part * part_of[1]), 200)

    assert wrong_rows([0.05, 0.33, 0.62], check) == {}


NEAR, ASIDE = Disc(0.0, 0.0, 10.0), Disc(60.0, 0.0, 10.0)


def test_boxes_lie_where_a_map_that_counts_was_asked_for_and_in_the_own_square() -> None:
    rows = [
        ([("features", NEAR, 1.0)], [0]),
        ([("features", NEAR, 1.0), ("features", ASIDE, 1.0)], [0, 60]),
        ([("features", NEAR, 1.0), ("features", ASIDE, 0.0)], [0]),
        ([("features", NEAR, 1.0), ("detections", None, 1.0)], [0]),
        ([("features", None, 1.0)], [0, 30, 60]),
        ([("raw", NEAR, 1.0)], [0, 30, 60]),  # an image is sent whole, whatever region is asked for
        ([("raw", None, 0.0)], []),
        ([], []),
    ]

    def check(shares: list[tuple[str, Disc | None, float]], left: list[int]) -> None:
        table = np.array([(x, 0.0, 4.5, 1.9, 0.0, 0.5) for x in (0, 30, 60, 150)], float)
        boxes = Boxes.placed(table, (0.0, 0.0, 0.0))
        given = [Share(capture(20.0, drone=1), what, 1.0, roi, weight) for what, roi, weight in shares]
        assert received_only(boxes, capture()._replace(looked=False), given).xy_m[:, 0].tolist() == left

    assert wrong_rows(rows, check) == {}
