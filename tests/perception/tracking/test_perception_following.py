"""Who is followed at the edge of the gates, how late boxes and received tracks go on, and tracks on the wire."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from track_examples import tracks
from wrong_rows import wrong_rows

from sortie.perception import budget
from sortie.perception.classes import CAR, PERSON, TRUCK
from sortie.perception.lateness import CARS, PEOPLE, SIGMA0_M
from sortie.perception.motion import ACCELERATION_DENSITY, Tracks, grown
from sortie.perception.tracking import following_loops
from sortie.perception.tracking.association import GATE
from sortie.perception.tracking.following import AGREE, agree_loop, followed, motion_of, motion_of_boxes
from sortie.perception.tracking.tracker import COAST_S, PLACE_VARIANCE_M2
from sortie.perception.tracking.wire import TRACK, content, packed, unpacked
from sortie.perception.types import Boxes
from sortie.scenarios.disc import Disc


def boxes(*xy: tuple[float, float], kind: int = CAR, score: float = 0.8) -> Boxes:
    n = len(xy)
    size = np.tile([4.6, 1.9], (n, 1))
    return Boxes(
        np.array(xy, float).reshape(-1, 2), size, np.zeros(n), np.full(n, score), kind=np.full(n, kind, np.int8)
    )


def test_a_target_is_taken_up_by_place_and_velocity_together() -> None:
    """By the inverse of the whole covariance, with the cue's: ahead and faster agrees better than ahead and slower."""
    own = tracks()
    spread = np.array([[0.3 + 1.0, 0.2], [0.2, 1.0 + 1.0]])
    for direction in (np.array([1.0, 1.0]), np.array([1.0, -1.0]), np.array([1.0, 0.0]), np.array([0.0, 1.0])):
        per_step = float(direction @ np.linalg.inv(spread) @ direction)
        for square, follows in ((0.98 * AGREE, True), (1.02 * AGREE, False)):
            off, faster = direction * np.sqrt(square / per_step)
            for axis in (0, 1):
                cue = np.array([0.0, 0.0, 8.0, 0.0])
                cue[[axis, 2 + axis]] += off, faster
                assert followed(own, {4: tuple(cue)}, {}, 10.0) == ({4: 0} if follows else {})


def test_a_followed_track_stays_while_its_place_alone_is_in_the_gate() -> None:
    for square, stays in ((0.98 * GATE, True), (1.02 * GATE, False)):
        cue = (0.0, float(np.sqrt(square * 1.3)), -30.0, 30.0)
        assert followed(tracks(), {4: cue}, {4: 0}, 10.0) == ({4: 0} if stays else {})
    assert followed(tracks(), {}, {4: 0}, 10.0) == {}
    assert followed(tracks(), {4: (0.0, 0.0, 8.0, 0.0)}, {4: 5}, 10.0) == {4: 0}  # the one that it had is no more
    assert followed(Tracks.empty(), {4: (0.0, 0.0, 8.0, 0.0)}, {4: 0}, 10.0) == {}


def test_a_track_that_goes_on_without_a_box_is_no_targets() -> None:
    """Its state is of now, as at every look; when it had a box decides. People are no targets, trucks are."""
    cue = {4: (0.0, 0.0, 8.0, 0.0)}
    for unseen_s, follows in ((COAST_S - 0.01, True), (COAST_S + 0.01, False)):
        for later_s in (0.0, 0.5):  # at the time that is asked for, also where no look has been since
            there = {4: (8.0 * later_s, 0.0, 8.0, 0.0)}
            for before in ({}, {4: 0}):
                own = tracks(seen_s=np.array([10.0 + later_s - unseen_s]))
                assert followed(own, there, before, 10.0 + later_s) == ({4: 0} if follows else {})
    assert followed(tracks(confirmed=np.array([False])), cue, {}, 10.0) == {}
    for kind, follows in ((TRUCK, True), (PERSON, False)):
        for before in ({}, {4: 0}):
            found = followed(tracks(kind=np.array([kind], np.int8)), cue, before, 10.0)
            assert found == ({4: 0} if follows else {})


def test_one_track_is_one_targets_and_the_one_that_had_it_keeps_it() -> None:
    both = {1: (0.0, 0.0, 8.0, 0.0), 2: (0.5, 0.0, 8.0, 0.0)}
    assert followed(tracks(), both, {}, 10.0) == {1: 0}
    assert followed(tracks(), both, {2: 0}, 10.0) == {2: 0}
    two = tracks(2, xy_m=np.array([[0.0, 0.0], [0.9, 0.0]]))
    assert followed(two, both, {2: 0}, 10.0) == {1: 1, 2: 0}


def test_the_compiled_loop_agrees_with_the_cue_as_numpy_does() -> None:
    """Bit by bit, and by the constants of the rooms that they belong to."""
    loops = following_loops
    constants = loops.PERSON, loops.COAST_S, loops.GATE, loops.ACCELERATION_DENSITY
    assert constants == (PERSON, COAST_S, GATE, ACCELERATION_DENSITY)
    rng, n, now_s = np.random.default_rng(3), 400, 12.3
    t_s, xy_m, velocity_mps = now_s - rng.uniform(-0.5, 1.0, n), rng.normal(0, 3, (n, 2)), rng.normal(0, 3, (n, 2))
    covariance = np.column_stack([rng.uniform(0.2, 3, n), rng.uniform(0, 0.2, n), rng.uniform(0.5, 2, n)])
    kind, confirmed, seen_s = rng.integers(0, 3, n).astype(np.int8), rng.random(n) < 0.8, now_s - rng.uniform(0, 3, n)
    cue = (0.7, -0.4, 1.1, 0.3)
    near, cost = np.empty(n, bool), np.empty(n)
    agree_loop()(kind, confirmed, t_s, seen_s, xy_m, velocity_mps, covariance, cue, now_s, near, cost)

    dt, may = now_s - t_s, (kind != PERSON) & confirmed & (now_s - seen_s <= COAST_S)
    pp, pv, vv = (grown(covariance, dt) + np.array((1.0, 0.0, 1.0))).T
    off, faster = xy_m + dt[:, None] * velocity_mps - cue[:2], velocity_mps - cue[2:]
    place_m2 = (off * off).sum(axis=1)
    both = vv * place_m2 - 2.0 * pv * (off * faster).sum(axis=1) + pp * (faster * faster).sum(axis=1)
    assert 20 < near.sum() < may.sum() < n
    assert near.tolist() == (may & (place_m2 < GATE * pp)).tolist()
    assert cost.tobytes() == np.where(may, both / (pp * vv - pv * pv), np.inf).tobytes()


def test_a_late_box_takes_the_uncertainty_of_its_own_age_and_not_of_the_track_s() -> None:
    """A track that coasts moves boxes as one that was just seen; one that stands does not. People move as people do."""
    coasting = tracks(seen_s=np.array([8.5]))
    velocity, variance = motion_of_boxes(boxes((0.0, 0.0)), 10.0, 0.4, coasting)
    np.testing.assert_allclose(velocity, [[8.0, 0.0]])
    assert variance == pytest.approx([CARS.sigma0_m2 + 0.4**2 + ACCELERATION_DENSITY * 0.4**3 / 3])
    _, sent = motion_of(coasting, 0.4)
    assert sent == pytest.approx([CARS.sigma0_m2 + 1.9**2 + ACCELERATION_DENSITY * 1.9**3 / 3])
    creeps = tracks(velocity_mps=np.array([[2.0, 2.1]]))  # 2.9 standard deviations
    for velocity, variance in (motion_of(creeps, 0.4), motion_of_boxes(boxes((0.0, 0.0)), 10.0, 0.4, creeps)):
        np.testing.assert_array_equal(velocity, [[0.0, 0.0]])
        assert variance == pytest.approx([CARS.sigma0_m2])
    mixed = tracks(2, velocity_mps=np.zeros((2, 2)), kind=np.array([CAR, PERSON], np.int8))
    assert motion_of(mixed, 0.4)[1] == pytest.approx([CARS.sigma0_m2, PEOPLE.sigma0_m2])


@pytest.mark.parametrize("kind", [CAR, TRUCK, PERSON])
def test_a_late_box_is_near_by_what_is_known_of_the_track_at_its_time(kind: int) -> None:
    """The track's covariance grown over the second between and the place's variance by class add up to the gate."""
    own = tracks(kind=np.array([kind], np.int8))
    for t_s in (9.0, 11.0):
        dt = t_s - 10.0
        there = 0.3 + 2 * dt * 0.2 + 1.0 + ACCELERATION_DENSITY / 3
        for square, known in ((0.98 * GATE, True), (1.02 * GATE, False)):
            off_m = float(np.sqrt(square * (there + PLACE_VARIANCE_M2[kind])))
            velocity, variance = motion_of_boxes(boxes((8.0 * dt, off_m), kind=kind), t_s, 0.1, own)
            assert np.isfinite(velocity).all() == np.isfinite(variance).all() == known
    assert np.isnan(motion_of_boxes(boxes((0.0, 0.0), kind=(kind + 1) % 3), 10.0, 0.1, own)[1]).all()


def test_a_received_track_is_as_certain_as_the_time_since_its_last_box_leaves_it() -> None:
    """Coasting at its sender and travelling count alike; and so after its bytes were written and read."""

    def check(coasts_s: float, age_s: float) -> None:
        velocity = np.array([[9.0, -4.0], [0.01, 0.0]])  # one drives, one stands
        state = dict(velocity_mps=velocity, covariance=np.tile([0.16, 0.0, 0.25], (2, 1)))
        sent = tracks(2, t_s=np.full(2, 5.0), seen_s=np.full(2, 5.0 - coasts_s), **state)
        late_s = coasts_s + age_s
        for some in (sent, unpacked(packed(sent, (0.0, 0.0)), 0, (0.0, 0.0), 5.0)):
            moved, variance = motion_of(some, age_s)
            assert moved == pytest.approx(np.array([[9.0, -4.0], [0.0, 0.0]]), abs=0.01)
            drives_m2 = SIGMA0_M**2 + 0.25 * late_s**2 + ACCELERATION_DENSITY * late_s**3 / 3
            assert variance == pytest.approx([drives_m2, SIGMA0_M**2], rel=0.03)

    assert wrong_rows(product([0.0, 0.4, 1.2], [0.0, 0.3, 0.8]), check) == {}


def sender_s(**changes: object) -> Tracks:
    """Three tracks of drone 3, of which one is tentative."""
    columns: dict[str, object] = {
        "owner": np.full(3, 3),
        "id": np.array([65_541, 7, 8]),
        "t_s": np.full(3, 20.0),
        "xy_m": np.array([[112.344, -40.0], [90.0, -60.0], [100.0, -50.0]]),
        "velocity_mps": np.array([[-3.254, 7.5], [0.0, 0.0], [1.0, 1.0]]),
        "covariance": np.array([[0.36, 0.3, 1.0], [1e-6, 0.0, 1e-6], [1.0, 0.0, 1.0]]),
        "size_m": np.array([[8.02, 2.46], [4.6, 1.9], [4.6, 1.9]]),
        "yaw_rad": np.array([-0.5, 3.0, 0.0]),
        "score": np.array([0.5, 0.9, 0.95]),
        "seen_s": np.array([19.0, 12.0, 20.0]),
        "confirmed": np.array([True, True, False]),
        "kind": np.array([TRUCK, 0, 0], np.int8),
    }
    return tracks(3, **(columns | changes))


def test_every_field_of_a_track_is_read_as_it_was_sent() -> None:
    """Best first, at the capture's time, rounded to the table's steps; a certain track has the least deviation."""
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


def test_what_is_sent_are_the_surest_twelve_confirmed_tracks_of_the_region_the_surest_first() -> None:
    score, confirmed = np.linspace(0.3, 0.9, 17)[np.arange(17) * 5 % 17], np.arange(17) != 3
    at = dict(xy_m=np.column_stack([10.0 * np.arange(17), np.zeros(17)]), velocity_mps=np.zeros((17, 2)))
    own = tracks(17, score=score, confirmed=confirmed, **at)
    sent = content(own, None, (0.0, 0.0), 10.0)
    assert len(sent) == budget.MAX_TRACKS == 12
    assert sent.score == pytest.approx(np.sort(score[confirmed])[::-1][:12], abs=0.003)
    near = content(own, (20.0, 0.0, 25.0), (0.0, 0.0), 10.0)
    assert sorted(near.xy_m[:, 0].round().tolist()) == [0.0, 10.0, 20.0, 40.0]  # the one at 30 m is tentative


def test_twenty_bytes_hold_a_track_and_other_bytes_are_refused() -> None:
    data = packed(tracks(2), (0.0, 0.0))
    assert len(data) == 2 * budget.TRACK_BYTES == 2 * TRACK.itemsize == 40
    with pytest.raises(ValueError, match="tracks are 21 B, must be a multiple of 20 B"):
        unpacked(data[:21], 0, (0.0, 0.0), 0.0)
    unknown = np.frombuffer(data, TRACK).copy()
    unknown["kind"] = 3
    with pytest.raises(ValueError, match="a track's class is 3, must be at most 2"):
        unpacked(unknown.tobytes(), 0, (0.0, 0.0), 0.5)
