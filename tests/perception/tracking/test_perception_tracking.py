"""The tracker against a filter written with matrices, an assignment by trying everything, and cases worked out by hand."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from numpy.typing import NDArray

from sortie.perception import budget
from sortie.perception.lateness import SIGMA0_M
from sortie.perception.metrics.assignment import least_cost
from sortie.perception.motion import ACCELERATION_DENSITY, MOVES_AT, Tracks, grown, predicted
from sortie.perception.tracking import association
from sortie.perception.tracking.following import followed, motion_of, motion_of_boxes
from sortie.perception.tracking.tracker import BOX_VARIANCE_M2, COAST_S, SPEED_VARIANCE, step
from sortie.perception.tracking.wire import TRACK, content, packed, unpacked
from sortie.perception.types import Boxes

Floats = NDArray[np.float64]


def boxes(*xy_m: tuple[float, float], score: float = 0.8) -> Boxes:
    n = len(xy_m)
    return Boxes(np.array(xy_m).reshape(n, 2), np.tile([4.6, 1.9], (n, 1)), np.zeros(n), np.full(n, score))


class One:
    """One drone's tracker."""

    def __init__(self) -> None:
        self.tracks, self.next_id = Tracks.empty(), np.zeros(1, np.int64)

    def look(self, t_s: float, seen: Boxes) -> list[int]:
        owner = np.zeros(len(seen), np.int64)
        self.tracks, self.next_id, ids = step(self.tracks, seen, owner, np.array([t_s]), self.next_id)
        return ids.tolist()


def test_the_filter_is_the_one_with_matrices() -> None:
    """Four states, a transition, a measurement: the textbook's filter, over boxes at uneven times."""
    rng, tracker = np.random.default_rng(0), One()
    state = covariance = np.zeros(0)
    before_s, see = 0.0, np.eye(4)[:2]
    for k, t_s in enumerate((0.0, 0.5, 0.9, 1.6, 1.7)):
        place = np.array([8.0 * t_s, -2.0 * t_s]) + rng.normal(0, 0.3, 2)
        tracker.look(t_s, boxes(tuple(place)))
        if k == 0:
            state = np.array([*place, 0.0, 0.0])
            covariance = np.diag([BOX_VARIANCE_M2] * 2 + [SPEED_VARIANCE] * 2)
        else:
            dt = t_s - before_s
            move = np.eye(4) + dt * np.eye(4, k=2)
            noise = ACCELERATION_DENSITY * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
            state, covariance = move @ state, move @ covariance @ move.T + noise
            gain = covariance @ see.T @ np.linalg.inv(see @ covariance @ see.T + BOX_VARIANCE_M2 * np.eye(2))
            state = state + gain @ (place - see @ state)
            covariance = (np.eye(4) - gain @ see) @ covariance
        before_s = t_s
    [xy], [velocity], [(pp, pv, vv)] = tracker.tracks.xy_m, tracker.tracks.velocity_mps, tracker.tracks.covariance
    np.testing.assert_allclose([*xy, *velocity], state, rtol=1e-9)
    np.testing.assert_allclose(np.kron([[pp, pv], [pv, vv]], np.eye(2)), covariance, rtol=1e-9, atol=1e-12)
    assert len(tracker.tracks) == 1


def test_a_box_that_shows_a_car_the_other_way_round_does_not_turn_its_track() -> None:
    """Front and back look alike: what is left of its turn is taken in by its weight, a half, a third, a quarter."""
    tracker, yaw_rad = One(), 0.1
    for k, (t_s, turn_rad, off_rad) in enumerate([(0.0, 0.0, 0.0), (0.5, np.pi, 0.2), (1.0, -np.pi, 0.0), (1.5, 2 * np.pi, -0.3)]):  # fmt: skip
        seen = boxes((0.0, 0.0))
        seen.yaw_rad[:] = yaw_rad + turn_rad + off_rad
        tracker.look(t_s, seen)
        yaw_rad += off_rad / (k + 1)
        assert tracker.tracks.yaw_rad == pytest.approx([yaw_rad])


def test_a_track_told_for_an_earlier_time_is_no_more_certain_than_for_a_later_one() -> None:
    """Place and velocity drift apart with either sign of time; their covariance alone has its sign."""
    still = np.array([[1.0, 0.0, 4.0]])
    (pp, pv, vv), ((back_pp, back_pv, back_vv),) = grown(still, np.array([0.6]))[0], grown(still, np.array([-0.6]))
    assert (back_pp, back_pv, back_vv) == (pp, -pv, vv)
    assert vv == pytest.approx(4.0 + 0.6 * ACCELERATION_DENSITY)


@pytest.mark.parametrize("seed", range(20))
def test_the_assignment_is_the_best_of_all(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cost, free = rng.uniform(0, 12, (4, 5)), 9.0
    i, j = np.nonzero(cost < free)
    taken = least_cost(i, j, cost[i, j], np.zeros(len(i), np.int64), free)
    capped = np.minimum(cost, free)
    best = min(sum(capped[r, c] for r, c in enumerate(p)) for p in permutations(range(5), 4))
    assert len(set(i[taken])) == len(set(j[taken])) == taken.sum()
    assert cost[i, j][taken].sum() + free * (4 - taken.sum()) == pytest.approx(best)


def test_two_cars_that_pass_keep_their_identities() -> None:
    """They drive towards each other, 3 m apart at the closest: the nearest box alone would be the other's."""
    tracker = One()
    for k in range(13):
        t_s = 0.5 * k
        ids = tracker.look(t_s, boxes((8.0 * t_s, 0.0), (48.0 - 8.0 * t_s, 3.0)))
        assert ids == [0, 1]
    np.testing.assert_allclose(tracker.tracks.velocity_mps, [[8.0, 0.0], [-8.0, 0.0]], atol=0.05)


def test_a_track_is_tentative_then_confirmed_coasts_and_is_lost_and_its_number_is_not_used_again() -> None:
    tracker = One()
    for t_s, confirmed in ((0.0, False), (0.5, False), (1.0, True)):
        tracker.look(t_s, boxes((10.0 * t_s, 0.0)))
        assert tracker.tracks.confirmed.tolist() == [confirmed]
    t_s = 1.0
    while t_s + 0.5 <= 1.0 + COAST_S:
        t_s += 0.5
        tracker.look(t_s, boxes())
        assert tracker.tracks.confirmed.tolist() == [True]
        assert tracker.tracks.xy_m[0, 0] == pytest.approx(10.0 * t_s, abs=1.0)
    tracker.look(t_s + 0.5, boxes())
    assert len(tracker.tracks) == 0
    assert tracker.look(t_s + 1.0, boxes((0.0, 0.0))) == [1]


def test_false_positives_that_do_not_come_again_are_never_confirmed_and_weak_boxes_begin_nothing() -> None:
    tracker = One()
    for k in range(12):
        tracker.look(0.5 * k, boxes((40.0 * k, 0.0)))
        assert not tracker.tracks.confirmed.any()
        assert len(tracker.tracks) <= 3
    assert One().look(0.0, boxes((0.0, 0.0), score=0.25)) == [-1]


def test_drones_keep_apart_and_one_that_does_not_look_keeps_its_tracks() -> None:
    """Two drones at once are each alone; a NaN leaves a drone as it is."""
    places = [(5.0, 5.0), (30.0, 0.0)]
    tracks, next_id = Tracks.empty(), np.zeros(2, np.int64)
    for t_s in (0.0, 0.5, 1.0):
        tracks, next_id, ids = step(tracks, boxes(*places, *places), np.array([0, 0, 1, 1]), np.full(2, t_s), next_id)
        assert ids.tolist() == [0, 1, 0, 1]
    after, _, _ = step(tracks, boxes(), np.zeros(0, np.int64), np.array([np.nan, 1.5]), next_id)
    assert after.t_s.tolist() == [1.0, 1.0, 1.5, 1.5]
    alone = One()
    for t_s in (0.0, 0.5, 1.0):
        alone.look(t_s, boxes(*places))
    np.testing.assert_array_equal(tracks.take(tracks.owner == 1).xy_m, alone.tracks.xy_m)


def driving(speed_mps: float = 8.0, looks: int = 8) -> Tracks:
    """A car that drives east from x = 0 at t = 0, one that stands at (0, 20), seen twice a second."""
    tracker = One()
    for k in range(looks):
        tracker.look(0.5 * k, boxes((speed_mps * 0.5 * k, 0.0), (0.0, 20.0)))
    return tracker.tracks


def test_twenty_bytes_hold_a_track() -> None:
    tracks = driving()
    data = packed(tracks, (-50.0, 30.0))
    assert len(data) == len(tracks) * budget.TRACK_BYTES == len(tracks) * TRACK.itemsize
    read = unpacked(data, 0, (-50.0, 30.0), float(tracks.t_s[0]))
    for name, step_ in {"xy_m": 0.01, "velocity_mps": 0.01, "size_m": 0.05, "yaw_rad": 1e-4, "score": 1 / 255}.items():
        np.testing.assert_allclose(getattr(read, name), getattr(tracks, name), atol=step_ / 2 + 1e-9)
    np.testing.assert_allclose(np.sqrt(read.covariance[:, [0, 2]]), np.sqrt(tracks.covariance[:, [0, 2]]), atol=0.025)
    assert read.id.tolist() == tracks.id.tolist()
    with pytest.raises(ValueError, match="tracks are 21 B, must be a multiple of 20 B"):
        unpacked(data[:21], 0, (0.0, 0.0), 0.0)


def test_what_is_sent_are_the_best_twelve_confirmed_tracks_of_the_region_at_the_capture() -> None:
    tracker = One()
    row = [(10.0 * k, 0.0) for k in range(16)]
    for t_s in (0.0, 0.5, 1.0):
        tracker.look(t_s, boxes(*row))
    tracker.look(1.5, boxes(*row, (0.0, 80.0)))  # the last is tentative
    assert len(content(tracker.tracks, None, (0.0, 0.0), 1.5)) == budget.MAX_TRACKS == 12
    near = content(tracker.tracks, (0.0, 0.0, 25.0), (0.0, 0.0), 1.5)
    assert sorted(near.xy_m[:, 0].round().tolist()) == [0.0, 10.0, 20.0]
    assert len(content(tracker.tracks, (0.0, 80.0, 5.0), (0.0, 0.0), 1.5)) == 0
    moved = content(driving(), None, (0.0, 0.0), 4.0)
    assert moved.xy_m[moved.xy_m[:, 1] < 10.0, 0] == pytest.approx(32.0, abs=0.3)


def test_of_more_than_twelve_tracks_the_surest_are_sent_the_surest_first() -> None:
    tracker = One()
    row = [(10.0 * k, 0.0) for k in range(16)]
    for t_s in (0.0, 0.5, 1.0):
        tracker.look(t_s, boxes(*row))
    score = np.linspace(0.3, 0.9, 16)[np.arange(16) * 5 % 16]
    sent = content(replace(tracker.tracks, score=score), None, (0.0, 0.0), 1.0)
    assert sent.score == pytest.approx(np.sort(score)[:3:-1], abs=0.003)


def test_received_tracks_go_on_and_what_stands_stays() -> None:
    tracks = driving()
    velocity, variance = motion_of(tracks, 1.0)
    np.testing.assert_allclose(velocity, [[8.0, 0.0], [0.0, 0.0]], atol=0.1)
    assert variance[0] > 1.5 * variance[1]
    assert variance[1] == SIGMA0_M**2
    assert (tracks.moves == (np.hypot(*tracks.velocity_mps.T) > MOVES_AT * np.sqrt(tracks.covariance[:, 2]))).all()


@pytest.mark.parametrize("coasts_s", [0.0, 0.4, 1.2])
@pytest.mark.parametrize("age_s", [0.0, 0.3, 0.8])
def test_a_received_track_is_as_certain_as_the_time_since_its_last_box_leaves_it(coasts_s: float, age_s: float) -> None:
    """Coasting at its sender and travelling count alike; and so after its bytes were written and read."""
    n, at = 2, np.full(2, 5.0)
    velocity = np.array([[9.0, -4.0], [0.01, 0.0]])  # one drives, one stands
    sent = Tracks(
        np.zeros(n, np.int64), np.arange(n), at, np.array([[3.0, 4.0], [-8.0, 1.0]]), velocity,
        np.tile([0.16, 0.0, 0.25], (n, 1)), np.tile([4.5, 1.9], (n, 1)), np.zeros(n), np.full(n, 0.8), np.full(n, 5),
        np.full(n, 5), at - coasts_s, np.ones(n, bool),
    )  # fmt: skip
    late_s = coasts_s + age_s
    for tracks in (sent, unpacked(packed(sent, (0.0, 0.0)), 0, (0.0, 0.0), 5.0)):
        moved, variance = motion_of(tracks, age_s)
        assert moved == pytest.approx(np.array([[9.0, -4.0], [0.0, 0.0]]), abs=0.01)
        drives_m2 = SIGMA0_M**2 + 0.25 * late_s**2 + ACCELERATION_DENSITY * late_s**3 / 3
        assert variance == pytest.approx([drives_m2, SIGMA0_M**2], rel=0.03)


def test_late_boxes_take_the_velocity_of_the_receivers_own_track_where_it_was_then() -> None:
    """The car was at 20 m a second before its track's state of 28 m; a box near no track has none."""
    tracks = driving()
    late = boxes((20.3, 0.1), (0.0, 20.2), (-60.0, 0.0))
    velocity, variance = motion_of_boxes(late, 2.5, 1.0, tracks)
    np.testing.assert_allclose(velocity[:2], [[8.0, 0.0], [0.0, 0.0]], atol=0.1)
    assert np.isnan(velocity[2]).all()
    assert np.isnan(variance[2])
    assert variance[0] > variance[1]


def test_a_target_is_followed_while_a_confirmed_track_agrees_with_its_cue() -> None:
    tracks = driving()
    now_s = 3.5
    cue = (28.0, 0.0, 8.0, 0.0)
    assert followed(tracks, {7: cue}, {}, now_s) == {7: 0}
    assert followed(tracks, {7: (28.0, 12.0, 8.0, 0.0)}, {}, now_s) == {}  # the cue is elsewhere
    assert followed(tracks, {7: (0.0, 20.0, 8.0, 0.0)}, {}, now_s) == {}  # a parked car that the target passes
    tentative = driving(looks=2)
    assert followed(tentative, {7: (4.0, 0.0, 8.0, 0.0)}, {}, 0.5) == {}
    # in a bend the place still agrees, so that the track stays the target's; another target does not get it
    bend = (29.0, 1.0, 0.0, 8.0)
    assert followed(tracks, {7: bend}, {}, now_s) == {}
    assert followed(tracks, {3: cue, 7: bend}, {7: 0}, now_s) == {7: 0}
    assert predicted(tracks, 5.5).t_s.tolist() == [5.5, 5.5]
    assert followed(Tracks.empty(), {7: cue}, {7: 0}, now_s) == {}


def test_pairs_of_many_tracks_are_those_of_few(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    xy, places = rng.uniform(0, 60, (80, 2)), rng.uniform(0, 60, (90, 2))
    owner, whose = rng.integers(0, 3, 80), rng.integers(0, 3, 90)
    few = association.gated(xy, np.full(80, 2.0), owner, places, whose, association.GATE)
    monkeypatch.setattr(association, "FEW", 0)
    many = association.gated(xy, np.full(80, 2.0), owner, places, whose, association.GATE)
    assert len(few[0]) > 20
    assert sorted(zip(*(v.tolist() for v in few), strict=True)) == sorted(zip(*(v.tolist() for v in many), strict=True))
