"""How uncertain a box's place is: a covariance for each box, by its score and its distance from the drone. Free of torch.

A box's error has two axes: along the sight from the drone to the box, and across it. The slope of a view and the height of
a car act along it, an error of the heading across it. The standard deviation of each follows from the score and the
distance; `training/box_errors.py` fits both to a detector's own errors.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sortie.perception.errors import InputError

Floats = NDArray[np.float64]
Pose = tuple[float, float, float]
TERMS = 5
_FARTHEST_M = 150.0
_LEAST_M, _MOST_M = 0.05, 5.0
"""Bounds of a standard deviation, for scores and distances at which nothing was fitted."""


@dataclass(frozen=True, slots=True)
class BoxErrors:
    """The standard deviations of a detector's places, as the logarithm of metres: Σ coefficient × term."""

    along: tuple[float, ...]
    """[5] of the error along the sight: the coefficients of `terms`."""
    across: tuple[float, ...]
    """[5] across it."""
    common: float = 1.0
    """The share of a variance that is common to the boxes of several drones for one car, 0 … 1. 1: nobody knows."""

    def deviations_m(self, score: NDArray[np.floating], distance_m: NDArray[np.floating]) -> Floats:
        """[n, 2] along and across, of boxes with these scores at these distances over ground."""
        logs = terms(score, distance_m) @ np.array([self.along, self.across]).T
        return np.asarray(np.clip(np.exp(logs), _LEAST_M, _MOST_M))

    def covariances_m2(
        self, xy_m: NDArray[np.floating], score: NDArray[np.floating], pose: Pose
    ) -> NDArray[np.float32]:
        """[n, 3] east, east–north and north variance of each box's place, rounded as it is sent.

        Args:
            xy_m: [n, 2] places of the boxes, ENU.
            score: [n] their scores.
            pose: estimated x, y, yaw of the drone that saw them, ENU.

        Example:
            >>> flat = BoxErrors((-1.0, 0, 0, 0, 0), (-2.0, 0, 0, 0, 0))
            >>> found = flat.covariances_m2(np.array([[50.0, 0.0]]), np.array([0.5]), (0.0, 0.0, 1.0))
            >>> [round(float(v), 3) for v in found[0]]
            [0.135, 0.0, 0.018]
        """
        x, y = (xy_m[:, k].astype(np.float64) - pose[k] for k in (0, 1))
        distance = np.hypot(x, y)
        along, across = (self.deviations_m(score, distance) ** 2).T
        # below the drone no sight has a direction over ground: both count alike
        c, s = x / np.maximum(distance, 1e-9), y / np.maximum(distance, 1e-9)
        below = distance < 1e-9
        along = np.where(below, (along + across) / 2, along)
        across = np.where(below, along, across)
        c = np.where(below, 1.0, c)
        parts = c * c * along + s * s * across, c * s * (along - across), s * s * along + c * c * across
        return np.stack(parts, axis=1).astype(np.float32)


def terms(score: NDArray[np.floating], distance_m: NDArray[np.floating]) -> Floats:
    """[n, 5] what the logarithm of a standard deviation is a sum of: 1, score, its square, distance, its square.

    The score counts as a logit, 0 at a score of 0.5; the distance in hundreds of metres, at most 150 m.
    """
    p = np.clip(np.asarray(score, np.float64), 0.02, 0.98)
    logit, far = np.log(p / (1.0 - p)), np.minimum(np.asarray(distance_m, np.float64), _FARTHEST_M) / 100.0
    return np.stack([np.ones_like(logit), logit, logit * logit, far, far * far], axis=1)


def errors_text(errors: BoxErrors, facts: dict[str, Any]) -> str:
    """The text of the file that `load_errors` reads; `facts` is about its making."""
    numbers = {name: [round(v, 6) for v in getattr(errors, name)] for name in ("along", "across")}
    return json.dumps(numbers | {"common": round(errors.common, 4), "made": facts}, indent=1) + "\n"


def load_errors(path: Path, weights: str) -> BoxErrors:
    """The errors of a detector's boxes.

    Raises:
        InputError: no such file, or not one of these, naming it.
    """
    if not path.is_file():
        raise InputError(
            f"{path}: nobody fitted how uncertain the boxes of {weights} are; `python -m research fit errors` does, or send detections"
        )
    try:
        read = json.loads(path.read_text("utf-8"))
        axes = [tuple(float(v) for v in read[name]) for name in ("along", "across")]
        found = BoxErrors(axes[0], axes[1], float(read["common"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not a file of box errors ({error!r})") from None
    for name in ("along", "across"):
        value = getattr(found, name)
        if len(value) != TERMS or not all(math.isfinite(v) for v in value):
            raise InputError(f"{path}: {name} is {list(value)}, must be {TERMS} finite numbers")
    if not 0.0 <= found.common <= 1.0:
        raise InputError(f"{path}: common is {found.common}, must be in [0, 1]")
    return found
