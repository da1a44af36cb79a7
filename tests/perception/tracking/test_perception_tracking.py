"""The tracker: a filter written with matrices, the best assignment, and a track's life number by number."""

from __future__ import annotations

from itertools import permutations
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from track_examples import tracks
from wrong_rows import wrong_rows

from sortie.perception.classes import CAR, PERSON, TRUCK
from sortie.perception.metrics.assignment import least_cost
from sortie.perception.motion import ACCELERATION_DENSITY, Tracks, grown
from sortie.perception.tracking import association
from sortie.perception.tracking.association import GATE, assigned
from sortie.perception.tracking.tracker import (
    BOX_VARIANCE_M2,
    COAST_S,
    FIRST_SPEED_VARIANCE,
    PLACE_VARIANCE_M2,
    SPEED_VARIANCE,
    step,
)
from sortie.perception.types import Boxes

Floats = NDArray[np.float64]


def boxes(*xy_m: tuple[float, float], kind: int = CAR, score: float = 0.8) -> Boxes:
    n = len(xy_m)
    return Boxes(
        np.array(xy_m).reshape(n, 2),
        np.tile([4.6, 1.9], (n, 1)),
        np.zeros(n),
        np.full(n, score),
        kind=np.full(n, kind, np.int8),
    )


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
    for k, (turn_rad, off_rad) in enumerate([(0.0, 0.0), (np.pi, 0.2), (-np.pi, 0.0), (2 * np.pi, -0.3)]):
        seen = boxes((0.0, 0.0))
        seen.yaw_rad[:] = yaw_rad + turn_rad + off_rad
        tracker.look(0.5 * k, seen)
        yaw_rad += off_rad / (k + 1)
        assert tracker.tracks.yaw_rad == pytest.approx([yaw_rad])


def test_a_track_told_for_an_earlier_time_is_no_more_certain_than_for_a_later_one() -> None:
    """Place and velocity drift apart with either sign of time; their covariance alone has its sign."""
    still = np.array([[1.0, 0.0, 4.0]])
    (pp, pv, vv), ((back_pp, back_pv, back_vv),) = grown(still, np.array([0.6]))[0], grown(still, np.array([-0.6]))
    assert (back_pp, back_pv, back_vv) == (pp, -pv, vv)
    assert vv == pytest.approx(4.0 + 0.6 * ACCELERATION_DENSITY)


def test_the_assignment_is_the_best_of_all() -> None:
    def check(seed: int) -> None:
        rng = np.random.default_rng(seed)
        cost, free = rng.uniform(0, 12, (4, 5)), 9.0
        i, j = np.nonzero(cost < free)
        taken = least_cost(i, j, cost[i, j], np.zeros(len(i), np.int64), free)
        capped = np.minimum(cost, free)
        best = min(sum(capped[r, c] for r, c in enumerate(p)) for p in permutations(range(5), 4))
        assert len(set(i[taken])) == len(set(j[taken])) == taken.sum()
        assert cost[i, j][taken].sum() + free * (4 - taken.sum()) == pytest.approx(best)

    assert wrong_rows(range(20), check) == {}


def test_two_far_pairs_are_taken_before_one_near_pair() -> None:
    """Something expected that gets no place costs the whole gate: 8 + 1.5 is less than 1 + 9.21."""
    expected, places = np.zeros((2, 2)), np.zeros((2, 2))
    expected[1, 0] = 1.0 + np.sqrt(1.5)
    places[:, 0] = 1.0, -np.sqrt(8.0)
    one = np.zeros(2, np.int64)
    i, j = assigned(expected, np.ones(2), one, places, one)
    assert (i.tolist(), j.tolist()) == ([0, 1], [1, 0])


def test_pairs_of_many_tracks_are_those_of_few(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    xy, places = rng.uniform(0, 60, (80, 2)), rng.uniform(0, 60, (90, 2))
    owner, whose = rng.integers(0, 3, 80), rng.integers(0, 3, 90)
    few = association.gated(xy, np.full(80, 2.0), owner, places, whose, association.GATE)
    monkeypatch.setattr(association, "FEW", 0)
    many = association.gated(xy, np.full(80, 2.0), owner, places, whose, association.GATE)
    assert len(few[0]) > 20
    assert sorted(zip(*(v.tolist() for v in few), strict=True)) == sorted(zip(*(v.tolist() for v in many), strict=True))


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


# --- number by number -----------------------------------------------------------------------------------


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


def look(before: Tracks, seen: Boxes, owner: list[int], looks_s: list[float], next_id: list[int]) -> Any:
    return step(before, seen, np.array(owner, np.int64), np.array(looks_s), np.array(next_id, np.int64))


def test_the_first_box_of_a_class_begins_with_the_uncertainty_of_that_class() -> None:
    for kind in (CAR, TRUCK, PERSON):
        begun, _, _ = look(Tracks.empty(), boxes((3.0, 4.0), kind=kind), [0], [1.0], [0])
        np.testing.assert_array_equal(begun.covariance, [[PLACE_VARIANCE_M2[kind], 0.0, FIRST_SPEED_VARIANCE[kind]]])
    assert PLACE_VARIANCE_M2[PERSON] != PLACE_VARIANCE_M2[CAR]


@pytest.mark.parametrize("kind", [CAR, TRUCK, PERSON])
def test_a_box_counts_and_is_gated_by_the_variance_of_its_class(kind: int) -> None:
    own = tracks(kind=np.array([kind], np.int8), velocity_mps=np.zeros((1, 2)))
    total = 0.3 + PLACE_VARIANCE_M2[kind]
    for square, same in ((0.98 * GATE, True), (1.02 * GATE, False)):
        off_m = float(np.sqrt(square * total))
        after, _, of_box = look(own, boxes((off_m, 0.0), kind=kind), [0], [10.0], [1])
        assert of_box.tolist() == [0 if same else 1]
        if same:
            assert after.xy_m[0, 0] == pytest.approx(0.3 / total * off_m)
            assert after.covariance[0, 0] == pytest.approx(0.3 * PLACE_VARIANCE_M2[kind] / total)


def test_a_box_is_never_of_another_drones_track_nor_of_another_class() -> None:
    """All in one place: only owner and class tell the three tracks and the boxes apart."""
    walk = dict(kind=np.array([PERSON, PERSON], np.int8), velocity_mps=np.zeros((2, 2)))
    own = tracks(2, owner=np.array([0, 1]), id=np.array([0, 0]), **walk)
    for drone in (0, 1):
        for kind in (CAR, TRUCK, PERSON):
            _, _, of_box = look(own, boxes((0.0, 0.0), kind=kind), [drone], [10.0, 10.0], [5, 6])
            assert of_box.tolist() == [0 if kind == PERSON else 5 + drone]


def test_every_drone_counts_its_own_tracks() -> None:
    """Numbers ascend in the order of a drone's boxes, whoever else has boxes between; a weak box takes no number."""
    seen = Boxes.join([boxes((0.0, 0.0), (50.0, 0.0), (90.0, 0.0)), boxes((0.0, 70.0), score=0.2), boxes((0.0, 30.0))])
    begun, after, of_box = look(Tracks.empty(), seen, [1, 0, 1, 0, 0], [1.0, 1.0, np.nan], [4, 8, 2])
    assert of_box.tolist() == [8, 4, 9, -1, 5]
    assert after.tolist() == [6, 10, 2]
    assert begun.owner.tolist() == [1, 0, 1, 0]
