"""Boxes with uncertainty: the fitted covariances, and how a receiver joins them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from perception_examples import cross

from sortie.perception.budget import content_bytes
from sortie.perception.errors import InputError
from sortie.perception.intersection import intersect, inverse
from sortie.perception.joining import EgoSources, SourceBoxes, joined_many, source_of
from sortie.perception.lateness import MOVING, SIGMA0_M, SPEED_MPS
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.types import Boxes, Share
from sortie.perception.uncertainty import BoxErrors, errors_text, load_errors, terms
from sortie.scenarios.schema import Perception, Scene
from sortie.scenarios.shipped import ERRORS, beside

HERE = (0.0, 0.0, 0.0)
FLAT = BoxErrors((np.log(0.6), 0, 0, 0, 0), (np.log(0.3), 0, 0, 0, 0), common=0.2)
FITTED = BoxErrors((-0.7, -0.2, 0.01, 0.6, -0.1), (-0.6, -0.2, 0.02, 0.2, 0.05), 0.17)


def boxes(*rows: tuple[float, float, float]) -> Boxes:
    table = np.array([(x, y, 4.5, 1.9, 0.0, score) for x, y, score in rows])
    return Boxes.placed(table.reshape(-1, 6), HERE)


def spread_of(model: BoxErrors, some: Boxes, pose: tuple[float, float, float]) -> np.ndarray:
    return model.covariances_m2(some.xy_m, some.score, pose)


def ego(own: Boxes, *others: SourceBoxes, errors: BoxErrors = FLAT) -> EgoSources:
    return EgoSources(HERE, own, False, others, errors=errors)


def test_a_covariance_lies_along_the_sight() -> None:
    found = spread_of(FLAT, boxes((30, 40, 0.5)), HERE)[0]
    values, axes = np.linalg.eigh(np.array([[found[0], found[1]], [found[1], found[2]]]))
    assert values == pytest.approx([0.09, 0.36], rel=1e-5)
    assert abs(axes[:, 1] @ [0.6, 0.8]) == pytest.approx(1.0)
    moved = spread_of(FLAT, boxes((130, 140, 0.5)), (100.0, 100.0, 2.0))[0]
    np.testing.assert_array_equal(moved, found)


def test_below_the_drone_both_axes_count_alike() -> None:
    np.testing.assert_allclose(spread_of(FLAT, boxes((0, 0, 0.5)), HERE), [[0.225, 0.0, 0.225]], rtol=1e-6)


def test_the_file_is_read_as_it_was_written_and_faults_name_it(tmp_path: Path) -> None:
    path = beside(tmp_path / "net.safetensors", ERRORS)
    with pytest.raises(InputError, match=r"net.errors.json: nobody fitted how uncertain the boxes of net are"):
        load_errors(path, "net")
    path.write_text(errors_text(FITTED, {"command": "none"}))
    assert load_errors(path, "net") == FITTED
    for text, message in (
        ('{"along": [1, 2], "across": [1, 2, 3, 4, 5], "common": 0}', r"along is \[1.0, 2.0\], must be 5 finite numbers"),
        (errors_text(replace(FITTED, common=1.5), {}), r"common is 1.5, must be in \[0, 1\]"),
        ("[]", "not a file of box errors"),
    ):  # fmt: skip
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            load_errors(path, "net")


def test_a_place_is_the_intersection_of_its_boxes_and_all_else_their_average() -> None:
    own, theirs = boxes((30, 40, 0.5)), boxes((30.4, 39.8, 0.9))
    covariances = spread_of(FLAT, own, HERE), spread_of(FITTED, theirs, (60.0, 0.0, 1.0))
    peer = SourceBoxes(theirs, 0.5, HERE, covariance_m2=covariances[1])
    plain = joined_many([ego(own, replace(peer, covariance_m2=None))], "average")[0]
    for errors in (FLAT, replace(FLAT, common=1.0)):
        of = ego(own, peer)._replace(errors=errors)
        found = joined_many([of], "nms")[0]  # whichever rule is chosen for other boxes
        information = inverse(np.concatenate(covariances).astype(float)) * np.array([[1.0], [0.5]])
        at = np.concatenate([own.xy_m, theirs.xy_m]).astype(float)
        wanted = intersect(at, information, np.zeros(2, np.intp), errors.common)
        np.testing.assert_allclose(found.xy_m, wanted.xy_m, atol=1e-5)
        for name in ("size_m", "yaw_rad", "score"):
            np.testing.assert_array_equal(getattr(found, name), getattr(plain, name))
    assert abs(plain.xy_m - found.xy_m).max() > 0.02


def test_age_grows_a_covariance_by_what_cars_may_have_moved_or_by_a_tracks_velocity() -> None:
    own, theirs = boxes((30, 40, 0.5)), boxes((30.5, 40, 0.5))
    covariance = spread_of(FLAT, theirs, HERE)
    late = SourceBoxes(theirs, 1.0, HERE, age_s=0.2, covariance_m2=covariance)
    first = spread_of(FLAT, own, HERE)
    for source, more_m2 in (
        (late, MOVING * (SPEED_MPS * 0.2) ** 2),
        (replace(late, velocity_mps=np.zeros((1, 2)), variance_m2=np.array([SIGMA0_M**2 + 0.05])), 0.05),
    ):
        grown = covariance.astype(float) + more_m2 * np.array([[1.0, 0.0, 1.0]])
        information = inverse(np.concatenate([first.astype(float), grown]))
        at = np.concatenate([own.xy_m, theirs.xy_m]).astype(float)
        wanted = intersect(at, information, np.zeros(2, np.intp), 0.2)
        np.testing.assert_allclose(joined_many([ego(own, source)], "nms")[0].xy_m, wanted.xy_m, atol=1e-5)


def test_egos_with_and_without_covariances_are_each_as_alone() -> None:
    own, theirs = boxes((30, 40, 0.5)), boxes((30.4, 39.8, 0.9), (60, 0, 0.3))
    plain = SourceBoxes(theirs, 1.0, HERE)
    exact = replace(plain, covariance_m2=spread_of(FLAT, theirs, HERE))
    egos = [ego(own, plain), ego(own, exact), ego(own), ego(own, plain, exact)]
    together = joined_many(egos, "nms")
    for one, boxes_ in zip(egos, together, strict=True):
        alone = joined_many([one], "nms")[0]
        np.testing.assert_array_equal(boxes_.table(), alone.table())
    assert len(together[2]) == 1


def test_a_share_brings_the_covariances_of_its_senders_boxes() -> None:
    peer = cross(0.0, 0.0, 0.0)[1]
    share = Share(peer, "uncertain_boxes", 0.0, None, 1.0)
    alone = boxes((30, 40, 0.5))
    np.testing.assert_array_equal(source_of(share, alone, FLAT).covariance_m2, spread_of(FLAT, alone, peer.est_pose))
    of_another = source_of(share._replace(boxes=alone, errors=FITTED), None, FLAT)
    np.testing.assert_array_equal(of_another.covariance_m2, spread_of(FITTED, alone, peer.est_pose))
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
    theirs = boxes(*((*alone.xy_m[0] + 0.3, 0.5), (30, 40, 0.5)))
    share = Share(peer, "uncertain_boxes", 0.0, None, 1.0, boxes=theirs, errors=FITTED)
    sources = EgoSources(own.est_pose, alone, False, [source_of(share, None)])
    assert detector.detect([(own, [share])])[0].xy_m.tolist() == joined_many([sources], "average")[0].xy_m.tolist()
    with pytest.raises(InputError, match=r"nobody fitted how uncertain the boxes of net\.safetensors are"):
        detector.detect([(own, [share._replace(boxes=None, errors=None)])])


def test_a_box_with_its_covariance_has_36_bytes() -> None:
    assert content_bytes("uncertain_boxes", boxes=5) == 5 * 36
    assert content_bytes("uncertain_boxes", boxes=5, classes=True) == 5 * 37


def test_scores_and_distances_outside_of_the_fit_stay_within_bounds() -> None:
    wild = BoxErrors((3.0, 2.0, 1.0, 5.0, 5.0), (-9.0, 0, 0, 0, 0))
    found = wild.deviations_m(np.array([0.0, 1.0]), np.array([0.0, 900.0]))
    assert found.max() == 5.0
    assert found.min() == 0.05
    assert np.isfinite(terms(np.array([0.0, 1.0]), np.array([0.0, 1e6]))).all()
