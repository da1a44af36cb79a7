"""Drones' poses, corrected by what several of them see: boxes of one car should lie in one place. Free of torch.

An object pose graph, as CoAlign has it (Lu et al., ICRA 2023), in two dimensions and linear: pose errors are small.
"""

from __future__ import annotations

from collections.abc import Sequence

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
    of = np.repeat(np.arange(n), [len(places) for places in places_m])
    at_m = np.concatenate([np.empty((0, 2)), *places_m])
    i, j = _of_one_car(at_m, of, n)
    slope, apart_m = _slopes(at_m, believed[of]), at_m[i] - at_m[j]
    prior = np.array([POSITION_SIGMA_M**-2, POSITION_SIGMA_M**-2, HEADING_SIGMA_RAD**-2])
    information, seen = np.zeros((n, n, 3, 3)), np.zeros((n, 3))
    information[np.arange(n), np.arange(n)] = np.diag(prior)
    # squares of the differences of n places, over n, are those of their distances from the mean
    weight = 1.0 / (n * BOX_SIGMA_M**2)
    for one, sign in ((i, 1.0), (j, -1.0)):
        np.add.at(seen, of[one], sign * weight * np.einsum("kxa,kx->ka", slope[one], apart_m))
        for other, way in ((i, sign), (j, -sign)):
            np.add.at(
                information, (of[one], of[other]), way * weight * np.einsum("kxa,kxb->kab", slope[one], slope[other])
            )
    errors = np.linalg.solve(information.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n), seen.ravel())
    return np.asarray(believed - errors.reshape(n, 3))


def sure(boxes: Boxes) -> Boxes:
    """The boxes that are matched: of vehicles, so that no person is taken for the car beside it."""
    return boxes.take((boxes.score >= MIN_SCORE) & (boxes.kind != PERSON))


def _of_one_car(at_m: Floats, of: NDArray[np.intp], n: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs (i, j) of places [m, 2] that are taken to be of one car; `of` tells each one's drone, of n.

    Where several are equally near, all of them pair.
    """
    near = KDTree(at_m).query_pairs(GATE_M, output_type="ndarray")
    i, j = near[of[near[:, 0]] != of[near[:, 1]]].T
    away_m = np.linalg.norm(at_m[i] - at_m[j], axis=1)
    nearest_m = np.full((len(of), n), np.inf)  # of each drone's, to each place
    np.minimum.at(nearest_m, (i, of[j]), away_m)
    np.minimum.at(nearest_m, (j, of[i]), away_m)
    nearest = (away_m == nearest_m[i, of[j]]) & (away_m == nearest_m[j, of[i]])
    return i[nearest], j[nearest]


def _slopes(at_m: Floats, poses: Floats) -> Floats:
    """[m, 2, 3]: how places [m, 2] move with the errors of the poses [m, 3] that placed them."""
    x, y = (at_m - poses[:, :2]).T
    one, none = np.ones_like(x), np.zeros_like(x)
    return np.stack([np.stack([one, none, -y], axis=1), np.stack([none, one, x], axis=1)], axis=1)
