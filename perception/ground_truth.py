"""Ground truth: which cars a drone should find. One rule for sorties, evaluation, training and calibration. Free of torch."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sortie.perception.geometry import FULL, in_square
from sortie.perception.types import Boxes


def ground_truth(
    cars: NDArray[np.floating],
    pose: ArrayLike,
    half_extent_m: float = FULL.half_extent_m,
    identity: NDArray[np.integer] | None = None,
) -> Boxes:
    """The cars whose centres lie in the square about a drone's true pose; scores are 1.

    Every such car counts, also one that no drone could see.

    Args:
        cars: [n, 5] x, y, length, width, yaw, ENU; rows of NaN are padding and do not count.
        pose: x, y, yaw of the drone.
        half_extent_m: from the drone to each edge of the square.
        identity: [n] which car each is; None where nobody knows.
    """
    here = in_square(cars[:, :2], np.asarray(pose)[None], half_extent_m)[:, 0]  # comparing NaN gives False
    cars = cars[here]
    which = None if identity is None else identity[here].astype(np.int32)
    return Boxes(cars[:, :2], cars[:, 2:4], cars[:, 4], np.ones(len(cars), cars.dtype), which)  # type: ignore[arg-type]
