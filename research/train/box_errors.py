"""Fit how uncertain a detector's boxes are, by score and distance, and measure whether that is right. Free of torch."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from sortie.perception.errors import InputError
from sortie.perception.joining import NMS_IOU
from sortie.perception.metrics.ap import best_pairs, paired
from sortie.perception.metrics.overlap import overlapping
from sortie.perception.types import Boxes
from sortie.perception.uncertainty import TERMS, BoxErrors, Floats, Pose, terms

FEWEST = 100


class Errors(NamedTuple):
    """Localisation errors of n boxes of one drone at one moment that lie on a car."""

    car: NDArray[np.intp]
    """Which of the moment's cars each lies on."""
    score: Floats
    distance_m: Floats
    """From the drone to the box over ground, as the drone estimates it."""
    sight: Floats
    """[n, 2] the direction from the drone to the box, ENU."""
    off_m: Floats
    """[n, 2] from the car's true place to the box, ENU."""

    @property
    def by_sight_m(self) -> Floats:
        """[n, 2] the error along the sight and across it."""
        (c, s), (x, y) = self.sight.T, self.off_m.T
        return np.stack([c * x + s * y, c * y - s * x], axis=1)


Moment = Sequence[Errors]
"""The errors of each drone."""


def errors_of(boxes: Boxes, pose: Pose, cars: NDArray[np.floating]) -> Errors:
    """The errors of one drone's boxes, best first, each matched to the best car left that it overlaps by more than 0.15.

    That overlap is also what joins the boxes of several drones. An error holds the drone's own error of pose.

    Args:
        boxes: in the world, as the drone places them.
        pose: its estimated x, y, yaw.
        cars: [m, 5] x, y, length, width, yaw of every car; rows of NaN are padding.
    """
    real = np.asarray(cars[~np.isnan(cars[:, 0])], np.float64)
    i, j, value = overlapping(
        boxes.table(), real, np.zeros(len(boxes), np.int64), np.zeros(len(real), np.int64), "rotated"
    )
    order = best_pairs(boxes.table()[i], boxes.score[i], real[j], value)
    order = order[value[order] > NMS_IOU]
    order = order[paired(i[order], j[order])]
    box_of, car_of = i[order], j[order]
    at = boxes.xy_m[box_of].astype(np.float64)
    sight = at - np.array(pose[:2])
    distance = np.hypot(*sight.T)
    return Errors(
        car_of,
        boxes.score[box_of].astype(np.float64),
        distance,
        sight / np.maximum(distance, 1e-9)[:, None],
        at - real[car_of, :2],
    )


def fit(moments: Sequence[Moment]) -> BoxErrors:
    """The most likely standard deviations, if errors are normal about zero, and the part that drones have in common.

    Raises:
        InputError: fewer than a hundred errors.
    """
    score, distance, off = _together(moments)
    if len(score) < FEWEST:
        raise InputError(f"{len(score)} boxes lie on a car, must be at least {FEWEST}")
    x = terms(score, distance)
    along, across = (tuple(_most_likely(x, axis * axis).tolist()) for axis in off.T)
    alone = BoxErrors(along, across)
    return BoxErrors(along, across, common(alone, moments))


def _most_likely(x: Floats, square: Floats) -> Floats:
    """The coefficients of the logarithm of a standard deviation, from terms [n, 5] and squared errors [n]."""

    def loss(c: Floats) -> tuple[float, Floats]:
        log = x @ c
        part = square * np.exp(-2.0 * log)
        return float(np.mean(log + part / 2.0)), x.T @ (1.0 - part) / len(part)

    start = np.zeros(TERMS)
    start[0] = np.log(square.mean()) / 2.0
    return np.asarray(minimize(loss, start, jac=True, method="BFGS").x, np.float64)


def common(model: BoxErrors, moments: Sequence[Moment]) -> float:
    """The correlation of two drones' errors for one car, over all pairs of drones, 0 … 1; errors count in deviations."""
    product = square = 0.0
    for moment in moments:
        scaled = []
        for one in moment:
            deviation = np.sqrt((model.deviations_m(one.score, one.distance_m) ** 2).mean(axis=1))
            scaled.append(dict(zip(one.car.tolist(), one.off_m / deviation[:, None], strict=True)))
        for a, b in combinations(scaled, 2):
            for car in a.keys() & b.keys():
                product += float(a[car] @ b[car])
                square += float(a[car] @ a[car] + b[car] @ b[car]) / 2.0
    return min(max(product / square, 0.0), 1.0) if square else 1.0


@dataclass(frozen=True, slots=True)
class Calibration:
    """How often errors lie within their standard deviations.

    Of normal errors 68.3 % and 95.4 % do, and 39.3 % and 86.5 % lie within the ellipses of both axes.
    """

    boxes: int
    within: tuple[float, float]
    """Of the errors along the sight and across it, the share within 1 and 2 standard deviations."""
    within_ellipse: tuple[float, float]
    """Of the boxes, the share within the ellipses of 1 and 2 standard deviations."""


def calibration(model: BoxErrors, moments: Sequence[Moment], where: Callable[[Errors], NDArray[np.bool_]] | None = None) -> Calibration:  # fmt: skip
    """The calibration of fitted deviations on other errors, or on those of them that `where` picks."""
    score, distance, off = _together(moments, where)
    ratio = np.abs(off / model.deviations_m(score, distance))
    far = np.hypot(*ratio.T)
    return Calibration(
        len(far),
        (float(np.mean(ratio <= 1.0)), float(np.mean(ratio <= 2.0))),
        (float(np.mean(far <= 1.0)), float(np.mean(far <= 2.0))),
    )


def _together(
    moments: Iterable[Moment], where: Callable[[Errors], NDArray[np.bool_]] | None = None
) -> tuple[Floats, Floats, Floats]:
    """Score [n], distance [n] and error by the sight [n, 2] of all boxes."""
    parts = [
        (e.score[k], e.distance_m[k], e.by_sight_m[k])
        for moment in moments
        for e in moment
        for k in [slice(None) if where is None else where(e)]
    ]
    score, distance, off = (np.concatenate(several) for several in zip(*parts, strict=True))
    return score, distance, off
