"""What joining takes of a share and of its ego: which pose, which time, whose age, which variance, whose common part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from perception_examples import capture

from sortie.perception.joining import EgoSources, SourceBoxes, joined_many, source_of
from sortie.perception.lateness import CARS, reach_m, still_right
from sortie.perception.motion import Tracks
from sortie.perception.types import Boxes, Share
from sortie.perception.uncertainty import BoxErrors

HERE = (0.0, 0.0, 0.0)
ERRORS = BoxErrors((0.4, -0.1, 0.0, 0.2, 0.0), (-1.2, 0.0, 0.1, 0.1, 0.0), 0.9)


def boxes_at(*rows: tuple[float, float, float]) -> Boxes:
    """Cars by x, y and score, heading east."""
    return Boxes.placed(np.array([(x, y, 4.5, 1.9, 0.0, score) for x, y, score in rows]), HERE)


def test_boxes_are_as_uncertain_as_they_look_from_where_the_sender_believed_to_be() -> None:
    """What was sent was worked out by the sender, who knows no truth."""
    boxes = boxes_at((40.0, 10.0, 0.8), (-20.0, 35.0, 0.3))
    seen = capture(0.0, 0.0, yaw=0.0, est=(15.0, -12.0, 60.0, 0.4))
    got = source_of(Share(seen, "uncertain_boxes", 1.0, None, 1.0), boxes, ERRORS).covariance_m2
    assert got is not None
    np.testing.assert_array_equal(got, ERRORS.covariances_m2(boxes.xy_m, boxes.score, (15.0, -12.0, 0.4)))
    assert np.abs(got - ERRORS.covariances_m2(boxes.xy_m, boxes.score, HERE)).max() > 0.01


def test_a_late_box_goes_with_the_track_that_was_there_when_it_was_seen() -> None:
    """A track at 12 m/s is compared with the box where it was at the capture, not where it is at the fusion."""
    track = Tracks(
        owner=np.array([0]), id=np.array([1]), t_s=np.array([6.0]), xy_m=np.array([[30.0, 5.0]]),
        velocity_mps=np.array([[12.0, 0.0]]), covariance=np.array([[0.1, 0.0, 0.1]]), size_m=np.array([[4.5, 1.9]]),
        yaw_rad=np.zeros(1), score=np.array([0.8]), hits=np.array([9]), looks=np.array([9]), seen_s=np.array([6.0]),
        confirmed=np.array([True]),
    )  # fmt: skip
    boxes = boxes_at((30.0 - 12.0, 5.0, 0.7), (30.0, 5.0, 0.6))
    share = Share(capture(t_s=5.0), "detections", 1.0, None, 1.0, age_s=1.0, tracks=track)
    got = source_of(share, boxes).velocity_mps
    assert got is not None
    np.testing.assert_array_equal(got, [[12.0, 0.0], [np.nan, np.nan]])


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


@pytest.mark.parametrize("rule", ["nms", "average"])
def test_boxes_lose_by_their_whole_age_where_the_ego_has_no_look(rule: str) -> None:
    """There is no look of its own that they could be compared with, however late all of them are."""
    lone = boxes_at((20.0, 0.0, 0.8))
    ego = EgoSources(HERE, Boxes.empty(), False, [SourceBoxes(lone, 1.0, HERE, age_s=0.7)], age_s=0.3, looked=False)
    assert ego.freshest_s == 0.0
    (found,) = joined_many([ego], rule)  # type: ignore[arg-type]
    assert found.score == pytest.approx(0.8 * still_right(reach_m(lone.size_m), 0.7), rel=1e-5)


@pytest.mark.parametrize("rule", ["nms", "average"])
def test_a_peer_that_is_not_trusted_at_all_changes_nothing_by_being_fresh(rule: str) -> None:
    """What all others bring is as old as the ego's own look, so that nobody's boxes lose by their age."""
    own, theirs = boxes_at((20.0, 0.0, 0.6)), boxes_at((40.0, 0.0, 0.8), (20.5, 0.0, 0.5))
    others = [SourceBoxes(theirs, 1.0, HERE, age_s=0.5), SourceBoxes(boxes_at((60.0, 0.0, 0.9)), 0.0, HERE)]
    lost, fresh = (
        joined_many([EgoSources(HERE, own, False, some, age_s=0.5)], rule)[0] for some in (others[:1], others)
    )  # type: ignore[arg-type]
    assert fresh.xy_m.tolist() == lost.xy_m.tolist()
    assert fresh.score.tolist() == lost.score.tolist()
    assert fresh.score[0] == pytest.approx(0.8 if rule == "nms" else 0.55)


@pytest.mark.parametrize("known", [(0.35**2, np.nan), (np.nan, 0.35**2)])
def test_of_two_boxes_of_a_drone_for_one_car_the_surer_one_is_its_vote(known: tuple[float, float]) -> None:
    """One of both is known to be where it was, whatever its age; the drone's vote loses nothing by the other."""
    twice = boxes_at((20.0, 0.0, 0.8), (20.6, 0.0, 0.8))
    late = SourceBoxes(twice, 1.0, HERE, age_s=0.8, variance_m2=np.array(known))
    (found,) = joined_many([EgoSources(HERE, Boxes.empty(), False, [late], looked=False)], "average")
    assert found.score.tolist() == pytest.approx([0.8])


def test_a_late_box_exactly_on_the_fresh_one_counts_as_one_beside_it() -> None:
    """That it lies there tells that the car stands, a tenth of a millimetre off as well."""
    own = boxes_at((20.0, 0.0, 0.6))
    exact, close = (
        joined_many(
            [EgoSources(HERE, own, False, [SourceBoxes(boxes_at((x, 0.0, 0.9)), 1.0, HERE, age_s=1.0)])], "average"
        )[0].score[0]
        for x in (20.0, 20.0001)
    )
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


def test_what_places_have_in_common_is_the_detectors_share_or_all() -> None:
    own, theirs = boxes_at((20.0, 0.0, 0.6)), boxes_at((20.6, 0.5, 0.8))
    source = SourceBoxes(theirs, 0.5, HERE, covariance_m2=np.array([[0.05, 0.0, 0.6]]))

    def place(errors: BoxErrors | None) -> np.ndarray:
        (found,) = joined_many([EgoSources(HERE, own, False, [source], errors=errors)], "nms")
        return found.xy_m[0]

    shares = [place(replace(ERRORS, common=common)) for common in (0.0, ERRORS.common, 1.0)]
    np.testing.assert_array_equal(place(ERRORS), shares[1])
    assert np.abs(shares[0] - shares[1]).max() > 0.0001
    assert np.abs(shares[1] - shares[2]).max() > 0.0001
