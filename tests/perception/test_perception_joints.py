"""Perception's joints: which argument goes where, two options together, shares that are late or empty, independent draws.

Joints, each with a test below:

1. The time at which truth is taken, and the pose about which: of the scoring, and of the capture.
2. A drone's true pose and the one that it believes: images and truth go by the one, boxes and squares by the other, also
   where maps are fused.
3. Weight: of a map, of boxes; 0 is as if the share had not come, in every detector and under every rule.
4. Age: of the ego's own look, of the freshest one at hand, where there is no look of its own.
5. Region, budget and missing cells together.
6. Boxes that were cut: after the cut nothing shows that there were more.
7. Bytes of an index at every number of cells.
8. Errors of a drone's place: in what its thermal camera found, and in its false alarms.
9. Scores that are equal.
10. Sections of a scenario and what each detector takes of them.

Draws that must be independent of each other:

- the surrogate's: every column for a look, of drones, moments, seeds and replications; false positives, shared ones too;
- the thermal camera's: of drones, frames, people, and false alarms;
- camera noise: of drones, moments, seeds and replications.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from perception_examples import capture, cross
from recording_examples import small
from scipy.special import ndtr

from sortie.perception import budget
from sortie.perception.detectors import make_detector
from sortie.perception.evaluation import Sharing
from sortie.perception.evaluation.sharing import choose
from sortie.perception.ground_truth import ground_truth
from sortie.perception.joining import EgoSources, SourceBoxes, joined_many, source_of
from sortie.perception.lateness import map_weight, own_age_s, reach_m, still_right, weighed
from sortie.perception.metrics.ap import Matched, average_precision
from sortie.perception.network.detector import TorchDetector
from sortie.perception.recordings.detector import RecordedDetector
from sortie.perception.scene.render import Renderer
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.surrogate.draws import Drawn, DrawSource
from sortie.perception.surrogate.exchange import FeatureShares, pair
from sortie.perception.surrogate.features import CaptureColumns, Eyes
from sortie.perception.thermal import NOBODY, look
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Perception, Scene, Target, Thermal
from sortie.scenarios.shipped import NETWORKS

BOUNDS = (-50.0, -50.0, 50.0, 50.0)


@cache
def town() -> SceneModel:
    return SceneModel(Scene(moving_cars_per_km=30), Target(waypoints_m=((0, 0), (100, 0))), BOUNDS)


@cache
def surrogate(**config: Any) -> SurrogateDetector:
    return SurrogateDetector(town(), Perception(**config), 3)


@cache
def torch_detector() -> TorchDetector:
    return TorchDetector(town(), Perception(), 1)


DETECTORS: tuple[Callable[[], Any], ...] = (surrogate, torch_detector)


def same(a: Boxes, b: Boxes) -> bool:
    return len(a) == len(b) and all(np.array_equal(getattr(a, f), getattr(b, f)) for f in Boxes.__slots__)


def boxes_at(*rows: tuple[float, float, float]) -> Boxes:
    table = np.array([(x, y, 4.5, 1.9, 0.0, score) for x, y, score in rows]).reshape(-1, 6)
    return Boxes.placed(table, (0.0, 0.0, 0.0))


# --- truth ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("late_s", [0.0, 0.095, 1.5])
def test_truth_is_of_the_time_that_is_asked_for_about_the_true_pose(detector: Any, late_s: float) -> None:
    """Cars move between capture and scoring; the square stays where the drone truly was."""
    ego = capture(10.0, 20.0, yaw=0.4, t_s=5.0, est=(14.0, 15.0, 60.0, 0.9))
    cars = town().cars_at(5.0 + late_s)
    wanted = ground_truth(cars.table(), (10.0, 20.0, 0.4), identity=cars.ids).single()
    found = detector().truth(5.0 + late_s, ego)
    order, wanted_order = np.argsort(found.car), np.argsort(wanted.car)
    np.testing.assert_array_equal(found.car[order], wanted.car[wanted_order])
    np.testing.assert_allclose(found.xy_m[order], wanted.xy_m[wanted_order], atol=1e-4)
    if late_s:
        before = detector().truth(5.0, ego)
        both = np.intersect1d(found.car, before.car)
        moved = found.xy_m[np.isin(found.car, both)][np.argsort(found.car[np.isin(found.car, both)])]
        was = before.xy_m[np.isin(before.car, both)][np.argsort(before.car[np.isin(before.car, both)])]
        assert np.abs(moved - was).max() > 5.0 * late_s
    if hasattr(detector(), "truth_many"):
        (many,) = detector().truth_many([5.0 + late_s], [ego])
        assert same(many, found)


# --- true and believed poses ------------------------------------------------------------------------------


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("shares", [(), ("features",), ("raw",), ("detections",)])
def test_boxes_lie_where_the_drone_believes_it_is(detector: Any, shares: tuple[str, ...]) -> None:
    """Everybody's belief is off by the same: all boxes are, and nothing else changes."""
    off = np.array([7.0, -4.0])

    def found(dx: float, dy: float) -> Boxes:
        fleet = [
            c._replace(est_position_m=(c.position_m[0] + dx, c.position_m[1] + dy, 60.0))
            for c in cross(10.0, 20.0, 0.3)[:3]
        ]
        jobs = [(fleet[0], [Share(c, kind, 0.2, None, 1.0) for kind in shares for c in fleet[1:]])]
        (boxes,) = detector().detect(jobs)
        return boxes

    here, there = found(0.0, 0.0), found(*off.tolist())
    assert len(here) > 3
    assert len(there) == len(here)
    np.testing.assert_allclose(there.xy_m - here.xy_m, np.broadcast_to(off, here.xy_m.shape), atol=2e-2)
    np.testing.assert_allclose(there.score, here.score, atol=2e-3)


# --- weight -----------------------------------------------------------------------------------------------------


EVERY_KIND = ("features", "raw", "detections", "tracks")


@pytest.mark.parametrize(
    ("made", "kind", "join"),
    [
        *product([surrogate], EVERY_KIND, ["nms", "average"]),
        *product([torch_detector], ["features", "detections", "tracks"], ["nms"]),
    ],
)
def test_a_share_of_no_weight_is_as_if_it_had_not_come(made: Any, kind: str, join: Any) -> None:
    """Beside others, and alone."""
    detector = made() if made is torch_detector else made(join=join)
    ego, a, b = cross(10.0, 20.0, 0.3)[:3]
    own = detector.detect([(ego, [])])[0]
    assert same(detector.detect([(ego, [Share(a, kind, 0.2, None, 0.0)])])[0], own)
    with_b = detector.detect([(ego, [Share(b, "detections", 0.0, None, 1.0)])])[0]
    both = detector.detect([(ego, [Share(a, kind, 0.2, None, 0.0), Share(b, "detections", 0.0, None, 1.0)])])[0]
    assert same(both, with_b)


def test_the_weight_of_a_map_matters_to_the_surrogate_and_to_the_network() -> None:
    """Between nothing and one there is more than two."""
    ego, a = cross(10.0, 20.0, 0.3)[:2]
    for detector in (surrogate(), torch_detector()):
        found = [detector.detect([(ego, [Share(a, "features", 0.3, None, w)])])[0] for w in (0.0, 0.3, 1.0)]
        assert not same(found[0], found[1])
        assert not same(found[1], found[2])


@pytest.mark.parametrize("rule", ["nms", "average"])
def test_a_source_of_no_weight_and_one_that_nobody_sent_leave_equal_boxes(rule: Any) -> None:
    own = boxes_at((0, 0, 0.5), (30, 5, 0.4))
    peer = SourceBoxes(boxes_at((0.2, 0, 0.9), (60, 0, 0.8)), 0.5, (0.0, 0.0, 0.0))
    empty = dataclasses.replace(peer, weight=0.0, age_s=-5.0)
    with_it, without = (
        joined_many([EgoSources((0.0, 0.0, 0.0), own, False, others, 0.3)], rule)[0]
        for others in ([peer, empty], [peer])
    )
    assert same(with_it, without)


# --- age ------------------------------------------------------------------------------------------------------------


def test_ages_are_compared_with_the_freshest_look_at_hand() -> None:
    """The ego's own where it has looked, else the freshest that came; only what is older loses."""
    ego, a, b, c = cross(0.0, 0.0, 0.0, t_s=5.0)[:4]

    def late(who: Capture, age_s: float, now_s: float = 5.1) -> Share:
        return Share(who._replace(t_s=now_s - age_s), "features", 0.2, None, 0.8, (), age_s)

    shares = [late(a, 0.1), late(b, 0.4), late(c, 0.7)]
    assert own_age_s(ego, shares) == pytest.approx(0.1)
    weights = [s.weight for s in weighed(ego, shares)]
    assert weights == pytest.approx([0.8, 0.8 * map_weight(0.4, 0.1), 0.8 * map_weight(0.7, 0.1)])
    blind = ego._replace(looked=False)
    rest = shares[1:]
    assert [s.weight for s in weighed(blind, rest)] == pytest.approx([0.8, 0.8 * map_weight(0.7, 0.4)])
    # a receiver may hold an age to be longer than it is: the moment is that of the one that it knows best
    assert own_age_s(ego, [*shares, late(b, 0.2)._replace(age_s=0.9)]) == pytest.approx(0.1)
    boxes = late(b, 0.4)._replace(representation="detections")
    assert weighed(ego, [boxes]) == [boxes]
    assert 0.0 < map_weight(0.7, 0.1) < map_weight(0.4, 0.1) < map_weight(0.1, 0.1) == 1.0


@pytest.mark.parametrize(
    ("made", "kind", "join"),
    [*product(["surrogate", "recorded"], EVERY_KIND, ["nms", "average"]), *product(["torch"], EVERY_KIND, ["nms"])],
)
def test_a_share_as_old_as_the_ego_s_own_look_counts_as_if_both_were_of_now(
    made: str, kind: str, join: Any, tmp_path: Path
) -> None:
    """Lateness is beside the freshest look at hand, and that is the ego's own: nothing is older than it."""
    ego, peer = cross(10.0, 20.0, 0.3)[:2]
    detector: Any = torch_detector() if made == "torch" else surrogate(join=join)
    if made == "recorded":
        path = small(tmp_path / "flown.npz", features=None)
        detector = RecordedDetector(Perception(detector="recorded", recording=str(path), join=join))
        ego, peer = (capture(10.0 * i, 0.0, drone=i, t_s=0.0) for i in range(2))
    weight = (
        0.7913  # with 0.8, a mean of two scores is often half-way between two float32: a last bit rounds it up or down
    )
    now, late = (detector.detect([(ego, [Share(peer, kind, 0.5, None, weight, (), age_s)])])[0] for age_s in (0.0, 0.4))
    assert len(now) > 0
    assert same(now, late)


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


@pytest.mark.parametrize("weight", [1.0, 0.4])
@pytest.mark.parametrize(("own_s", "peer_s"), [(0.0, 0.0), (0.0, 0.7), (0.1, 0.7), (0.7, 0.1)])
def test_who_saw_nothing_lately_says_as_much_as_its_boxes_would(own_s: float, peer_s: float, weight: float) -> None:
    """In a mean over all who looked: a late look counts by what its age leaves, whether it has a box there or not."""
    own = boxes_at((0, 0, 0.8))
    left = still_right(reach_m(own.size_m), np.array([own_s, peer_s]))
    mine, silent = np.minimum(left / still_right(reach_m(own.size_m), np.array(min(own_s, peer_s))), 1.0)
    peer = SourceBoxes(boxes_at((40, 0, 0.5)), weight, (0.0, 0.0, 0.0), age_s=peer_s)
    (found,) = joined_many([EgoSources((0.0, 0.0, 0.0), own, False, [peer], own_s)], "average")
    here = found.score[np.abs(found.xy_m[:, 0]) < 1]
    assert here == pytest.approx([0.8 * mine / max(mine + weight * silent, 1.0)], rel=1e-4)
    elsewhere = found.score[np.abs(found.xy_m[:, 0] - 40) < 1]
    assert elsewhere == pytest.approx([0.5 * weight * silent / max(mine + weight * silent, 1.0)], rel=1e-4)


@pytest.mark.parametrize("made", [surrogate, torch_detector])
def test_a_late_map_is_fused_as_one_of_so_much_less_weight(made: Any) -> None:
    """Beside the ego's own look, which is younger; without one, beside the youngest map."""
    ego, a, b = cross(10.0, 20.0, 0.3, t_s=5.0)[:3]
    old = a._replace(t_s=4.7)

    def found(who: Capture, *shares: Share) -> Boxes:
        return made().detect([(who, shares)])[0]

    late = found(ego, Share(old, "features", 0.3, None, 0.9, (), 0.395))
    assert same(late, found(ego, Share(old, "features", 0.3, None, 0.9 * map_weight(0.395, 0.095))))
    assert not same(late, found(ego, Share(old, "features", 0.3, None, 0.9)))
    blind = ego._replace(looked=False)
    young = Share(b, "features", 0.3, None, 0.9, (), 0.095)
    late = found(blind, young, Share(old, "features", 0.3, None, 0.9, (), 0.395))
    less = Share(old, "features", 0.3, None, 0.9 * map_weight(0.395, 0.095))
    assert same(late, found(blind, young._replace(age_s=0.0), less))


@pytest.mark.parametrize("made", [surrogate, torch_detector])
def test_without_an_own_look_maps_count_beside_the_heaviest_of_them(made: Any) -> None:
    """All weights halved are the same weights: there is no own map against which they would be less."""
    blind, *peers = cross(10.0, 20.0, 0.3)[:4]
    blind = blind._replace(looked=False)
    whole, half = (
        made().detect([(blind, [Share(c, "raw", 1.0, None, part * w) for c, w in zip(peers, (0.6, 1.0, 0.3), strict=True)])])[0]
        for part in (1.0, 0.5)
    )  # fmt: skip
    assert len(whole) == len(half) > 3
    np.testing.assert_allclose(half.xy_m, whole.xy_m, atol=1e-2)
    np.testing.assert_allclose(half.score, whole.score, atol=1e-3)
    other = made().detect([(blind, [Share(c, "raw", 1.0, None, 1.0) for c in peers])])[0]
    assert not (len(other) == len(whole) and np.allclose(other.score, whole.score, atol=1e-3))


# --- cells -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rho", "missing"), [(0.02, ()), (0.02, (0, 3)), (0.001, (1,)), (1.0, ()), (1.0, (5,))])
@pytest.mark.parametrize("roi", [None, Disc(20.0, 10.0, 25.0), Disc(0.0, 0.0, 8.0)])
def test_of_a_region_the_best_cells_arrive_less_those_that_went_missing(
    rho: float, missing: tuple[int, ...], roi: Disc | None
) -> None:
    """Against a plain list: cells in the region, best first, cut to the budget, some of them lost."""
    rank = np.random.default_rng(1).permutation(4096).reshape(64, 64).astype(float)
    pose = (3.0, -2.0, 0.4)
    allowed = budget.roi_mask(roi, *pose).ravel()
    inside = [int(k) for k in np.argsort(-rank.ravel()) if allowed[k]]
    sent = inside[: math.floor(rho * 4096 + 1e-9)]
    arrived = {cell for place, cell in enumerate(sent) if place not in missing}
    got = budget.select(rank, rho, roi, *pose, missing)
    assert set(np.flatnonzero(got.ravel()).tolist()) == arrived
    assert budget.cells_sent(rho, roi, *pose) == len(sent)
    assert budget.must_choose(rho, roi, *pose) == (math.floor(rho * 4096 + 1e-9) < len(inside))


def test_an_index_is_a_list_or_a_bitmap_whichever_is_smaller() -> None:
    for cells in (1, 2, 81, 340, 341, 342, 1000, 4095, 4096):
        wanted = 0 if cells == 4096 else min(512, math.ceil(cells * 12 / 8))
        assert budget.index_bytes(cells) == wanted
        assert budget.content_bytes("features", cells=cells) == cells * 160 + wanted


@pytest.mark.parametrize(("boxes", "kind"), list(product((3, 12, 13, 40), ("tracks", "detections"))))
def test_only_boxes_that_were_cut_leave_places_open(boxes: int, kind: str) -> None:
    """More than twelve as tracks: the best come, and a missing one says nothing. Detections are never cut."""
    alone = boxes_at(*[(6.0 * k, 0.0, 0.9 - 0.01 * k) for k in range(boxes)])
    share = Share(capture(), kind, 0.0, None, 0.5)
    source = source_of(share, alone)
    assert source.truncated == (kind == "tracks" and boxes > budget.MAX_TRACKS)
    assert len(source.boxes) == (min(boxes, 12) if kind == "tracks" else boxes)
    assert source.boxes.score[0] == alone.score[0]
    near = source_of(share._replace(roi=Disc(0.0, 0.0, 20.0)), alone)
    assert not near.truncated  # few are inside, however many there are


@pytest.mark.parametrize(("mine", "theirs"), [(0.0, 0.0), (0.3, -1.1), (2.5, 0.8)])
def test_a_region_is_a_place_in_the_world_whoever_is_turned_how(mine: float, theirs: float) -> None:
    """Which of the cars that both have are aimed at: those in the disc."""
    disc = Disc(25.0, -10.0, 30.0)
    ego, peer = capture(10.0, 20.0, yaw=mine), capture(30.0, 5.0, yaw=theirs, drone=1)
    fleet, eyes = CaptureColumns.of([ego, peer]), Eyes(town())
    looks = eyes.look(fleet)
    jobs = [(ego, [Share(peer, "features", 1.0, disc, 1.0)])]
    exchange = FeatureShares.of(jobs, {ego: 0, peer: 1})
    pairs = pair(exchange, looks, fleet)
    both = pairs.peer[:, 0] >= 0
    inside = np.hypot(*(looks.world_m[pairs.look] - disc[:2]).T) <= disc.radius_m
    assert 3 < np.count_nonzero(inside & both) < np.count_nonzero(both)
    np.testing.assert_array_equal(pairs.aimed[both, 0], inside[both])
    assert np.abs(pairs.shift_m[both]).max() < 0.2  # both know where they are
    # laid elsewhere, as without motion compensation: the map is shifted, and holds the cells that its sender chose
    laid = FeatureShares.of(jobs, {ego: 0, peer: 1}, [[(30.0 + 6.0, 5.0 - 8.0, theirs + 0.2)]])
    elsewhere = pair(laid, looks, fleet)
    np.testing.assert_array_equal(elsewhere.aimed, pairs.aimed)
    assert np.hypot(*elsewhere.shift_m[both, 0].T).mean() > 3.0
    assert laid.allowed == pytest.approx(exchange.allowed)


def test_cells_that_went_missing_are_counted_among_those_that_were_allowed() -> None:
    """A rank is a share of the allowed cells, however few of them were sent."""
    one = np.ones((1, 1))
    shares = FeatureShares(
        np.array([0]), np.array([[0]]), 100 * one, 4096 * one, np.full((1, 1, 3), np.inf), one, np.zeros((1, 1, 3)),
        {(0, 0): np.array([40])},
    )  # fmt: skip
    sent = np.array([[True], [True], [True]])
    shares.drop_missing(sent, np.array([[40.5], [41.5], [1.5]], np.float32) / 4096, np.zeros(3, np.intp))
    assert sent.ravel().tolist() == [False, True, True]


def test_a_drone_without_a_look_takes_the_heaviest_map_for_its_own_whatever_came_first() -> None:
    blind, a, b = cross(10.0, 20.0, 0.3)[:3]
    blind = blind._replace(looked=False)
    light, heavy = Share(a, "raw", 1.0, None, 0.3), Share(b, "raw", 1.0, None, 1.0)
    detector = torch_detector()
    one, other = (detector.detect([(blind, shares)])[0] for shares in ([light, heavy], [heavy, light]))
    assert len(one) == len(other) > 3
    np.testing.assert_allclose(one.score, other.score, atol=1e-3)
    np.testing.assert_allclose(one.xy_m, other.xy_m, atol=2e-2)


@pytest.mark.parametrize("name", ["disconet", "fine"])
def test_the_surrogate_announces_as_many_boxes_as_the_network_finds(name: str) -> None:
    """False positives among them; of those of the fine network, which are more than 200, the best 200."""
    looks = [capture(10.0 * k, 5.0, drone=k, t_s=2.0 + 0.5 * k) for k in range(4)]
    weights = NETWORKS / f"{name}.safetensors"
    torch, fitted = TorchDetector(town(), Perception(), 1, weights), SurrogateDetector(town(), Perception(), 3, weights)
    found = np.mean([torch.count_boxes(c, None) for c in looks])
    assert np.mean([fitted.count_boxes(c, None) for c in looks]) == pytest.approx(found, rel=0.15)


def test_random_peers_of_an_evaluation_are_drawn_for_each_ego_and_frame() -> None:
    condition = Sharing(0.1, "random-2")
    drawn = {
        ego: [
            tuple(sorted((p - ego) % 5 for p in choose(condition, ego, np.full(5, 0.5), (frame,))))
            for frame in range(60)
        ]
        for ego in range(5)
    }
    for ego, peers in drawn.items():
        assert len(set(peers)) == 6  # every pair of four
        for other in set(drawn) - {ego}:
            assert sum(x == y for x, y in zip(peers, drawn[other], strict=True)) < 30


# --- scores ----------------------------------------------------------------------------------------------------------------


def test_boxes_of_one_score_make_one_step_of_the_curve() -> None:
    """Whatever their order is: hit and miss at one score have a precision of one half together."""
    for hit in ([True, False], [False, True]):
        frame = Matched(np.array([0.5, 0.5]), np.array(hit), 1)
        assert average_precision([frame]) == pytest.approx(0.5)
    first = Matched(np.array([0.9, 0.5]), np.array([True, False]), 2)
    second = Matched(np.array([0.5]), np.array([True]), 0)
    assert average_precision([first, second]) == average_precision([second, first])
    assert average_precision([first, second]) == pytest.approx(0.5 * 1.0 + 0.5 * 2 / 3)


# --- thermal cameras -----------------------------------------------------------------------------------------------------------

PEOPLE_M = np.array([[x, y] for x in (30.0, 40.0, 50.0) for y in (30.0, 40.0, 50.0)])
BARE = SceneModel(Scene(building_density=0.0, tree_density=0.0), None, (0.0, 0.0, 80.0, 80.0))


def sightings(
    frames: int, drone: int = 0, off: tuple[float, float] = (0.0, 0.0), key: tuple[int, int] = (1, 0), **camera: Any
) -> list[list[Any]]:
    at = capture(40.0, 40.0, 95.0, drone=drone, est=(40.0 + off[0], 40.0 + off[1], 95.0, 0.0))
    thermal = Thermal(**{"near_probability": 1.0, "half_range_m": 97.0, "range_width_m": 4.0, **camera})
    return [look(thermal, PEOPLE_M, BARE.height_field, at, k, 0.1, key) for k in range(frames)]


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


# --- the surrogate's draws -----------------------------------------------------------------------------------------------------------


def drawn(drone: int = 0, t_s: float = 5.0, seed: int = 3, replication: int = 0) -> Drawn:
    """The draws of one look at each of many cars, none of which are the same for all drones."""
    eyes = Eyes(town())
    source = DrawSource(seed, replication, 7, eyes.traffic.identity, np.zeros(4, np.float32))
    at = [capture(0.0, 0.0, drone=drone, t_s=t_s)]
    return source.of(at, eyes.look(CaptureColumns.of(at)))


def columns(d: Drawn, label: str) -> dict[str, np.ndarray]:
    """All numbers of looks as uniform ones."""
    return {
        f"look {label}": d.look, f"rank {label}": ndtr(d.rank), f"find 0 {label}": d.find[:, 0],
        f"find 1 {label}": d.find[:, 1], f"residual {label}": d.residual,
    }  # fmt: skip


def test_no_two_of_the_surrogate_s_draws_share_a_number() -> None:
    """Of every purpose, drone, moment, seed and replication, car by car."""
    each: dict[str, np.ndarray] = {}
    for label, how in {
        "": {}, "drone": {"drone": 1}, "moment": {"t_s": 5.1}, "seed": {"seed": 4}, "replication": {"replication": 1},
    }.items():  # fmt: skip
        each |= columns(drawn(**how), label)
    fixed = drawn().offset_draw
    each["offset"] = fixed[:, 0]
    n = min(map(len, each.values()))
    assert n > 60
    values = {name: v[:n] for name, v in each.items()}
    for name, v in values.items():
        assert 0.3 < v.mean() < 0.7, name
    correlation = np.corrcoef(list(values.values()))
    np.fill_diagonal(correlation, 0.0)
    worst = np.unravel_index(np.abs(correlation).argmax(), correlation.shape)
    assert np.abs(correlation).max() < 0.6, [list(values)[k] for k in worst]
    alike = [len(np.intersect1d(a, b)) for a, b in product(values.values(), repeat=2) if a is not b]
    assert max(alike) == 0


def test_false_positives_are_drawn_for_each_drone_and_moment() -> None:
    a, b = drawn(), drawn(drone=1)
    for first, second in ((a, b), (a, drawn(t_s=5.1)), (a, drawn(seed=4)), (a, drawn(replication=1))):
        for name in ("alarm_at", "alarm_which"):
            one, other = getattr(first, name).ravel(), getattr(second, name).ravel()
            assert len(np.intersect1d(one, other)) == 0
        assert first.moment[0] != second.moment[0]
    bands = a.alarm_which[0]
    assert len(np.unique(bands)) == bands.size
    assert abs(np.corrcoef(a.alarm_at[0, :, 0], a.alarm_which[0, :, 0])[0, 1]) < 0.9


def test_each_drone_has_a_shared_false_positive_by_a_draw_of_its_own() -> None:
    """Drones in one place at one moment see the same things, and not all the same of them, nor at the next look."""
    detector = SurrogateDetector(
        SceneModel(Scene(parked_density=0, moving_cars_per_km=0), None, BOUNDS), Perception(), 3
    )
    detector.parameters = dataclasses.replace(
        detector.parameters, shared_false_positives=np.array([1.0, 0.5, 0.0, 0.0], np.float32)
    )

    def things(drone: int, t_s: float) -> set[tuple[int, int]]:
        (boxes,) = detector.detect([(capture(0.0, 0.0, drone=drone, t_s=t_s), [])])
        return {tuple(np.round(xy).astype(int).tolist()) for xy in boxes.xy_m}

    looks = {(drone, k): things(drone, 5.0 + 0.5 * k) for drone in range(3) for k in range(12)}
    every = set().union(*looks.values())
    assert len(every) >= 4
    known = sorted(every)
    table = np.array([[thing in looks[drone, k] for thing in known] for drone in range(3) for k in range(12)], float)
    assert 0.1 < table.mean() < 0.9
    by_drone = table.reshape(3, -1)
    assert not any(np.array_equal(by_drone[i], by_drone[j]) for i, j in ((0, 1), (0, 2), (1, 2)))
    per_look = table.reshape(3, 12, -1)
    assert (per_look[:, 1:] != per_look[:, :-1]).any(axis=(1, 2)).all()


def test_which_shared_false_positive_it_is_does_not_depend_on_its_band(monkeypatch: pytest.MonkeyPatch) -> None:
    """The draw that picks one of the network's is another than the one that picks the band."""
    detector, asked = SurrogateDetector(town(), Perception(), 3), []
    parameters = detector.parameters
    detector.parameters = dataclasses.replace(
        parameters, shared_false_positives=np.array([1.0, 0.9, 0.0, 0.0], np.float32)
    )
    plain = SurrogateDetector._pooled

    def pooled(self: Any, yaw_rad: Any, band: np.ndarray, draws: np.ndarray) -> Any:
        asked.append(np.stack([band, draws]))
        return plain(self, yaw_rad, band, draws)

    monkeypatch.setattr(SurrogateDetector, "_pooled", pooled)
    for k in range(30):
        detector.detect([(capture(0.0, 0.0, drone=k, t_s=0.5 * k), [])])
    band, draws = np.concatenate(asked, axis=1)
    assert len(band) > 100
    assert len(np.unique(band)) > 3
    assert len(np.unique(draws)) == len(draws)
    assert abs(np.corrcoef(band, draws)[0, 1]) < 0.25


# --- camera noise -----------------------------------------------------------------------------------------------------------------------


def test_camera_noise_is_of_each_drone_moment_seed_and_replication() -> None:
    """In the network's pictures as in the renderer's own."""
    here = capture(0.0, 0.0, t_s=5.0)

    def grey(renderer: Renderer, c: Capture) -> np.ndarray:
        return renderer.render([c])[0].astype(int)

    usual = grey(Renderer(town(), 1), here)
    noise = {
        "drone": grey(Renderer(town(), 1), here._replace(drone=1)) - usual,
        "seed": grey(Renderer(town(), 2), here) - usual,
        "replication": grey(Renderer(town(), 1, 1), here) - usual,
    }
    for name, off in noise.items():
        assert (off != 0).mean() > 0.8, name
        assert np.abs(off).max() <= 40
    assert np.array_equal(grey(Renderer(town(), 1), here), usual)
    pair = [noise[a].ravel() for a in ("drone", "seed")]
    assert not np.array_equal(*pair)
    torch_views = [
        TorchDetector(town(), Perception(), seed, replication=replication).camera_views(here)
        for seed, replication in ((1, 0), (2, 0), (1, 1))
    ]
    np.testing.assert_array_equal(torch_views[0], usual)
    assert (torch_views[1] != torch_views[0]).mean() > 0.8
    assert (torch_views[2] != torch_views[0]).mean() > 0.8
    assert (torch_views[2] != torch_views[1]).mean() > 0.8


def test_the_surrogate_draws_by_seed_and_replication() -> None:
    ego = capture(0.0, 0.0)
    found = [
        SurrogateDetector(town(), Perception(), seed, replication=replication).detect([(ego, [])])[0]
        for seed, replication in ((1, 0), (2, 0), (1, 1), (1, 0))
    ]
    assert same(found[0], found[3])
    assert not any(same(found[0], other) for other in found[1:3])


def test_the_detector_that_a_scenario_names_draws_by_seed_and_replication() -> None:
    def found(seed: int, replication: int):
        detector = make_detector(town(), Perception(detector="surrogate"), seed, replication)
        assert detector is not None
        return detector.detect([(c, ()) for c in cross(0.0, 0.0, 0.3)])

    first = found(3, 0)
    assert all(map(same, found(3, 0), first))
    assert not all(map(same, found(3, 1), first))
    assert not all(map(same, found(4, 0), first))


OWN = """
class Mine:
    def __init__(self, scene, config, seed, replication):
        self.made = seed, replication

    def count_boxes(self, capture, roi):
        return capture.drone if roi is None else round(roi.radius_m)

    def detect(self, jobs): ...
    def truth(self, t_s, ego): ...
    def camera_views(self, capture): ...
"""


def test_a_detector_of_one_s_own_is_made_for_the_replication_and_counts_in_the_region_that_is_asked_for(
    tmp_path: Path,
) -> None:
    path = tmp_path / "mine.py"
    path.write_text(OWN)
    detector = make_detector(town(), Perception(detector=f"{path}:Mine"), 3, 2)
    assert detector is not None
    assert detector.made == (3, 2)
    assert detector.count_boxes(capture(drone=4), None) == 4
    assert detector.count_boxes(capture(drone=4), Disc(1.0, 2.0, 9.0)) == 9
