"""Poses corrected by what several drones see: a closed form, errors that are known, and a sortie's detector."""

from __future__ import annotations

import numpy as np
import pytest

from sortie.perception.classes import CAR, PERSON, TRUCK
from sortie.perception.pose_matching import (
    BOX_SIGMA_M,
    GATE_M,
    HEADING_SIGMA_RAD,
    POSITION_SIGMA_M,
    matched_poses,
    sure,
)
from sortie.perception.types import Boxes

RNG = np.random.default_rng(3)
CARS = RNG.uniform(-80, 80, (40, 2))


def placed(cars: np.ndarray, true: np.ndarray, believed: np.ndarray) -> np.ndarray:
    """Where a drone that believes another pose than its true one puts cars."""
    c, s = np.cos(believed[2] - true[2]), np.sin(believed[2] - true[2])
    return believed[:2] + (cars - true[:2]) @ np.array([[c, s], [-s, c]])


def fleet(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """True and believed poses."""
    true = np.column_stack([rng.uniform(-20, 20, (n, 2)), rng.uniform(-3, 3, n)])
    return true, true + rng.normal(0.0, [POSITION_SIGMA_M, POSITION_SIGMA_M, HEADING_SIGMA_RAD], (n, 3))


@pytest.mark.parametrize("n", [2, 3, 5])
def test_what_all_drones_agree_on_is_left_and_what_they_differ_in_goes(n: int) -> None:
    """Without errors of the boxes the corrected poses put every car of every drone in nearly one place."""
    true, believed = fleet(n, np.random.default_rng(n))
    seen = [placed(CARS, *pair) for pair in zip(true, believed, strict=True)]
    fitted = matched_poses(believed, seen)
    again = np.stack([placed(CARS, *pair) for pair in zip(true, fitted, strict=True)])
    spread = [np.abs(each - each.mean(axis=0)).max() for each in (np.stack(seen), again)]
    assert spread[1] < 0.2 * spread[0]
    error = fitted - true
    assert np.abs(error[:, :2].mean(axis=0) - (believed - true)[:, :2].mean(axis=0)).max() < 0.02, "nobody sees it"


def test_two_drones_share_a_shift_by_the_closed_form() -> None:
    """Cars in a ring about both: no turn, and of a difference d each takes its part of the posterior mean."""
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    ring = 40 * np.column_stack([np.cos(angle), np.sin(angle)])
    fitted = matched_poses([(0, 0, 0.4), (0, 0, -0.2)], [ring + np.array([0.3, 0.0]), ring])
    per_drone, per_difference = POSITION_SIGMA_M**2, 2 * BOX_SIGMA_M**2 / len(ring)
    part = 0.3 * per_drone / (2 * per_drone + per_difference)
    np.testing.assert_allclose(fitted, [(-part, 0, 0.4), (part, 0, -0.2)], atol=1e-9)


def test_on_average_errors_of_poses_get_smaller_under_errors_of_boxes() -> None:
    left, before = [], []
    for seed in range(40):
        rng = np.random.default_rng(100 + seed)
        true, believed = fleet(5, rng)
        seen = [placed(CARS, t, b)[rng.random(len(CARS)) < 0.8] for t, b in zip(true, believed, strict=True)]
        noisy = [each + rng.normal(0, 0.4, each.shape) for each in seen]
        error = matched_poses(believed, noisy) - true
        left.append(error)
        before.append(believed - true)
    ratio = np.std(np.stack(left), axis=(0, 1)) / np.std(np.stack(before), axis=(0, 1))
    assert (ratio < 0.75).all(), "five drones' common error is 0.45 of one's"
    assert (ratio > 0.4).all(), "and stays"


def test_nothing_is_corrected_where_nothing_is_matched() -> None:
    nobody = np.empty((0, 2))
    poses = [(1.0, 2.0, 0.3), (4.0, 2.0, 0.1)]
    np.testing.assert_array_equal(matched_poses(poses, [nobody, CARS]), poses)
    np.testing.assert_array_equal(matched_poses(poses[:1], [CARS]), poses[:1])
    far = np.array([[0.0, 0.0]])
    np.testing.assert_array_equal(matched_poses(poses, [far, np.array([[GATE_M + 0.01, 0.0]])]), poses)
    between = np.array([[0.0, 0.0], [1.0, 0.0]])  # the second one's nearest is nearer to the first
    moved = matched_poses(poses, [between[:1], between])
    assert np.array_equal(moved[:, :2], np.array(poses)[:, :2]), "one pair, which agrees"


def test_weak_boxes_and_people_are_not_matched() -> None:
    """A detector of one's own may find people; a truck is a car to the network."""
    kind = np.array([CAR, CAR, TRUCK, PERSON], np.int8)
    boxes = Boxes(CARS[:4], np.ones((4, 2)), np.zeros(4), np.array([0.31, 0.29, 0.5, 0.9]), kind=kind)
    assert sure(boxes).xy_m.tolist() == CARS[[0, 2]].tolist()


def test_boxes_move_with_their_drones_pose() -> None:
    old, new = (3.0, -2.0, 0.5), (3.4, -2.5, 0.52)
    local = RNG.uniform(-50, 50, (6, 2))
    boxes = Boxes(placed(local, np.zeros(3), np.array(old)), np.ones((6, 2)), np.arange(6.0), np.ones(6))
    moved = boxes.moved(old, new)
    np.testing.assert_allclose(moved.xy_m, placed(local, np.zeros(3), np.array(new)), atol=1e-4)
    np.testing.assert_allclose(moved.yaw_rad, np.arange(6) + 0.02, atol=1e-6)
    assert boxes.moved(old, old) is boxes


@pytest.mark.parametrize("n", [1, 2, 4, 12])
def test_it_is_what_least_squares_over_pairs_found_one_by_one_give(n: int) -> None:
    """Poses far from the origin; some drones see nothing."""
    rng = np.random.default_rng(n)
    poses = np.column_stack([5000.0 + rng.uniform(-40, 40, (n, 2)), rng.uniform(-3, 3, n)])
    cars = 5000.0 + rng.uniform(-50, 50, (25, 2))
    places = [cars[rng.random(25) < 0.6] if k % 4 != 3 else cars[:0] for k in range(n)]
    places = [each + rng.normal(0.0, 0.5, each.shape) for each in places]
    sigmas = np.tile([POSITION_SIGMA_M, POSITION_SIGMA_M, HEADING_SIGMA_RAD], n)
    rows, right = [*np.diag(1.0 / sigmas)], [0.0] * (3 * n)
    for a in range(n):
        for b in range(a + 1, n):
            for p in places[a]:
                for q in places[b]:
                    is_nearest = all(np.hypot(*(p - o)) >= np.hypot(*(p - q)) for o in places[b])
                    is_nearest &= all(np.hypot(*(q - o)) >= np.hypot(*(p - q)) for o in places[a])
                    if is_nearest and np.hypot(*(p - q)) < GATE_M:
                        for axis in range(2):
                            row = np.zeros((n, 3))
                            for drone, place, sign in ((a, p, 1.0), (b, q, -1.0)):
                                row[drone, axis] = sign
                                turn = place - poses[drone, :2]
                                row[drone, 2] = sign * (-turn[1], turn[0])[axis]
                            rows.append(row.ravel() / (BOX_SIGMA_M * np.sqrt(n)))
                            right.append((p - q)[axis] / (BOX_SIGMA_M * np.sqrt(n)))
    assert len(rows) > 3 * n + 20 or n == 1
    errors = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0].reshape(n, 3)
    np.testing.assert_allclose(matched_poses(poses, places), poses - errors, rtol=0, atol=1e-9)
