"""A track's life number by number, who is followed and how long, and every field of a track on the wire."""

from __future__ import annotations

import numpy as np
import pytest

from sortie.perception.classes import TRUCK
from sortie.perception.motion import Tracks
from sortie.perception.tracking.following import followed, motion_of_boxes
from sortie.perception.tracking.tracker import step
from sortie.perception.tracking.wire import TRACK, content, packed, unpacked
from sortie.perception.types import Boxes
from sortie.scenarios.disc import Disc


def box(x_m: float = 0.0, y_m: float = 0.0, size: tuple[float, float] = (4.6, 1.9), score: float = 0.8) -> Boxes:
    return Boxes(np.array([[x_m, y_m]]), np.array([size]), np.zeros(1), np.array([score]))


def tracked(*looks: tuple[float, Boxes | None]) -> Tracks:
    """One drone's tracks after looks at some times; None is a look that finds nothing."""
    tracks, next_id = Tracks.empty(), np.zeros(1, np.int64)
    for t_s, seen in looks:
        boxes = Boxes.empty() if seen is None else seen
        tracks, next_id, _ = step(tracks, boxes, np.zeros(len(boxes), np.int64), np.array([t_s]), next_id)
    return tracks


def test_size_and_score_are_means_at_first_and_then_follow_the_newest_box_by_a_fifth() -> None:
    """A size is the mean of the boxes, a score that of the looks, in which a look without a box is 0."""
    looks: list[tuple[float, Boxes | None]] = []
    for seen, size, score, confirmed in (
        (box(size=(4.0, 2.0), score=0.9), (4.0, 2.0), 0.9, False),
        (box(size=(5.0, 1.6), score=0.6), (4.5, 1.8), 0.75, False),
        (None, (4.5, 1.8), 0.5, False),
        (box(size=(4.5, 2.4), score=0.8), (4.5, 2.0), 0.575, True),
        (box(size=(4.1, 2.0), score=0.4), (4.4, 2.0), 0.54, True),
        (box(size=(4.9, 2.5), score=0.9), (4.5, 2.1), 0.612, True),
        (box(size=(5.5, 2.1), score=0.612), (4.7, 2.1), 0.612, True),
        (None, (4.7, 2.1), 0.4896, True),
    ):
        looks.append((0.5 * len(looks), seen))
        tracks = tracked(*looks)
        np.testing.assert_allclose(tracks.size_m, [size])
        assert tracks.score == pytest.approx([score])
        assert tracks.confirmed.tolist() == [confirmed]
        boxes = [t_s for t_s, b in looks if b is not None]
        assert (tracks.hits.tolist(), tracks.looks.tolist()) == ([len(boxes)], [len(looks)])
        assert (tracks.t_s.tolist(), tracks.seen_s.tolist()) == ([looks[-1][0]], [boxes[-1]])


@pytest.mark.parametrize(
    ("score", "missed", "lives"), [(0.3, 2, True), (0.3, 3, False), (0.9, 3, True), (0.9, 9, False)]
)
def test_a_track_is_lost_once_its_score_is_too_low(score: float, missed: int, lives: bool) -> None:
    """Long before it has coasted for two seconds: 0.3 becomes 0.225, 0.18, 0.144."""
    looks = [(0.1 * k, box(score=score)) for k in range(3)]
    assert len(tracked(*looks, *[(0.1 * (3 + k), None) for k in range(missed)])) == lives


def test_a_second_false_positive_ends_a_track_that_nobody_confirmed() -> None:
    """Of the first four looks at most one may find nothing."""
    assert len(tracked((0.0, box()), (0.1, None))) == 1
    assert len(tracked((0.0, box()), (0.1, None), (0.2, None))) == 0
    assert tracked((0.0, box()), (0.1, None), (0.2, box()), (0.3, box())).confirmed.tolist() == [True]
    assert len(tracked((0.0, box()), (0.1, None), (0.2, box()), (0.3, None))) == 0


def driving(looks: int = 8) -> Tracks:
    """A car that drives east at 8 m/s from x = 0 at t = 0, seen twice a second."""
    return tracked(*((0.5 * k, box(4.0 * k)) for k in range(looks)))


@pytest.mark.parametrize(("later_s", "follows"), [(0.0, True), (1.9, True), (2.1, False)])
def test_a_target_is_followed_while_its_track_had_a_box_lately(later_s: float, follows: bool) -> None:
    """At the time that is asked for, also where no look has been since; one that was followed is let go alike."""
    tracks, now_s = driving(), 3.5 + later_s
    cue = (8.0 * now_s, 0.0, 8.0, 0.0)
    for before in ({}, {7: 0}):
        assert followed(tracks, {7: cue}, before, now_s) == ({7: 0} if follows else {})


@pytest.mark.parametrize(("off_m", "follows"), [(0.0, True), (2.5, True), (9.0, False), (60.0, False)])
def test_a_followed_track_is_let_go_where_its_place_agrees_no_more(off_m: float, follows: bool) -> None:
    cue = (28.0, off_m, 0.0, 8.0)  # its velocity agrees by no means
    assert followed(driving(), {7: cue}, {7: 0}, 3.5) == ({7: 0} if follows else {})
    assert followed(driving(), {}, {7: 0}, 3.5) == {}
    assert followed(driving(), {7: cue}, {7: 5}, 3.5) == {}  # a track that there is no more


def test_late_boxes_are_not_moved_by_a_track_that_nobody_confirmed() -> None:
    for looks, known in ((2, False), (3, True)):
        tracks = driving(looks)
        velocity, variance = motion_of_boxes(box(4.0 * (looks - 1)), 0.5 * (looks - 1), 0.3, tracks)
        assert np.isnan(velocity).any() == np.isnan(variance).any() == (not known)


def sender_s(**changes: object) -> Tracks:
    """Three tracks of drone 3, of which one is tentative."""
    columns: dict[str, object] = {
        "owner": np.full(3, 3), "id": np.array([65_541, 7, 8]), "t_s": np.full(3, 20.0),
        "xy_m": np.array([[112.344, -40.0], [90.0, -60.0], [100.0, -50.0]]), "velocity_mps": np.array([[-3.254, 7.5], [0.0, 0.0], [1.0, 1.0]]),
        "covariance": np.array([[0.36, 0.3, 1.0], [1e-6, 0.0, 1e-6], [1.0, 0.0, 1.0]]), "size_m": np.array([[8.02, 2.46], [4.6, 1.9], [4.6, 1.9]]),
        "yaw_rad": np.array([-0.5, 3.0, 0.0]), "score": np.array([0.5, 0.9, 0.95]), "hits": np.full(3, 9), "looks": np.full(3, 9),
        "seen_s": np.array([19.0, 12.0, 20.0]), "confirmed": np.array([True, True, False]), "kind": np.array([TRUCK, 0, 0], np.int8),
    }  # fmt: skip
    return Tracks(**(columns | changes))  # type: ignore[arg-type]


def test_every_field_of_a_track_is_read_as_it_was_sent() -> None:
    """Best first, at the capture's time, rounded to the table's steps; a certain track has the least deviation, not none."""
    origin_m = (100.0, -50.0)
    read = content(sender_s(), None, origin_m, 20.0)
    assert read.owner.tolist() == [3, 3]
    assert read.id.tolist() == [7, 5]  # modulo 65,536
    assert read.t_s.tolist() == [20.0, 20.0]
    assert read.seen_s == pytest.approx([20.0 - 5.1, 19.0])  # no longer ago can be told
    np.testing.assert_allclose(read.xy_m, [[90.0, -60.0], [112.34, -40.0]])
    np.testing.assert_allclose(read.velocity_mps, [[0.0, 0.0], [-3.25, 7.5]])
    np.testing.assert_allclose(read.size_m, [[4.6, 1.9], [8.0, 2.45]])
    assert np.mod(read.yaw_rad, 2 * np.pi) == pytest.approx([3.0, 2 * np.pi - 0.5], abs=1e-4)
    assert read.score == pytest.approx([0.9, 0.5], abs=0.5 / 255 + 1e-9)
    np.testing.assert_allclose(read.covariance[0], [0.02**2, 0.0, 0.05**2])
    np.testing.assert_allclose(read.covariance[1], [0.36, 0.6 * 64 / 127, 1.0])  # a correlation of a half
    assert read.kind.tolist() == [0, TRUCK]
    assert read.confirmed.all()
    negative = sender_s(covariance=np.tile([0.36, -0.3, 1.0], (3, 1)))
    assert content(negative, None, origin_m, 20.0).covariance[:, 1] == pytest.approx([-0.6 * 64 / 127] * 2)


def test_a_region_is_about_its_own_middle_and_tracks_are_where_they_are_at_the_capture() -> None:
    tracks = sender_s(velocity_mps=np.array([[10.0, 0.0], [0.0, 0.0], [0.0, 0.0]]))
    for t_s, x_m, found in ((20.0, 112.344, [5]), (22.0, 112.344, []), (22.0, 132.344, [5])):
        near = content(tracks, Disc(x_m, -40.0, 6.0), (100.0, -50.0), t_s)
        assert near.id.tolist() == found
        assert near.t_s.tolist() == [t_s] * len(found)
        assert near.xy_m[:, 0] == pytest.approx([x_m] * len(found), abs=0.006)


def test_what_is_beyond_a_field_s_range_is_at_its_end() -> None:
    far = sender_s(
        xy_m=np.tile([1e4, -1e4], (3, 1)),
        velocity_mps=np.tile([-1e3, 1e3], (3, 1)),
        size_m=np.tile([20.0, 15.0], (3, 1)),
    )
    read = unpacked(packed(far, (0.0, 0.0)), 3, (0.0, 0.0), 20.0)
    np.testing.assert_allclose(read.xy_m, np.tile([327.67, -327.68], (3, 1)))
    np.testing.assert_allclose(read.velocity_mps, np.tile([-327.68, 327.67], (3, 1)))
    np.testing.assert_allclose(read.size_m, np.tile([12.75, 12.75], (3, 1)))
    assert len(packed(far, (0.0, 0.0))) == 3 * TRACK.itemsize
