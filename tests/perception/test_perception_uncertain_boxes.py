"""Boxes with uncertainty: fitted covariances, how receivers join them, and covariance intersection itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from perception_examples import boxes_at, cross
from scipy.optimize import minimize

from sortie.perception.errors import InputError
from sortie.perception.intersection import Intersection, intersect, inverse
from sortie.perception.joining import EgoSources, Rule, SourceBoxes, joined_many, source_of
from sortie.perception.lateness import MOVING, SIGMA0_M, SPEED_MPS
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.types import Boxes, Share
from sortie.perception.uncertainty import BoxErrors, errors_text, load_errors, terms
from sortie.scenarios.schema import Perception, Scene
from sortie.scenarios.shipped import ERRORS, beside

HERE = (0.0, 0.0, 0.0)
FLAT = BoxErrors((np.log(0.6), 0, 0, 0, 0), (np.log(0.3), 0, 0, 0, 0), common=0.2)
ROUND = BoxErrors((-0.7, -0.2, 0.01, 0.6, -0.1), (-0.6, -0.2, 0.02, 0.2, 0.05), 0.17)
LONG = BoxErrors((0.2, -0.3, 0.0, 0.3, 0.0), (-1.4, 0.1, 0.0, 0.1, 0.0), 0.9)
POSES = ((0.0, 0.0, 0.0), (300.0, -40.0, 0.7), (-25.0, 60.0, -2.4), (8.0, 3.0, 1.5), (500.0, 500.0, 3.0))


def spread_of(model: BoxErrors, some: Boxes, pose: tuple[float, float, float]) -> np.ndarray:
    return model.covariances_m2(some.xy_m, some.score, pose)


def ego(own: Boxes, *others: SourceBoxes, errors: BoxErrors = FLAT) -> EgoSources:
    return EgoSources(HERE, own, False, others, errors=errors)


def intersected(
    boxes: Sequence[Boxes], parts: Sequence[np.ndarray], weights: Sequence[float], common: float
) -> np.ndarray:
    """Where one car is by all of its boxes, their covariances and weights."""
    at = np.concatenate([b.xy_m for b in boxes]).astype(float)
    information = inverse(np.concatenate(parts).astype(float)) * np.array(weights)[:, None]
    return intersect(at - at[0], information, np.zeros(len(at), np.intp), common).xy_m[0] + at[0]


def test_a_covariance_lies_along_the_sight_and_below_the_drone_both_axes_count_alike() -> None:
    found = spread_of(FLAT, boxes_at((30, 40, 0.5)), HERE)[0]
    values, axes = np.linalg.eigh(np.array([[found[0], found[1]], [found[1], found[2]]]))
    assert values == pytest.approx([0.09, 0.36], rel=1e-5)
    assert abs(axes[:, 1] @ [0.6, 0.8]) == pytest.approx(1.0)
    np.testing.assert_array_equal(spread_of(FLAT, boxes_at((130, 140, 0.5)), (100.0, 100.0, 2.0))[0], found)
    np.testing.assert_allclose(spread_of(FLAT, boxes_at((0, 0, 0.5)), HERE), [[0.225, 0.0, 0.225]], rtol=1e-6)


def test_scores_and_distances_outside_of_the_fit_stay_within_bounds() -> None:
    wild = BoxErrors((3.0, 2.0, 1.0, 5.0, 5.0), (-9.0, 0, 0, 0, 0))
    found = wild.deviations_m(np.array([0.0, 1.0]), np.array([0.0, 900.0]))
    assert found.max() == 5.0
    assert found.min() == 0.05
    assert np.isfinite(terms(np.array([0.0, 1.0]), np.array([0.0, 1e6]))).all()


def test_the_file_is_read_as_it_was_written_and_faults_name_it(tmp_path: Path) -> None:
    path = beside(tmp_path / "net.safetensors", ERRORS)
    with pytest.raises(InputError, match=r"net.errors.json: nobody fitted how uncertain the boxes of net are"):
        load_errors(path, "net")
    path.write_text(errors_text(ROUND, {"command": "none"}))
    assert load_errors(path, "net") == ROUND
    for text, message in (
        (
            '{"along": [1, 2], "across": [1, 2, 3, 4, 5], "common": 0}',
            r"along is \[1.0, 2.0\], must be 5 finite numbers",
        ),
        (errors_text(replace(ROUND, common=1.5), {}), r"common is 1.5, must be in \[0, 1\]"),
        ("[]", "not a file of box errors"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            load_errors(path, "net")


def test_a_place_is_the_intersection_of_its_boxes_and_all_else_their_average() -> None:
    own, theirs = boxes_at((30, 40, 0.5)), boxes_at((30.4, 39.8, 0.9))
    covariances = spread_of(FLAT, own, HERE), spread_of(ROUND, theirs, (60.0, 0.0, 1.0))
    peer = SourceBoxes(theirs, 0.5, HERE, covariance_m2=covariances[1])
    plain = joined_many([ego(own, replace(peer, covariance_m2=None))], "average")[0]
    for errors in (FLAT, replace(FLAT, common=1.0)):
        found = joined_many([ego(own, peer, errors=errors)], "nms")[0]  # whichever rule is chosen for other boxes
        wanted = intersected((own, theirs), covariances, (1.0, 0.5), errors.common)
        np.testing.assert_allclose(found.xy_m[0], wanted, atol=1e-5)
        for name in ("size_m", "yaw_rad", "score"):
            np.testing.assert_array_equal(getattr(found, name), getattr(plain, name))
    assert abs(plain.xy_m - found.xy_m).max() > 0.02


def test_age_grows_a_covariance_by_what_cars_may_have_moved_or_by_a_tracks_velocity() -> None:
    own, theirs = boxes_at((30, 40, 0.5)), boxes_at((30.5, 40, 0.5))
    first, covariance = spread_of(FLAT, own, HERE), spread_of(FLAT, theirs, HERE)
    late = SourceBoxes(theirs, 1.0, HERE, age_s=0.2, covariance_m2=covariance)
    followed = replace(late, velocity_mps=np.zeros((1, 2)), variance_m2=np.array([SIGMA0_M**2 + 0.05]))
    for source, more_m2 in ((late, MOVING * (SPEED_MPS * 0.2) ** 2), (followed, 0.05)):
        grown = covariance.astype(float) + more_m2 * np.array([[1.0, 0.0, 1.0]])
        wanted = intersected((own, theirs), (first, grown), (1.0, 1.0), 0.2)
        np.testing.assert_allclose(joined_many([ego(own, source)], "nms")[0].xy_m[0], wanted, atol=1e-5)


def test_a_share_brings_the_covariances_of_its_senders_boxes() -> None:
    peer, alone = cross(0.0, 0.0, 0.0)[1], boxes_at((30, 40, 0.5))
    share = Share(peer, "uncertain_boxes", 0.0, None, 1.0)
    np.testing.assert_array_equal(source_of(share, alone, FLAT).covariance_m2, spread_of(FLAT, alone, peer.est_pose))
    of_another = source_of(share._replace(boxes=alone, errors=ROUND), None, FLAT)
    np.testing.assert_array_equal(of_another.covariance_m2, spread_of(ROUND, alone, peer.est_pose))
    assert source_of(share._replace(representation="detections"), alone, FLAT).covariance_m2 is None
    with pytest.raises(InputError, match="does not tell how uncertain its boxes are: let policies send detections"):
        source_of(share, alone)


def test_a_receiver_without_fitted_errors_joins_uncertain_boxes_of_another_network(tmp_path: Path) -> None:
    """Its own boxes have the usual covariance of their class; boxes of its own network cannot be sent with one."""
    seen = SceneModel(Scene(), None, (-50.0, -50.0, 50.0, 50.0))
    detector = SurrogateDetector(seen, Perception(detector="surrogate"), 1)
    detector._path = tmp_path / "net.safetensors"
    own, peer = cross(0.0, 0.0, 0.0)[:2]
    alone = detector.detect([(own, [])])[0]
    theirs = boxes_at(*((*alone.xy_m[0] + 0.3, 0.5), (30, 40, 0.5)))
    share = Share(peer, "uncertain_boxes", 0.0, None, 1.0, boxes=theirs, errors=ROUND)
    sources = EgoSources(own.est_pose, alone, False, [source_of(share, None)])
    assert detector.detect([(own, [share])])[0].xy_m.tolist() == joined_many([sources], "average")[0].xy_m.tolist()
    with pytest.raises(InputError, match=r"nobody fitted how uncertain the boxes of net\.safetensors are"):
        detector.detect([(own, [share._replace(boxes=None, errors=None)])])


def test_what_places_have_in_common_is_the_detectors_share_or_all() -> None:
    own, theirs = boxes_at((20.0, 0.0, 0.6)), boxes_at((20.6, 0.5, 0.8))
    source = SourceBoxes(theirs, 0.5, HERE, covariance_m2=np.array([[0.05, 0.0, 0.6]]))

    def place(errors: BoxErrors | None) -> np.ndarray:
        (found,) = joined_many([EgoSources(HERE, own, False, [source], errors=errors)], "nms")
        return found.xy_m[0]

    shares = [place(replace(LONG, common=common)) for common in (0.0, LONG.common, 1.0)]
    np.testing.assert_array_equal(place(LONG), shares[1])
    assert np.abs(shares[0] - shares[1]).max() > 0.0001
    assert np.abs(shares[1] - shares[2]).max() > 0.0001


# --- many egos in one call ------------------------------------------------------------------------------


def around(pose: tuple[float, float, float], rng: np.random.Generator, count: int) -> Boxes:
    """Boxes near places that all who look about this pose have boxes of; best first."""
    at = np.array([(k % 3 * 25.0 - 20.0, k // 3 * 25.0 - 15.0) for k in range(count)]) + rng.normal(0, 0.4, (count, 2))
    rows = np.column_stack(
        [at, np.full(count, 4.5), np.full(count, 1.9), rng.normal(0, 0.1, count), rng.uniform(0.2, 0.9, count)]
    )
    found = Boxes.placed(rows, (pose[0], pose[1], 0.0))
    return found.take(np.argsort(-found.score))


def egos(exact: bool) -> list[EgoSources]:
    """Of unequally many sources; ages, weights and errors differ, one hears nobody, one only what counts nothing."""
    rng, found = np.random.default_rng(4), []
    for k, pose in enumerate(POSES):
        errors = (ROUND, LONG)[k % 2]
        others = []
        for s in range((2, 1, 0, 3, 1)[k]):
            boxes, there = around(pose, rng, 5 + s), (pose[0] + 15.0 * s, pose[1] - 9.0, 0.3 * s)
            known = (ROUND, LONG)[s % 2].covariances_m2(boxes.xy_m, boxes.score, there) if exact else None
            roi, weight, age_s = (
                (*there[:2], 60.0) if s == 1 else None,
                (0.9, 0.4, 0.7)[s],
                (0.3, 0.1, 0.6)[s] + 0.1 * k,
            )
            others.append(SourceBoxes(boxes, weight, there, roi, s == 2, age_s=age_s, covariance_m2=known))
        if k == 4:
            others = [replace(others[0], weight=0.0)]
        own = around(pose, rng, 6 - k)
        found.append(
            EgoSources(pose, own, k == 3, others, (0.5, 0.05, 0.2, 0.8, 0.1)[k], k != 1, errors if exact else None)
        )
    return found


def table(boxes: Boxes) -> np.ndarray:
    return np.column_stack([boxes.table(), boxes.score])


@pytest.mark.parametrize("rule", ["nms", "average"])
def test_of_many_egos_each_is_joined_as_alone(rule: Rule) -> None:
    """Whoever else is joined in the same call, in whatever order; those with covariances beside those without."""
    every = [*egos(exact=False), *egos(exact=True)]
    alone = [table(joined_many([ego], rule)[0]) for ego in every]
    order = np.random.default_rng(1).permutation(len(every)).tolist()
    for places in (list(range(5)), list(range(5, 10)), list(range(10)), order):
        for k, boxes in zip(places, joined_many([every[k] for k in places], rule), strict=True):
            np.testing.assert_allclose(table(boxes), alone[k], rtol=1e-6, atol=1e-6)
    plain, other = (joined_many([egos(exact=False)[0]], r)[0] for r in ("nms", "average"))
    assert not np.allclose(table(plain)[0], table(other)[0], atol=1e-3)  # the rule matters without covariances
    assert joined_many([], rule) == []


@pytest.mark.parametrize("weight", [1.0, 0.6])
def test_an_ego_far_away_and_turned_joins_by_the_errors_of_its_own_sight(weight: float) -> None:
    """Its line of sight begins where it is. Weights go with their boxes, also where a peer's box is the best of all."""
    pose, there = (300.0, -40.0, 0.7), (360.0, -60.0, 0.0)
    own = boxes_at((330.0, 0.0, 0.4), (300.0, -90.0, 0.3))
    theirs = boxes_at((300.5, -89.7, 0.9), (329.6, 0.6, 0.35))
    sent, mine = spread_of(ROUND, theirs, there), spread_of(LONG, own, pose)
    assert np.abs(mine[0, 1]) > 0.1  # the sight runs north-east
    peer = SourceBoxes(theirs, weight, there, covariance_m2=sent)
    (found,) = joined_many([EgoSources(pose, own, False, [peer], errors=LONG)], "nms")
    assert len(found) == 2
    for a, b in ((0, 1), (1, 0)):
        pair = own.take(np.array([a])), theirs.take(np.array([b]))
        wanted = intersected(pair, (mine[[a]], sent[[b]]), (1.0, weight), LONG.common)
        assert np.hypot(*(found.xy_m - wanted).T).min() < 2e-4, (a, b)


seeds = st.integers(0, 2**32 - 1)


def matrix(parts: np.ndarray) -> np.ndarray:
    a, b, c = parts
    return np.array([[a, b], [b, c]])


def drawn(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Places [n, 2] and covariances [n, 2, 2], up to thirty times as long as wide."""
    half = rng.normal(size=(n, 2, 2)) * rng.uniform(0.2, 3.0, (n, 1, 1))
    return rng.normal(size=(n, 2)), half @ half.transpose(0, 2, 1) + 0.05 * np.eye(2)


def of_one(places: np.ndarray, covariances: np.ndarray, common: float = 1.0) -> Intersection:
    parts = np.stack([covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]], axis=1)
    return intersect(places, inverse(parts), np.zeros(len(places), np.intp), common)


@given(a=st.floats(0.1, 9.0), b=st.floats(0.1, 9.0))
@example(a=1.125, b=1.109375)  # the last weight vanishes slowly
def test_two_places_along_the_same_axes_have_the_weights_of_the_closed_form(a: float, b: float) -> None:
    """det(ω A + (1 − ω) B) is a parabola in ω where both are diagonal: its top, or an end."""
    first, second = np.diag([1.0, a]), np.diag([b, 1.0])
    found = of_one(np.array([[0.0, 0.0], [1.0, 1.0]]), np.array([first, second]))
    p, q = 1.0 - 1.0 / b, 1.0 / a - 1.0  # slopes of the two entries of ω A + (1 − ω) B
    square = p * q
    omega = 0.5 if square == 0 else -(p * 1.0 + q / b) / (2.0 * square)
    if square >= 0:  # no top between the ends
        omega = float(np.linalg.det(np.linalg.inv(first)) >= np.linalg.det(np.linalg.inv(second)))
    omega = min(max(omega, 0.0), 1.0)
    best = omega * np.linalg.inv(first) + (1.0 - omega) * np.linalg.inv(second)
    assert np.linalg.det(matrix(found.covariance_m2[0])) == pytest.approx(1.0 / np.linalg.det(best), rel=3e-4)
    assert found.weight.sum() == pytest.approx(1.0)


def test_with_a_common_share_two_equal_places_lie_between_one_and_two_independent_ones() -> None:
    """P / ω is c P / ω for the common part alone: with halves, (1 + c) P each, so P (1 + c) / 2 together."""
    both = np.array([np.eye(2)] * 2)
    for common in (0.0, 0.25, 0.6, 1.0):
        found = of_one(np.zeros((2, 2)), both, common)
        np.testing.assert_allclose(matrix(found.covariance_m2[0]), (1.0 + common) / 2.0 * np.eye(2))


def test_without_common_errors_it_is_the_mean_by_inverse_covariances() -> None:
    places, covariances = drawn(np.random.default_rng(5), 4)
    whole = np.linalg.inv(np.linalg.inv(covariances).sum(axis=0))
    found = of_one(places, covariances, 0.0)
    np.testing.assert_allclose(matrix(found.covariance_m2[0]), whole)
    np.testing.assert_allclose(found.xy_m[0], whole @ np.einsum("nij,nj->i", np.linalg.inv(covariances), places))


@settings(max_examples=25, deadline=None)
@given(seed=seeds, n=st.integers(2, 5), common=st.sampled_from([0.17, 0.5, 1.0]))
def test_an_independent_optimiser_finds_no_smaller_covariance(seed: int, n: int, common: float) -> None:
    """Sequential quadratic programming over the weights, with full matrices of the common and the independent part."""
    places, covariances = drawn(np.random.default_rng(seed), n)

    def whole(weights: np.ndarray) -> np.ndarray:
        safe = np.maximum(weights, 1e-9)[:, None, None]
        return np.linalg.inv(common * covariances / safe + (1.0 - common) * covariances).sum(axis=0)

    best = minimize(
        lambda w: -np.linalg.slogdet(whole(w))[1],
        np.full(n, 1.0 / n),
        method="SLSQP",
        bounds=[(0.0, 1.0)] * n,
        constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0},
        options={"ftol": 1e-12, "maxiter": 500},
    )
    found = of_one(places, covariances, common)
    np.testing.assert_allclose(np.linalg.inv(whole(found.weight)), matrix(found.covariance_m2[0]), rtol=1e-5)
    assert np.linalg.slogdet(matrix(found.covariance_m2[0]))[1] <= best.fun + 5e-4


@settings(max_examples=25, deadline=None)
@given(seed=seeds)
def test_it_covers_the_error_whatever_the_errors_have_in_common(seed: int) -> None:
    """With any joint covariance of two errors that has these two on its diagonal."""
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(4, 4))
    joint = half @ half.T + 0.05 * np.eye(4)
    found = of_one(np.zeros((2, 2)), np.array([joint[:2, :2], joint[2:, 2:]]))
    covariance = matrix(found.covariance_m2[0])
    gains = [
        covariance @ (w * np.linalg.inv(p)) for w, p in zip(found.weight, (joint[:2, :2], joint[2:, 2:]), strict=True)
    ]
    both = np.concatenate(gains, axis=1)
    assert np.linalg.eigvalsh(covariance - both @ joint @ both.T).min() > -1e-9


def test_groups_are_each_as_alone_and_a_place_alone_stays() -> None:
    rng = np.random.default_rng(2)
    places, covariances = drawn(rng, 6)
    group = np.array([2, 0, 2, 1, 0, 2])
    parts = np.stack([covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]], axis=1)
    together = intersect(places, inverse(parts), group)
    for g in range(3):
        alone = of_one(places[group == g], covariances[group == g])
        np.testing.assert_allclose(together.xy_m[g], alone.xy_m[0])
        np.testing.assert_allclose(together.covariance_m2[g], alone.covariance_m2[0])
        np.testing.assert_allclose(together.weight[group == g], alone.weight)
    np.testing.assert_allclose(together.xy_m[1], places[3])
