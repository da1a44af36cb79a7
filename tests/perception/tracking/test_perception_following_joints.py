"""Who is followed at the very edge of the gates, how late boxes go on, and each class and drone by its own numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sortie.perception.classes import CAR, PERSON, TRUCK
from sortie.perception.lateness import CARS, PEOPLE
from sortie.perception.motion import ACCELERATION_DENSITY, Tracks, grown
from sortie.perception.tracking import following_loops
from sortie.perception.tracking.association import GATE, assigned
from sortie.perception.tracking.following import AGREE, agree_loop, followed, motion_of, motion_of_boxes
from sortie.perception.tracking.tracker import COAST_S, FIRST_SPEED_VARIANCE, PLACE_VARIANCE_M2, step
from sortie.perception.types import Boxes


def tracks(n: int = 1, **changes: Any) -> Tracks:
    """Confirmed tracks at 10 s, seen there and then, that drive east at 8 m/s from the origin."""
    columns: dict[str, Any] = {
        "owner": np.zeros(n, np.int64), "id": np.arange(n), "t_s": np.full(n, 10.0), "xy_m": np.zeros((n, 2)),
        "velocity_mps": np.tile([8.0, 0.0], (n, 1)), "covariance": np.tile([0.3, 0.2, 1.0], (n, 1)), "size_m": np.tile([4.6, 1.9], (n, 1)),
        "yaw_rad": np.zeros(n), "score": np.full(n, 0.8), "hits": np.full(n, 9), "looks": np.full(n, 9), "seen_s": np.full(n, 10.0),
        "confirmed": np.ones(n, bool), "kind": np.zeros(n, np.int8),
    }  # fmt: skip
    return Tracks(**(columns | changes))


def boxes(*xy: tuple[float, float], kind: int = CAR, score: float = 0.8) -> Boxes:
    n = len(xy)
    size = np.tile([4.6, 1.9], (n, 1))
    return Boxes(
        np.array(xy, float).reshape(-1, 2), size, np.zeros(n), np.full(n, score), kind=np.full(n, kind, np.int8)
    )


def test_a_target_is_taken_up_by_place_and_velocity_together() -> None:
    """By the inverse of the whole covariance, the cue's own included: what is ahead and faster agrees better than what is
    ahead and slower."""
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


def test_a_track_that_goes_on_without_a_box_is_no_targets() -> None:
    """Its state is of now, as at every look; when it had a box decides. People are no targets, trucks are."""
    cue = {4: (0.0, 0.0, 8.0, 0.0)}
    for unseen_s, follows in ((COAST_S - 0.01, True), (COAST_S + 0.01, False)):
        assert followed(tracks(seen_s=np.array([10.0 - unseen_s])), cue, {}, 10.0) == ({4: 0} if follows else {})
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
    """A track that coasts moves boxes as one that was just seen; one that stands does not move them, and one of people
    moves as people do."""
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
    """The track's covariance grown over the second between, and the place's own variance by class, add up to the gate."""
    own = tracks(kind=np.array([kind], np.int8))
    for t_s in (9.0, 11.0):
        dt = t_s - 10.0
        there = 0.3 + 2 * dt * 0.2 + 1.0 + ACCELERATION_DENSITY / 3
        for square, known in ((0.98 * GATE, True), (1.02 * GATE, False)):
            off_m = float(np.sqrt(square * (there + PLACE_VARIANCE_M2[kind])))
            velocity, variance = motion_of_boxes(boxes((8.0 * dt, off_m), kind=kind), t_s, 0.1, own)
            assert np.isfinite(velocity).all() == np.isfinite(variance).all() == known
    assert np.isnan(motion_of_boxes(boxes((0.0, 0.0), kind=(kind + 1) % 3), 10.0, 0.1, own)[1]).all()


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
    own = tracks(2, owner=np.array([0, 1]), id=np.array([0, 0]), kind=np.array([PERSON, PERSON], np.int8), velocity_mps=np.zeros((2, 2)))  # fmt: skip
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


def test_two_far_pairs_are_taken_before_one_near_pair() -> None:
    """Something expected that gets no place costs the whole gate: 8 + 1.5 is less than 1 + 9.21."""
    expected, places = np.zeros((2, 2)), np.zeros((2, 2))
    expected[1, 0] = 1.0 + np.sqrt(1.5)
    places[:, 0] = 1.0, -np.sqrt(8.0)
    one = np.zeros(2, np.int64)
    i, j = assigned(expected, np.ones(2), one, places, one)
    assert (i.tolist(), j.tolist()) == ([0, 1], [1, 0])
