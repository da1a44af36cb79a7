"""The surrogate as a detector: limits, draws that do not depend on what was sent, one batch as many."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from perception_examples import EMPTY, capture, cross

from sortie.perception.detectors import DetectsMany
from sortie.perception.geometry import in_square
from sortie.perception.ground_truth import ground_truth
from sortie.perception.metrics.ap import match
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.surrogate.draws import DrawSource
from sortie.perception.surrogate.exchange import (
    ALARM_COVARIATES,
    FUSED_COVARIATES,
    FeatureShares,
    alarm_covariates,
    covariates,
    pair,
)
from sortie.perception.surrogate.features import CaptureColumns, Eyes
from sortie.perception.surrogate.hashing import uniform
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Perception, Scene, Target

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


def same(a: list[Boxes], b: list[Boxes]) -> None:
    assert len(a) == len(b)
    for one, other in zip(a, b, strict=True):
        for name in Boxes.__slots__:
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_it_has_the_detectors_interface_and_says_which_fit_it_is_of(detector: SurrogateDetector) -> None:
    assert isinstance(detector, DetectsMany)
    assert detector.calibration.startswith("disconet-")


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


def test_another_seed_or_replication_gives_other_draws(scene: SceneModel, detector: SurrogateDetector) -> None:
    job = moments(0.1)[0]
    mine = detector.detect(job)[0].score
    for other in (
        SurrogateDetector(scene, Perception(), seed=4),
        SurrogateDetector(scene, Perception(), seed=3, replication=1),
    ):
        theirs = other.detect(job)[0].score
        assert len(mine) != len(theirs) or not np.array_equal(mine, theirs)


def test_nothing_sent_is_alone(detector: SurrogateDetector, scene: SceneModel) -> None:
    alone = [boxes for m in moments(1.0) for boxes in detector.detect([(e, ()) for e, _ in m])]
    same([b for m in moments(1.0, weight=0.0) for b in detector.detect(m)], alone)
    mute = SurrogateDetector(scene, Perception(fusion="none"), seed=3)
    same([b for m in moments(1.0) for b in mute.detect(m)], alone)


def test_draws_do_not_depend_on_what_was_sent_nor_on_who_else_flies(
    detector: SurrogateDetector, scene: SceneModel
) -> None:
    eyes, draws = Eyes(scene), DrawSource(3, 0, 7, Eyes(scene).traffic.identity, detector.parameters.alike)
    fleet = cross(10.0, 20.0, 0.3)
    every, two = eyes.look(CaptureColumns.of(fleet)), eyes.look(CaptureColumns.of(fleet[1:3]))
    a, b = draws.of(fleet, every), draws.of(fleet[1:3], two)
    mine = np.isin(every.capture, (1, 2))
    for name in ("look", "rank", "find", "residual"):
        np.testing.assert_array_equal(getattr(a, name)[mine], getattr(b, name))
    np.testing.assert_array_equal(a.alarm_at[1:3], b.alarm_at)


@pytest.mark.parametrize("part", [0.0, 0.3, 1.0])
def test_that_share_of_the_cars_has_one_draw_for_all_drones(scene: SceneModel, part: float) -> None:
    eyes = Eyes(scene)
    draws = DrawSource(3, 0, 7, eyes.traffic.identity, np.full(4, part, np.float32))
    fleet = [c for t in TIMES for c in cross(10.0, 20.0, 0.3, t_s=float(t))]
    looks = eyes.look(CaptureColumns.of(fleet))
    drawn = draws.of(fleet, looks)
    cars = [looks.car == c for c in np.unique(looks.car) if (looks.car == c).sum() > 5]
    for values in (drawn.look, drawn.find[:, 0], drawn.residual):
        alike = np.mean([np.ptp(values[of]) == 0.0 for of in cars])
        assert alike == pytest.approx(part, abs=0.1)
        assert values.mean() == pytest.approx(0.5, abs=0.1)


def test_which_cars_are_hard_is_the_towns_and_the_rest_the_sorties(scene: SceneModel) -> None:
    eyes, fleet = Eyes(scene), cross(10.0, 20.0, 0.3)
    looks, half = eyes.look(CaptureColumns.of(fleet)), np.full(4, 0.5, np.float32)
    a, b, other = (
        DrawSource(*key, eyes.traffic.identity, half).of(fleet, looks) for key in ((3, 0, 7), (4, 1, 7), (3, 0, 8))
    )
    own = a.look == b.look
    assert own.mean() == pytest.approx(0.5, abs=0.15)
    np.testing.assert_array_equal(a.offset_draw, b.offset_draw)
    assert (a.look == other.look).mean() < 0.05


@pytest.mark.parametrize(
    "larger", [(-53.0, -51.0, 50.0, 50.0), (-50.0, -50.0, 90.0, 130.0), (-900.0, -50.0, 900.0, 50.0)]
)
def test_a_car_keeps_its_draws_wherever_the_scene_ends(larger: tuple[float, float, float, float]) -> None:
    """Parked cars, moving ones and the target, at two moments. The longest scene has two patterns of moving cars."""
    config = Scene(moving_cars_per_km=20)
    fleet = [*cross(10.0, 20.0, 0.3), *cross(10.0, 20.0, 0.3, t_s=40.0)]
    kinds, sorties = [], []
    for bounds, key in ((BOUNDS, (3, 0)), (larger, (3, 0)), (larger, (4, 1))):
        eyes = Eyes(SceneModel(config, Target(waypoints_m=((15.0, 20.0),)), bounds))
        looks = eyes.look(CaptureColumns.of(fleet))
        drawn = DrawSource(*key, 7, eyes.traffic.identity, np.full(4, 0.5, np.float32)).of(fleet, looks)
        order = np.lexsort([*looks.world_m.T.round(6), looks.capture])
        kinds.append(eyes.traffic.identity[looks.car[order], 0].tolist())
        sorties.append([v[order] for v in (drawn.look, drawn.rank, drawn.find, drawn.residual, drawn.offset_draw)])
    assert kinds[0] == kinds[1] == kinds[2]
    assert set(kinds[0]) == {0, 1, 2, 3}
    small, same_sortie, other_sortie = sorties
    for mine, theirs in zip(small, same_sortie, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    np.testing.assert_array_equal(small[-1], other_sortie[-1])
    assert (small[0] == other_sortie[0]).mean() == pytest.approx(0.5, abs=0.15)


def test_no_two_cars_of_a_pattern_are_one() -> None:
    traffic = Eyes(SceneModel(Scene(moving_cars_per_km=30, parked_density=0.9), None, (-400, -400, 400, 400))).traffic
    assert len(np.unique(traffic.identity, axis=0)) == traffic.count > 1000


def test_uniform_draws_are_uniform_and_unlike_across_purposes() -> None:
    words = np.arange(100_000, dtype=np.uint64)
    u, v = uniform(words, 0), uniform(words, 1)
    for one in (u, v):
        assert abs(one.mean() - 0.5) < 4 / np.sqrt(12 * len(u))
        assert abs(one.var() - 1 / 12) < 1e-3
    assert abs(np.corrcoef(u, v)[0, 1]) < 0.015
    assert abs(np.corrcoef(u[1:], u[:-1])[0, 1]) < 0.015


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


def test_a_larger_budget_sends_every_cell_that_a_smaller_one_sent(
    detector: SurrogateDetector, scene: SceneModel
) -> None:
    fleet = cross(10.0, 20.0, 0.3)
    few = [cells_of(fleet, rho) for rho in (0.01, 0.1, 1.0)]
    assert (np.diff(np.stack(few), axis=0) > 0).all()


def cells_of(fleet: list[Capture], rho: float) -> np.ndarray:
    jobs = shared(fleet, rho)
    return FeatureShares.of(jobs, {c: i for i, c in enumerate(fleet)}).cells


def test_cells_of_a_disc_are_its_area_and_counted_where_it_leaves_the_map() -> None:
    fleet = cross(0.0, 0.0, 0.0)
    column = {c: i for i, c in enumerate(fleet)}
    inside = [(fleet[0], [Share(fleet[1], "features", 1.0, (20.0, 0.0, 32.0), 1.0)])]
    rim = [(fleet[0], [Share(fleet[1], "features", 1.0, (20.0 + 102.4, 0.0, 32.0), 1.0)])]
    assert FeatureShares.of(inside, column).allowed[0, 0] == pytest.approx(np.pi * 10**2)
    assert FeatureShares.of(rim, column).allowed[0, 0] == pytest.approx(np.pi * 10**2 / 2, rel=0.05)


def test_an_old_share_of_a_moving_car_lies_behind_it() -> None:
    scene = SceneModel(EMPTY, Target(waypoints_m=((-40.0, 0.0), (40.0, 0.0)), speed_mps=8.0), BOUNDS)
    ego, late = capture(0.0, 0.0, t_s=5.0), capture(5.0, 5.0, drone=1, t_s=4.6)
    jobs = [(ego, [Share(late, "features", 1.0, None, 1.0)])]
    fleet = CaptureColumns.of([ego, late])
    pairs = pair(FeatureShares.of(jobs, {ego: 0, late: 1}), Eyes(scene).look(fleet), fleet)
    np.testing.assert_allclose(pairs.shift_m[0, 0], (-8.0 * 0.4, 0.0), atol=1e-4)


def test_heading_errors_shift_what_a_peer_sends_by_its_range() -> None:
    scene = SceneModel(EMPTY, Target(waypoints_m=((60.0, 0.0),)), BOUNDS)
    ego, peer = capture(0.0, 0.0), capture(0.0, 0.0, drone=1, est=(0.0, 0.0, 60.0, 0.01))
    fleet = CaptureColumns.of([ego, peer])
    jobs = [(ego, [Share(peer, "features", 1.0, None, 1.0)])]
    pairs = pair(FeatureShares.of(jobs, {ego: 0, peer: 1}), Eyes(scene).look(fleet), fleet)
    np.testing.assert_allclose(pairs.shift_m[0, 0], (60 * (np.cos(0.01) - 1), 60 * np.sin(0.01)), atol=1e-4)


def test_boxes_stand_by_the_estimated_pose(scene: SceneModel) -> None:
    """An ego that believes itself 3 m east puts every box 3 m east."""
    plain, moved = capture(10.0, 20.0), capture(10.0, 20.0, est=(13.0, 20.0, 60.0, 0.0))
    detector = SurrogateDetector(scene, Perception(), seed=3)
    a, b = detector.detect([(plain, ())])[0], detector.detect([(moved, ())])[0]
    np.testing.assert_allclose(b.xy_m - a.xy_m, np.tile((3.0, 0.0), (len(a), 1)), atol=1e-3)


def test_truth_is_the_detectors(scene: SceneModel, detector: SurrogateDetector) -> None:
    ego = capture(10.0, 20.0, yaw=0.4, pitch=0.05, t_s=7.3)
    mine, theirs = detector.truth(7.4, ego), ground_truth(scene.cars_at(7.4).table(), (10.0, 20.0, ego.true_yaw_rad))
    assert len(mine) == len(theirs) > 10
    order = [np.lexsort(b.xy_m.T) for b in (mine, theirs)]
    np.testing.assert_allclose(mine.xy_m[order[0]], theirs.xy_m[order[1]], atol=1e-3)
    np.testing.assert_allclose(mine.size_m[order[0]], theirs.size_m[order[1]], atol=1e-5)


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


def test_counts_grow_with_the_disc_and_shrink_with_the_threshold(
    scene: SceneModel, detector: SurrogateDetector
) -> None:
    ego = capture(10.0, 20.0)
    counts = [detector.count_boxes(ego, disc) for disc in ((10.0, 20.0, 16.0), (10.0, 20.0, 64.0), None)]
    assert counts == sorted(counts)
    assert counts[0] < counts[2]
    assert SurrogateDetector(scene, Perception(score_threshold=0.7), seed=3).count_boxes(ego, None) < counts[2]


def test_a_disc_beyond_the_square_holds_no_boxes_to_send(detector: SurrogateDetector) -> None:
    """A drone tells nothing of what it does not see: half of a disc on the square's edge, nothing of one beyond it."""
    ego, radius = capture(10.0, 20.0, yaw=0.3), 30.0
    ahead = np.array([np.cos(0.3), np.sin(0.3)])
    inside, edge, beyond = (
        detector.count_boxes(ego, (*(ego.position_m[:2] + far * ahead), radius)) for far in (70.0, 102.4, 140.0)
    )
    assert 0 < edge < inside
    assert beyond == 0
    whole = detector.count_boxes(ego, (10.0, 20.0, 500.0))
    assert whole == pytest.approx(detector.count_boxes(ego, None), rel=0.15)  # a disc as large as the square


def test_it_renders_nothing(detector: SurrogateDetector) -> None:
    with pytest.raises(
        ValueError, match=r"^the surrogate renders nothing: fly with perception.detector = torch to see camera views$"
    ):
        detector.camera_views(capture())


def test_another_fusion_is_refused(scene: SceneModel, detector: SurrogateDetector) -> None:
    with pytest.raises(
        ValueError, match=r"calibrated for fusion 'disconet', perception.fusion is 'fcooper', must be that or 'none'$"
    ):
        SurrogateDetector(scene, Perception(fusion="fcooper"), seed=3)
    card = {**detector.parameters.card, "fusion": "fcooper"}
    SurrogateDetector.of(scene, Perception(fusion="fcooper"), dataclasses.replace(detector.parameters, card=card), 3)


@pytest.mark.parametrize("part", [0.0, 1.0])
@pytest.mark.parametrize(("heading", "length_m"), [(0.0, 9.0), (np.pi / 2, 9.0), (0.4, 3.0)])
def test_false_alarms_are_those_of_drones_along_a_street_or_askew(
    detector: SurrogateDetector, heading: float, length_m: float, part: float
) -> None:
    """By their lengths, planted; a drone's own and those of things in the town alike."""
    pool = detector.parameters.alarm_pool.copy()
    pool[0, ..., 2], pool[1, ..., 2] = 3.0, 9.0
    shared_false_positives = np.array([part, 0.5, 0.5, 0.1], np.float32)
    planted = dataclasses.replace(detector.parameters, alarm_pool=pool, shared_false_positives=shared_false_positives)
    some = SurrogateDetector.of(SceneModel(EMPTY, None, BOUNDS), Perception(), planted, 0)
    fleet = cross(10.0, 20.0, heading)
    lengths = np.concatenate([b.size_m[:, 0] for b in some.detect([(c, ()) for c in fleet])])
    assert len(lengths) > 5
    assert set(lengths.tolist()) == {length_m}


def test_what_false_alarms_hang_on_is_what_was_asked_for_and_how_far_cars_have_driven_since() -> None:
    """An ego with a whole map of now, a half one 0.2 s old and a disc 0.4 s old; and one with nothing, over one car that drives."""
    scene = SceneModel(EMPTY, Target(waypoints_m=((-40.0, 0.0), (40.0, 0.0)), speed_mps=8.0), BOUNDS)
    ego = capture(0.0, 0.0, t_s=5.0)
    peers = [capture(5.0, 5.0 * k, drone=k + 1, t_s=5.0 - 0.2 * k) for k in range(3)]
    given: list[tuple[float, tuple[float, float, float] | None]] = [(1.0, None), (0.5, None), (1.0, (0.0, 0.0, 32.0))]
    jobs = [(ego, [Share(p, "features", *g, 1.0) for p, g in zip(peers, given, strict=True)]), (peers[0], [])]
    captures = [ego, *peers]
    fleet = CaptureColumns.of(captures)
    exchange = FeatureShares.of(jobs, {c: i for i, c in enumerate(captures)})
    x = alarm_covariates(exchange, Eyes(scene).look(fleet), fleet, np.zeros(2, bool), scene.config)
    by_name = dict(zip(ALARM_COVARIATES, x.T.tolist(), strict=True))
    disc = np.pi * 10**2 / 4096
    assert by_name["sharing"] == [0.75, 0.0]
    assert by_name["aimed"] == pytest.approx([(1 + 1 + disc) / 3, 1.0])
    assert by_name["received"] == pytest.approx([(1 + 0.5 + disc) / 4, 0.0], abs=1e-4)
    assert by_name["moving"] == pytest.approx([0.1, 0.1])
    assert by_name["late"] == pytest.approx([1.0, 0.0])
    assert by_name["gone"] == pytest.approx([0.1, 0.0])


@pytest.mark.parametrize(
    ("weights", "many"), [((0.5, 1.0, 0.5, 0.5), 3.0), ((1.0, 1.0, 0.0, 1.0), 2.0), ((1.0, 1.0, 0.5, 0.0), 1.8)]
)
def test_senders_are_counted_by_head_and_by_weight(weights: tuple[float, ...], many: float) -> None:
    """Four, of which one's cell did not come; unequal weights count as fewer, one of nothing not at all."""
    scene = SceneModel(EMPTY, Target(waypoints_m=((10.0, 0.0),)), BOUNDS)
    captures = [capture(0.0, 0.0), *(capture(5.0, 5.0 * k, drone=k + 1) for k in range(4))]
    fleet, shares = (
        CaptureColumns.of(captures),
        [Share(p, "features", 1.0, None, w) for p, w in zip(captures[1:], weights, strict=True)],
    )
    exchange = FeatureShares.of(
        [(captures[0], [s for s in shares if s.weight > 0])], {c: i for i, c in enumerate(captures)}
    )
    looks = Eyes(scene).look(fleet)
    pairs = pair(exchange, looks, fleet)
    sent = np.array([[k != 1 for k, w in enumerate(weights) if w > 0]])
    sure = np.zeros(len(looks.car), np.float32)
    x = covariates(pairs, exchange, looks, sure, sent, np.full(sent.shape, 0.1, np.float32), np.zeros(1, bool))
    by_name = dict(zip(FUSED_COVARIATES, x[0].tolist(), strict=True))
    assert by_name["many"] == pytest.approx(many)
    assert by_name["senders"] == pytest.approx(sum(weights) - weights[1])


@pytest.mark.parametrize("age_s", [0.5, 2.0, 60.0])
def test_older_maps_than_any_that_was_fitted_give_no_more_false_alarms_than_the_oldest_that_was(
    detector: SurrogateDetector, scene: SceneModel, age_s: float
) -> None:
    def expected(age_s: float) -> np.ndarray:
        ego = capture(10.0, 20.0, t_s=70.0)
        peers = [capture(10.0, 5.0 * k, drone=k + 1, t_s=70.0 - age_s) for k in range(4)]
        jobs = [(ego, [Share(p, "features", 0.25, None, 1.0) for p in peers])]
        fleet = CaptureColumns.of([ego, *peers])
        exchange = FeatureShares.of(jobs, {c: i for i, c in enumerate([ego, *peers])})
        x = alarm_covariates(exchange, Eyes(scene).look(fleet), fleet, np.zeros(1, bool), scene.config)
        return detector.parameters.alarm_rates(x)

    np.testing.assert_allclose(expected(age_s), expected(0.4), rtol=1e-3)
    assert expected(0.4).sum() < 100


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
