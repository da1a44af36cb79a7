"""Boxes of several drones as one list: suppression and means, who votes, and what weight and age leave."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from perception_examples import boxes_at, capture, cross
from track_examples import tracks

from sortie.perception.classes import CAR, PERSON
from sortie.perception.joining import NMS_IOU, OWN_WEIGHT, EgoSources, Rule, SourceBoxes, joined, joined_many, source_of
from sortie.perception.lateness import CARS, SIGMA0_M, reach_m, still_right
from sortie.perception.metrics.ap import suppress
from sortie.perception.metrics.overlap import iou_pairs
from sortie.perception.network.detector import TorchDetector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.tracking.following import motion_of_boxes
from sortie.perception.types import Boxes, Share
from sortie.perception.uncertainty import BoxErrors
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Perception, Scene
from sortie.sim.engine.fusing import of_vehicles

HERE = (0.0, 0.0, 0.0)
ERRORS = BoxErrors((0.4, -0.1, 0.0, 0.2, 0.0), (-1.2, 0.0, 0.1, 0.1, 0.0), 0.9)
RULES = get_args(Rule)
both_rules = pytest.mark.parametrize("rule", RULES)


def source(*rows: tuple[float, ...], weight: float = 1.0, **more: Any) -> SourceBoxes:
    return SourceBoxes(boxes_at(*rows), weight, HERE, **more)


def left(age_s: float) -> float:
    """What an age leaves of a car's score."""
    return float(still_right(reach_m(np.array([[4.5, 1.9]])), age_s)[0])


def blind(rule: Rule, *others: SourceBoxes) -> Boxes:
    """What a drone without a look of its own joins, so that nobody else's silence counts."""
    return joined_many([EgoSources(HERE, Boxes.empty(), False, list(others), looked=False)], rule)[0]


def test_of_boxes_that_overlap_suppression_keeps_the_best_and_whatever_stands_alone() -> None:
    own, peer = boxes_at((0, 0, 0.5), (30, 0, 0.15)), source((0.3, 0, 0.8), (60, 0, 0.3))
    out = joined(HERE, own, False, [peer], "nms")
    assert out.score.tolist() == pytest.approx([0.8, 0.3, 0.15])
    assert out.xy_m[0, 0] == pytest.approx(0.3)


@both_rules
def test_what_lies_outside_the_egos_square_is_not_its_own(rule: Rule) -> None:
    peer = SourceBoxes(boxes_at((101, 0, 0.5), (108, 0, 0.9)), 1.0, (50.0, 0.0, 0.0))
    assert joined(HERE, Boxes.empty(), False, [peer], rule).xy_m[:, 0].tolist() == [101.0]
    turned = (0.0, 0.0, np.pi / 4)  # its corner reaches 145 m ahead
    assert len(joined(turned, Boxes.empty(), False, [peer], rule)) == 2


@both_rules
def test_nobody_heard_leaves_the_egos_boxes_as_they_are(rule: Rule) -> None:
    own = boxes_at((0, 0, 0.5), (30, 0, 0.15))
    assert joined(HERE, own, False, [], rule) is own
    mute = joined(HERE, own, True, [source((0.3, 0, 0.8), weight=0.0)], rule)
    np.testing.assert_allclose(mute.table(), own.table(), atol=1e-6)
    np.testing.assert_allclose(mute.score, own.score, rtol=1e-6)
    assert len(joined(HERE, Boxes.empty(), False, [source()], rule)) == 0


def test_the_average_lies_between_and_is_scored_by_all_who_looked() -> None:
    own, peer, silent = boxes_at((0, 0, 0.5), (30, 0, 0.3)), source((0.6, 0.2, 0.25)), source((60, 0, 0.9))
    out = joined(HERE, own, False, [peer, silent], "average")
    assert out.xy_m[0].tolist() == pytest.approx([60, 0])
    assert out.score.tolist() == pytest.approx([0.9 / 3, (0.5 + 0.25) / 3, 0.3 / 3])
    assert out.xy_m[1].tolist() == pytest.approx([0.6 / 3, 0.2 / 3])
    assert out.size_m[1].tolist() == pytest.approx([4.5, 1.9])


def test_the_egos_answer_counts_twice_where_maps_are_in_it_and_a_peers_by_its_weight() -> None:
    fused = joined(HERE, boxes_at((0, 0, 0.5)), True, [source((0.6, 0, 0.5), weight=0.5)], "average")
    assert fused.xy_m[0, 0] == pytest.approx(0.6 * 0.5 / (OWN_WEIGHT + 0.5))
    assert fused.score[0] == pytest.approx(0.5)


def test_headings_are_averaged_as_axes_and_point_where_the_best_box_does() -> None:
    for best, other in ((np.pi - 0.1, 0.05), (2.0, 2.1 - np.pi), (-1.2, -1.0)):
        own, peer = boxes_at((0, 0, 0.6, best)), source((0, 0, 0.3, other))
        (yaw,) = joined(HERE, own, False, [peer], "average").yaw_rad
        twice = (0.6 * np.exp(2j * best) + 0.3 * np.exp(2j * other)) / 0.9
        wanted = np.exp(0.5j * np.angle(twice))
        wanted *= np.sign((wanted * np.exp(-1j * best)).real)
        assert abs(np.exp(1j * yaw) - wanted) < 1e-6, (best, other)


def test_who_could_not_see_a_place_or_left_weak_boxes_out_does_not_vote_it_down() -> None:
    own = boxes_at((100, 0, 0.6))
    behind, aside = SourceBoxes(Boxes.empty(), 1.0, (-20.0, 0.0, 0.0)), source(roi=(0.0, 0.0, 50.0))
    asked_too_far = replace(behind, roi=(100.0, 0.0, 50.0))  # of a region that its square does not hold
    asked = replace(aside, roi=(60.0, 0.0, 50.0))
    for silent, score in ((behind, 0.6), (aside, 0.6), (asked_too_far, 0.6), (asked, 0.3)):
        assert joined(HERE, own, False, [silent], "average").score[0] == pytest.approx(score)
    cut = replace(source(*[(-90 + 8 * k, 40, 0.9 - 0.01 * k) for k in range(12)]), truncated=True)
    assert joined(HERE, own, False, [cut], "average").score.tolist().count(pytest.approx(0.6)) == 1


@both_rules
def test_a_peers_score_is_discounted_by_weight_and_age(rule: Rule) -> None:
    def score(**changes: float) -> float:
        return float(blind(rule, replace(source((0, 0, 0.8)), **changes)).score[0])

    assert score() == pytest.approx(0.8)
    assert score(weight=0.05) == pytest.approx(0.04)
    assert score(weight=0.5, age_s=0.3) == pytest.approx(0.4 * left(0.3))
    assert score(age_s=60.0) > 0.3  # cars that stand stay
    late = EgoSources(HERE, Boxes.empty(), False, [source((0, 0, 0.8), age_s=0.7)], age_s=0.3, looked=False)
    assert late.freshest_s == 0.0  # no look of its own that it could be compared with
    assert joined_many([late], rule)[0].score == pytest.approx(0.8 * left(0.7), rel=1e-5)


def test_under_suppression_an_own_box_stands_against_a_late_or_a_doubted_one() -> None:
    own = boxes_at((0, 0, 0.5))
    for peer, stays in (
        (source((0.6, 0, 0.8)), 0.6),
        (source((0.6, 0, 0.8), weight=0.5), 0.0),
        (replace(source((0.6, 0, 0.8)), age_s=0.5), 0.0),
    ):
        out = joined(HERE, own, False, [peer], "nms")
        assert out.xy_m[:, 0].tolist() == pytest.approx([stays])


def test_a_mean_points_where_the_best_box_does_after_what_weight_and_age_leave() -> None:
    """A late or doubted box with the higher score is not the best one."""
    own, other = boxes_at((0, 0, 0.5)), source((0.2, 0, 0.6, np.pi))
    assert 0.6 * left(1.0) < 0.5
    for peer, yaw_rad in ((other, np.pi), (replace(other, age_s=1.0), 0.0), (replace(other, weight=0.8), 0.0)):
        (out,) = joined_many([EgoSources(HERE, own, False, [peer])], "average")
        assert len(out) == 1
        assert np.cos(out.yaw_rad[0] - yaw_rad) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("join", ["nms", "average"])
def test_an_own_look_that_is_older_than_what_came_loses_as_anything_late_does(join: Any) -> None:
    """Alone at its places it keeps what its age leaves beside the fresher share, and no more."""
    ego, peer = capture(0.0, 0.0, t_s=5.0), capture(0.0, 0.0, drone=1, t_s=5.5)
    own, theirs = boxes_at((0, 0, 0.8), (30, 5, 0.6)), boxes_at((-40, 8, 0.5))
    share = Share(peer, "detections", 0.0, None, 1.0, (), 0.1, boxes=theirs)
    sources = EgoSources.of(ego, [share], own, False, [source_of(share, None)])
    assert sources.age_s == pytest.approx(0.6)
    (found,) = joined_many([sources], join)
    left = float(np.divide(*still_right(reach_m(own.size_m[:1]), np.array([0.6, 0.1]))))
    assert 0.3 < left < 0.9
    wanted = {30: 0.6 * left, 0: 0.8 * left, -40: 0.5}
    if join == "average":  # the other one looked there and saw nothing
        wanted = {30: 0.6 * left / (1 + left), 0: 0.8 * left / (1 + left), -40: 0.5 / (1 + left)}
    got = {round(float(x)): float(score) for (x, _), score in zip(found.xy_m, found.score, strict=True)}
    assert got == pytest.approx(wanted, rel=1e-4)


def test_who_saw_nothing_lately_says_as_much_as_its_boxes_would() -> None:
    """In a mean over all who looked: a late look counts by what its age leaves, whether it has a box there or not."""

    for weight, own_s, peer_s in product((1.0, 0.4), (0.0, 0.1, 0.7), (0.0, 0.1, 0.7)):
        fresh = left(min(own_s, peer_s))
        mine, silent = left(own_s) / fresh, left(peer_s) / fresh
        peer = source((40, 0, 0.5), weight=weight, age_s=peer_s)
        (found,) = joined_many([EgoSources(HERE, boxes_at((0, 0, 0.8)), False, [peer], own_s)], "average")
        voters = max(mine + weight * silent, 1.0)
        scores = {round(x): score for (x, _), score in zip(found.xy_m.tolist(), found.score.tolist(), strict=True)}
        assert scores == pytest.approx({0: 0.8 * mine / voters, 40: 0.5 * weight * silent / voters}, rel=1e-4)


@both_rules
def test_boxes_with_a_velocity_are_moved_and_a_known_variance_takes_the_ages_place(rule: Rule) -> None:
    velocity = np.array([[10.0, 0.0], [np.nan, np.nan]])
    peer = source((0, 0, 0.5), (40, 0, 0.5), age_s=0.5, velocity_mps=velocity)
    assert sorted(blind(rule, peer).xy_m[:, 0].tolist()) == pytest.approx([5.0, 40.0])
    out = blind(rule, replace(peer, variance_m2=np.array([SIGMA0_M**2, np.nan])))
    assert out.score.tolist() == pytest.approx([0.5, 0.5 * left(0.5)])
    assert out.xy_m[:, 0].tolist() == pytest.approx([5.0, 40.0])


@both_rules
def test_a_drone_without_a_look_has_its_peers_boxes_and_no_vote(rule: Rule) -> None:
    peer = source((0, 0, 0.6), (30, 0, 0.4), (200, 0, 0.9))
    assert blind(rule, peer).score.tolist() == pytest.approx([0.6, 0.4])
    assert len(blind(rule, replace(peer, weight=0.0))) == 0


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
        return suppress(boxes_at(*map(tuple, rows)), NMS_IOU)

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


# --- what is taken of a share and of its ego ------------------------------------------------------------


def test_boxes_are_as_uncertain_as_they_look_from_where_the_sender_believed_to_be() -> None:
    """What was sent was worked out by the sender, who knows no truth."""
    boxes = boxes_at((40.0, 10.0, 0.8), (-20.0, 35.0, 0.3))
    seen = capture(0.0, 0.0, yaw=0.0, est=(15.0, -12.0, 60.0, 0.4))
    got = source_of(Share(seen, "uncertain_boxes", 1.0, None, 1.0), boxes, ERRORS).covariance_m2
    assert got is not None
    np.testing.assert_array_equal(got, ERRORS.covariances_m2(boxes.xy_m, boxes.score, (15.0, -12.0, 0.4)))
    assert np.abs(got - ERRORS.covariances_m2(boxes.xy_m, boxes.score, HERE)).max() > 0.01


@pytest.mark.parametrize(
    ("looked", "fused", "counts"), [(True, False, True), (False, True, True), (False, False, False)]
)
def test_an_ego_without_a_look_counts_where_maps_were_fused_for_it(looked: bool, fused: bool, counts: bool) -> None:
    ego = capture()._replace(looked=looked)
    found = EgoSources.of(ego, (), boxes_at((5.0, 5.0, 0.9)), fused, [])
    assert found.looked is counts
    assert len(found.sources()) == counts


@pytest.mark.parametrize(
    ("maps", "age_s"),
    [([(1.0, 0.8), (0.5, 0.6)], 0.6), ([(1.0, 0.8), (0.0, 0.6)], 0.8), ([(0.0, 0.6)], 0.0), ([], 0.0)],
)
def test_fused_boxes_of_an_ego_without_a_look_are_as_old_as_the_freshest_map(
    maps: list[tuple[float, float]], age_s: float
) -> None:
    """The weight and the age of each map; detections that are fresher still do not count."""
    blind = capture()._replace(looked=False)
    shares = [Share(capture(drone=1, t_s=5.0 - age), "features", 1.0, None, weight, age_s=age) for weight, age in maps]
    shares.append(Share(capture(drone=2, t_s=4.9), "detections", 0.0, None, 1.0, age_s=0.1))
    assert EgoSources.of(blind, shares, boxes_at((5.0, 5.0, 0.9)), True, []).age_s == age_s
    assert EgoSources.of(blind._replace(looked=True), shares, Boxes.empty(), True, []).age_s == 0.0


@both_rules
def test_a_peer_that_is_not_trusted_at_all_changes_nothing_by_being_fresh(rule: str) -> None:
    """What all others bring is as old as the ego's own look, so that nobody's boxes lose by their age."""
    own, theirs = boxes_at((20.0, 0.0, 0.6)), boxes_at((40.0, 0.0, 0.8), (20.5, 0.0, 0.5))
    others = [SourceBoxes(theirs, 1.0, HERE, age_s=0.5), SourceBoxes(boxes_at((60.0, 0.0, 0.9)), 0.0, HERE)]
    lost, fresh = (
        joined_many([EgoSources(HERE, own, False, some, age_s=0.5)], rule)[0] for some in (others[:1], others)
    )
    assert fresh.xy_m.tolist() == lost.xy_m.tolist()
    assert fresh.score.tolist() == lost.score.tolist()
    assert fresh.score[0] == pytest.approx(0.8 if rule == "nms" else 0.55)


@pytest.mark.parametrize("known", [(0.35**2, np.nan), (np.nan, 0.35**2)])
def test_of_two_boxes_of_a_drone_for_one_car_the_surer_one_is_its_vote(known: tuple[float, float]) -> None:
    """One of both is known to be where it was, whatever its age; the drone's vote loses nothing by the other."""
    late = source((20.0, 0.0, 0.8), (20.6, 0.0, 0.8), age_s=0.8, variance_m2=np.array(known))
    assert blind("average", late).score.tolist() == pytest.approx([0.8])


def test_a_late_box_exactly_on_the_fresh_one_counts_as_one_beside_it() -> None:
    """That it lies there tells that the car stands, a tenth of a millimetre off as well."""
    own = boxes_at((20.0, 0.0, 0.6))
    late = [EgoSources(HERE, own, False, [source((x, 0.0, 0.9), age_s=1.0)]) for x in (20.0, 20.0001)]
    exact, close = (joined_many([ego], "average")[0].score[0] for ego in late)
    assert exact == pytest.approx(close, rel=1e-5)


def test_a_known_variance_stays_with_its_box_however_boxes_are_sorted() -> None:
    """A place counts by score and inverse variance beside the fresh one; the best box is not the first that came."""
    own = boxes_at((20.0, 0.0, 0.6), (-20.0, 0.0, 0.5))
    theirs, variance = boxes_at((-19.6, 0.0, 0.3), (20.4, 0.0, 0.9)), np.array([3.0, 0.3])
    ego = EgoSources(HERE, own, False, [SourceBoxes(theirs, 1.0, HERE, age_s=0.4, variance_m2=variance)])
    (found,) = joined_many([ego], "average")
    wanted = []
    for mine, its, known, at in ((0.6, 0.9, 0.3, 20.0), (0.5, 0.3, 3.0, -20.0)):
        part = its * float(CARS.sigma0_m2) / known
        wanted.append(at + 0.4 * part / (mine + part))
    assert sorted(found.xy_m[:, 0].tolist()) == pytest.approx(sorted(wanted), abs=1e-5)


def test_only_tracks_that_may_have_been_cut_leave_places_open() -> None:
    """Twelve are the most that are sent: of a full list nobody knows whether it was cut. Detections are never cut."""
    share = Share(capture(), "detections", 0.0, None, 0.5)
    for n in (0, 3, 11, 12, 13, 40):
        alone = boxes_at(*[(6.0 * k, 0.0, 0.9 - 0.01 * k) for k in range(n)])
        assert (len(source_of(share, alone).boxes), source_of(share, alone).truncated) == (n, False)
        cut = source_of(share._replace(representation="tracks"), alone)
        assert (len(cut.boxes), cut.truncated) == (min(n, 12), n > 12)
        assert cut.boxes.score.tolist() == alone.score[:12].tolist()
        near = source_of(share._replace(representation="tracks", roi=Disc(0.0, 0.0, 20.0)), alone)
        assert not near.truncated  # few are inside, however many there are
        if n <= 12:
            kind = np.where(np.arange(n) < 3, PERSON, CAR).astype(np.int8)
            sent = share._replace(representation="tracks", tracks=tracks(n, kind=kind))
            assert (len(source_of(sent, None).boxes), source_of(sent, None).truncated) == (n, n == 12)
            cars = source_of(of_vehicles(sent), None)  # people in a full payload do not hide that it was cut
            assert (len(cars.boxes), cars.truncated) == (max(n - 3, 0), n == 12)


def test_a_late_box_goes_with_the_track_that_was_there_when_it_was_seen() -> None:
    """A track at 12 m/s is compared with the box where it was at the capture, not where it is at the fusion."""
    at = dict(t_s=np.array([6.0]), seen_s=np.array([6.0]), xy_m=np.array([[30.0, 5.0]]))
    track = tracks(1, **at, velocity_mps=np.array([[12.0, 0.0]]), covariance=np.array([[0.1, 0.0, 0.1]]))
    boxes = boxes_at((30.0 - 12.0, 5.0, 0.7), (30.0, 5.0, 0.6))
    share = Share(capture(t_s=5.0), "detections", 1.0, None, 1.0, age_s=1.0, tracks=track)
    got = source_of(share, boxes).velocity_mps
    assert got is not None
    np.testing.assert_array_equal(got, [[12.0, 0.0], [np.nan, np.nan]])


def test_only_a_confirmed_track_says_how_a_box_moves() -> None:
    """What a tentative one follows may be a false positive; a confirmed one farther away is taken in its place."""
    nan = float("nan")
    near = dict(xy_m=np.array([[10.0, 0.0], [11.0, 0.5]]), velocity_mps=np.array([[9.0, 0.0], [0.0, 8.0]]))
    for confirmed, wanted in (([True, True], [9.0, 0.0]), ([False, True], [0.0, 8.0]), ([False, False], [nan, nan])):
        some = tracks(2, **near, confirmed=np.array(confirmed))
        velocity, variance = motion_of_boxes(boxes_at((10.0, 0.0, 1.0)), 10.0, 0.5, some)
        np.testing.assert_allclose(velocity, [wanted])
        assert np.isnan(variance).all() == (not any(confirmed))
