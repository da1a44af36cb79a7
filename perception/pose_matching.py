"""Drones' poses, corrected by what several of them see: boxes of one car should lie in one place. Free of torch.

An object pose graph, as CoAlign has it (Lu et al., ICRA 2023), in two dimensions and linear: pose errors are small.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from sortie.perception.classes import PERSON
from sortie.perception.types import Boxes
from sortie.scenarios.schema import Motion

Floats = NDArray[np.float64]

_USUAL = Motion()
POSITION_SIGMA_M, HEADING_SIGMA_RAD = _USUAL.pose_error_m, float(np.radians(_USUAL.heading_error_deg))
"""Standard deviations of pose errors before they are corrected: the defaults of `fleet.motion`."""
BOX_SIGMA_M = 0.5
"""Standard deviation of a box's place along each axis. Values from 0.35 to 0.7 m, tried on the validation split, differ little."""
GATE_M = 2.0
"""Boxes of two drones farther apart are of two cars."""
MIN_SCORE = 0.3
"""Weaker boxes are not matched: too many are of no car."""


def matched_poses(poses: ArrayLike, places_m: Sequence[NDArray[np.floating]]) -> Floats:
    """The poses that fit best to what the drones see, [n, 3] (x, y, yaw).

    Boxes of two drones are of one car where each is the other's nearest and they lie within `GATE_M`. What differs
    is the two drones' pose errors plus the errors of the boxes; the most likely pose errors are taken away. An error that all
    drones have in common stays, as nobody can see it.

    Args:
        poses: [n, 3] x, y, yaw as the drones believe them, ENU.
        places_m: each drone's boxes [m, 2], ENU, placed by those poses.

    Example:
        >>> cars = np.array([[10.0, 0.0], [-20.0, 30.0], [40.0, -50.0]])
        >>> matched_poses([(0, 0, 0), (5, 0, 0)], [cars, cars + [0.3, 0.0]])[:, 0].round(2).tolist()
        [0.05, 4.95]
    """
    believed = np.asarray(poses, np.float64)
    n = len(believed)
    prior = np.tile([POSITION_SIGMA_M**-2, POSITION_SIGMA_M**-2, HEADING_SIGMA_RAD**-2], n)
    information, seen = np.diag(prior), np.zeros(3 * n)
    trees = [KDTree(places) for places in places_m]
    # squares of the differences of n places, over n, are those of their distances from the mean
    weight = 1.0 / (n * BOX_SIGMA_M**2)
    for a, b in combinations(range(n), 2):
        at_a, at_b = _pairs(trees[a], trees[b])
        if not len(at_a):
            continue
        slope = np.concatenate([_slope(at_a, believed[a]), -_slope(at_b, believed[b])], axis=2).reshape(-1, 6)
        of = np.r_[3 * a : 3 * a + 3, 3 * b : 3 * b + 3]
        information[np.ix_(of, of)] += weight * slope.T @ slope
        seen[of] += weight * slope.T @ (at_a - at_b).ravel()
    return np.asarray(believed - np.linalg.solve(information, seen).reshape(n, 3))


def sure(boxes: Boxes) -> Boxes:
    """The boxes that are matched: of vehicles, so that no person is taken for the car beside it."""
    return boxes.take((boxes.score >= MIN_SCORE) & (boxes.kind != PERSON))


def _pairs(a: KDTree, b: KDTree) -> tuple[Floats, Floats]:
    """The places of two drones that are each other's nearest, [k, 2] each."""
    if not a.n or not b.n:
        return np.empty((0, 2)), np.empty((0, 2))
    away_m, nearest = b.query(a.data)
    back = a.query(b.data)[1]
    of_one = (away_m < GATE_M) & (back[nearest] == np.arange(a.n))
    return a.data[of_one], b.data[nearest[of_one]]


def _slope(places_m: Floats, pose: Floats) -> Floats:
    """[k, 2, 3]: how places move with the error of the pose that placed them."""
    x, y = (places_m - pose[:2]).T
    one, none = np.ones_like(x), np.zeros_like(x)
    return np.stack([np.stack([one, none, -y], axis=1), np.stack([none, one, x], axis=1)], axis=1)
