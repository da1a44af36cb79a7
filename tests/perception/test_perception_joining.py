"""Boxes of several drones as one list: suppression, and means against a plain loop."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from perception_examples import cross

from sortie.perception.joining import NMS_IOU, OWN_WEIGHT, EgoSources, Rule, SourceBoxes, joined, joined_many, source_of
from sortie.perception.lateness import SIGMA0_M, reach_m, still_right
from sortie.perception.metrics.ap import suppress
from sortie.perception.metrics.overlap import iou_pairs
from sortie.perception.network.detector import TorchDetector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.types import Boxes, Share
from sortie.scenarios.schema import Perception, Scene

HERE = (0.0, 0.0, 0.0)


def boxes(*rows: tuple[float, ...]) -> Boxes:
    """Of (x, y, score) or (x, y, score, yaw), cars of 4.5 m × 1.9 m."""
    table = np.array([(x, y, 4.5, 1.9, more[0] if more else 0.0, score) for x, y, score, *more in rows])
    return Boxes.placed(table.reshape(-1, 6), HERE)


def source(*rows: tuple[float, ...], weight: float = 1.0) -> SourceBoxes:
    return SourceBoxes(boxes(*rows), weight, HERE)


def test_of_boxes_that_overlap_suppression_keeps_the_best_and_whatever_stands_alone() -> None:
    own, peer = boxes((0, 0, 0.5), (30, 0, 0.15)), source((0.3, 0, 0.8), (60, 0, 0.3))
    out = joined(HERE, own, False, [peer], "nms")
    assert out.score.tolist() == pytest.approx([0.8, 0.3, 0.15])
    assert out.xy_m[0, 0] == pytest.approx(0.3)


@pytest.mark.parametrize("rule", ["nms", "average"])
def test_what_lies_outside_the_egos_square_is_not_its_own(rule: Rule) -> None:
    peer = SourceBoxes(boxes((101, 0, 0.5), (108, 0, 0.9)), 1.0, (50.0, 0.0, 0.0))
    assert joined(HERE, boxes(), False, [peer], rule).xy_m[:, 0].tolist() == [101.0]
    turned = (0.0, 0.0, np.pi / 4)  # its corner reaches 145 m ahead
    assert len(joined(turned, boxes(), False, [peer], rule)) == 2


@pytest.mark.parametrize("rule", ["nms", "average"])
def test_nobody_heard_leaves_the_egos_boxes_as_they_are(rule: Rule) -> None:
    own = boxes((0, 0, 0.5), (30, 0, 0.15))
    assert joined(HERE, own, False, [], rule) is own
    mute = joined(HERE, own, True, [source((0.3, 0, 0.8), weight=0.0)], rule)
    np.testing.assert_allclose(mute.table(), own.table(), atol=1e-6)
    np.testing.assert_allclose(mute.score, own.score, rtol=1e-6)
    assert len(joined(HERE, boxes(), False, [source()], rule)) == 0


def test_the_average_lies_between_and_is_scored_by_all_who_looked() -> None:
    own, peer, silent = boxes((0, 0, 0.5), (30, 0, 0.3)), source((0.6, 0.2, 0.25)), source((60, 0, 0.9))
    out = joined(HERE, own, False, [peer, silent], "average")
    assert out.xy_m[0].tolist() == pytest.approx([60, 0])
    assert out.score.tolist() == pytest.approx([0.9 / 3, (0.5 + 0.25) / 3, 0.3 / 3])
    assert out.xy_m[1].tolist() == pytest.approx([0.6 / 3, 0.2 / 3])
    assert out.size_m[1].tolist() == pytest.approx([4.5, 1.9])


def test_the_egos_answer_counts_twice_where_maps_are_in_it_and_a_peers_by_its_weight() -> None:
    own = boxes((0, 0, 0.5))
    fused = joined(HERE, own, True, [source((0.6, 0, 0.5), weight=0.5)], "average")
    assert fused.xy_m[0, 0] == pytest.approx(0.6 * 0.5 / (OWN_WEIGHT + 0.5))
    assert fused.score[0] == pytest.approx(0.5)


def test_headings_are_averaged_as_axes_and_point_where_the_best_box_does() -> None:
    out = joined(HERE, boxes((0, 0, 0.6, np.pi - 0.1)), False, [source((0, 0, 0.3, 0.05))], "average")
    twice = (0.6 * np.exp(-0.2j) + 0.3 * np.exp(0.1j)) / 0.9
    assert out.yaw_rad[0] == pytest.approx(np.pi + np.angle(twice) / 2, abs=1e-6)


def test_who_could_not_see_a_place_or_left_weak_boxes_out_does_not_vote_it_down() -> None:
    own = boxes((100, 0, 0.6))
    behind = SourceBoxes(boxes(), 1.0, (-20.0, 0.0, 0.0))
    assert joined(HERE, own, False, [behind], "average").score[0] == pytest.approx(0.6)
    aside = SourceBoxes(boxes(), 1.0, HERE, roi=(0.0, 0.0, 50.0))
    assert joined(HERE, own, False, [aside], "average").score[0] == pytest.approx(0.6)
    assert joined(HERE, own, False, [replace(aside, roi=(60.0, 0.0, 50.0))], "average").score[0] == pytest.approx(0.3)
    asked_too_far = replace(behind, roi=(100.0, 0.0, 50.0))  # of a region that its square does not hold
    assert joined(HERE, own, False, [asked_too_far], "average").score[0] == pytest.approx(0.6)
    many = boxes(*[(-90 + 8 * k, 40, 0.9 - 0.01 * k) for k in range(13)])
    share = Share(cross(10.0, 20.0, 0.3)[0], "tracks", 1.0, None, 1.0)
    cut, whole = source_of(share, many), source_of(share, many.take(np.arange(12)))
    assert (len(cut.boxes), cut.truncated, whole.truncated) == (12, True, False)
    at = replace(cut, pose=HERE)
    assert joined(HERE, own, False, [at], "average").score.tolist().count(pytest.approx(0.6)) == 1


CAR = np.array([[4.5, 1.9]])


def left(age_s: float) -> float:
    """What an age leaves of a car's score."""
    return float(still_right(reach_m(CAR), age_s)[0])


@pytest.mark.parametrize("rule", ["nms", "average"])
def test_a_peers_score_is_discounted_by_weight_and_age(rule: Rule) -> None:
    """A drone without a look of its own, so that nobody else's silence counts."""

    def score(**changes: float) -> float:
        peer = replace(source((0, 0, 0.8)), **changes)
        return float(joined_many([EgoSources(HERE, boxes(), False, [peer], looked=False)], rule)[0].score[0])

    assert score() == pytest.approx(0.8)
    assert score(weight=0.05) == pytest.approx(0.04)
    assert score(age_s=0.3) == pytest.approx(0.8 * left(0.3))
    assert score(weight=0.5, age_s=0.3) == pytest.approx(0.4 * left(0.3))
    assert score(age_s=60.0) > 0.3  # cars that stand stay


def test_under_suppression_an_own_box_stands_against_a_late_or_a_doubted_one() -> None:
    own = boxes((0, 0, 0.5))
    for peer, stays in (
        (source((0.6, 0, 0.8)), 0.6),
        (source((0.6, 0, 0.8), weight=0.5), 0.0),
        (replace(source((0.6, 0, 0.8)), age_s=0.5), 0.0),
    ):
        out = joined(HERE, own, False, [peer], "nms")
        assert out.xy_m[:, 0].tolist() == pytest.approx([stays])


def test_a_mean_points_where_the_best_box_does_after_what_weight_and_age_leave() -> None:
    """A late or doubted box with the higher score is not the best one."""
    own, other = boxes((0, 0, 0.5)), source((0.2, 0, 0.6, np.pi))
    assert 0.6 * left(1.0) < 0.5
    for peer, yaw_rad in ((other, np.pi), (replace(other, age_s=1.0), 0.0), (replace(other, weight=0.8), 0.0)):
        (out,) = joined_many([EgoSources(HERE, own, False, [peer])], "average")
        assert len(out) == 1
        assert np.cos(out.yaw_rad[0] - yaw_rad) == pytest.approx(1.0, abs=1e-5)


def test_ages_count_beside_the_freshest_look() -> None:
    """All of one age: as if all were fresh. An own look that is the oldest gives way."""
    own, peer = boxes((0, 0, 0.6)), source((0.6, 0, 0.5), (40, 0, 0.5))
    for rule in get_args(Rule):
        fresh = joined(HERE, own, False, [peer], rule)
        (alike,) = joined_many([EgoSources(HERE, own, False, [replace(peer, age_s=0.3)], age_s=0.3)], rule)
        np.testing.assert_allclose(alike.table(), fresh.table())
        np.testing.assert_allclose(alike.score, fresh.score)
    (resting,) = joined_many([EgoSources(HERE, own, False, [replace(peer, age_s=0.1)], age_s=1.0)], "nms")
    assert sorted(resting.xy_m[:, 0].tolist()) == pytest.approx([0.6, 40.0])
    assert resting.score.tolist() == pytest.approx([0.5, 0.5])


def test_in_a_mean_a_late_place_counts_less_unless_the_car_stands() -> None:
    own = boxes((0, 0, 0.5))
    (near,) = joined(HERE, own, False, [replace(source((0.3, 0, 0.5)), age_s=1.0)], "average").xy_m[:, 0]
    (far,) = joined(HERE, own, False, [replace(source((2.4, 0, 0.5)), age_s=1.0)], "average").xy_m[:, 0]
    assert 0.14 < near < 0.15  # half-way is 0.15
    assert 0.0 < far < 0.1  # half-way is 1.2


@pytest.mark.parametrize("rule", ["nms", "average"])
def test_boxes_with_a_velocity_are_moved_and_a_known_variance_takes_the_ages_place(rule: Rule) -> None:
    velocity = np.array([[10.0, 0.0], [np.nan, np.nan]])
    peer = replace(source((0, 0, 0.5), (40, 0, 0.5)), age_s=0.5, velocity_mps=velocity)
    blind = EgoSources(HERE, boxes(), False, [peer], looked=False)
    assert sorted(joined_many([blind], rule)[0].xy_m[:, 0].tolist()) == pytest.approx([5.0, 40.0])
    sure = replace(peer, variance_m2=np.array([SIGMA0_M**2, np.nan]))
    out = joined_many([blind._replace(others=[sure])], rule)[0]
    assert out.score.tolist() == pytest.approx([0.5, 0.5 * left(0.5)])
    assert out.xy_m[:, 0].tolist() == pytest.approx([5.0, 40.0])


@pytest.mark.parametrize("rule", ["nms", "average"])
def test_a_drone_without_a_look_has_its_peers_boxes_and_no_vote(rule: Rule) -> None:
    peer = source((0, 0, 0.6), (30, 0, 0.4), (200, 0, 0.9))
    (out,) = joined_many([EgoSources(HERE, boxes(), False, [peer], looked=False)], rule)
    assert out.score.tolist() == pytest.approx([0.6, 0.4])
    (nobody,) = joined_many([EgoSources(HERE, boxes(), False, [replace(peer, weight=0.0)], looked=False)], rule)
    assert len(nobody) == 0


def plainly(own: Boxes, others: list[SourceBoxes]) -> list[tuple[float, float, float]]:
    """The average's (x, y, score), by loops; everybody sees everything."""
    everyone = [(own, 1.0), *((t.boxes, t.weight) for t in others)]
    rows = [
        (float(b.score[k]) * w, float(b.score[k]), who, b.table()[k])
        for who, (b, w) in enumerate(everyone)
        for k in range(len(b))
    ]
    rows.sort(key=lambda r: -r[0])
    groups: list[list[tuple[float, float, int, np.ndarray]]] = []
    for r in rows:
        for g in groups:
            if iou_pairs(g[0][3][None], r[3][None])[0] > NMS_IOU:
                g.append(r)
                break
        else:
            groups.append([r])
    out = []
    for g in groups:
        x, y = (sum(r[0] * r[3][k] for r in g) / sum(r[0] for r in g) for k in (0, 1))
        score = sum(w * max([r[1] for r in g if r[2] == who], default=0.0) for who, (_, w) in enumerate(everyone))
        out.append((x, y, score / sum(w for _, w in everyone)))
    return sorted(out, key=lambda r: -r[2])


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), drones=st.integers(1, 4), cars=st.integers(0, 12))
def test_the_average_is_what_a_plain_loop_says(seed: int, drones: int, cars: int) -> None:
    rng = np.random.default_rng(seed)

    def some() -> Boxes:
        rows = np.column_stack([rng.uniform(-15, 15, (cars, 2)), rng.uniform(0.1, 1, cars), rng.uniform(-3, 3, cars)])
        return suppress(boxes(*map(tuple, rows)), NMS_IOU)

    own, others = some(), [SourceBoxes(some(), float(rng.uniform(0.2, 1)), HERE) for _ in range(drones)]
    out, want = joined(HERE, own, False, others, "average"), plainly(own, others)
    assert len(out) == len(want)
    if want:
        np.testing.assert_allclose(out.score, [w[2] for w in want], rtol=1e-5)
        order, by = np.lexsort(out.xy_m.T), np.lexsort(np.array(want).T[:2])
        np.testing.assert_allclose(out.xy_m[order], np.array(want)[by, :2], atol=1e-4)


@pytest.mark.parametrize("make", [TorchDetector, SurrogateDetector])
def test_detectors_join_as_the_scenario_says(make: type[TorchDetector]) -> None:
    scene, fleet = SceneModel(Scene(), None, (-50, -50, 50, 50)), cross(10.0, 20.0, 0.3)
    shares = [Share(c, "detections", 0.0, None, 1.0) for c in fleet[1:]]
    job = [(fleet[0], shares), *((c, ()) for c in fleet[1:])]
    for rule in get_args(Rule):
        out, *alone = make(scene, Perception(join=rule), 1).detect(job)
        own = make(scene, Perception(join=rule), 1).detect([(fleet[0], ())])[0]
        others = [source_of(s, b) for s, b in zip(shares, alone, strict=True)]
        want = joined(fleet[0].est_pose, own, False, others, rule)
        np.testing.assert_array_equal(out.table(), want.table())
        np.testing.assert_array_equal(out.score, want.score)


@pytest.mark.parametrize("rule", ["nms", "average"])
def test_many_egos_at_once_are_each_as_alone(rule: Rule) -> None:
    """Egos in one place or far from one another, with nothing to join, with mute peers, with all boxes out of reach."""
    rng = np.random.Generator(np.random.PCG64(3))

    def some(count: int, about: tuple[float, float]) -> Boxes:
        xy = np.array(about) + rng.uniform(-130.0, 130.0, (count, 2)).round()
        each = np.concatenate([xy, np.tile((4.5, 1.9), (count, 1)), rng.uniform(-3, 3, (count, 1))], axis=1)
        score = np.sort(rng.uniform(0.1, 1.0, count).round(1))[::-1]  # many are alike
        return Boxes(*(v.astype(np.float32) for v in (each[:, :2], each[:, 2:4], each[:, 4], score)))

    egos = []
    for k in range(12):
        pose = (400.0 * (k % 3), 0.0, 0.5 * k)
        others = [
            SourceBoxes(
                some(40 * (k % 4), pose[:2]), 0.25 * (j % 3), pose, (*pose[:2], 60.0) if j == 1 else None, j == 2
            )
            for j in range(k % 5)
        ]
        egos.append(EgoSources(pose, some(60, pose[:2]), k % 2 == 0, others))
    egos.append(EgoSources((5000.0, 0.0, 0.0), some(5, (0.0, 0.0)), False, egos[3].others))
    together = joined_many(egos, rule)
    assert len(together) == len(egos)
    for many, ego in zip(together, egos, strict=True):
        alone = joined(*ego[:4], rule)
        for field in ("xy_m", "size_m", "yaw_rad", "score"):
            assert getattr(many, field).tobytes() == getattr(alone, field).tobytes()
    assert together[0] is egos[0].own
    assert len(together[-1]) == 0
    assert len({len(b) for b in together}) > 4
    assert joined_many([], rule) == []
