"""How much a late box or map is still worth: a declared model of what cars do while data travel. Free of torch.

A box of age a is off by a normal error along each axis. Its variance is σ0² where the car stands, and σ0² + (v · a)² where
it moves; a share m of the cars moves. The parameters were fitted on the calibration's towns by
`research/validation/joining_age.py`, which holds the plan and prints the fit. People have parameters of their own, which are assumptions.

Two figures follow. A box's score is multiplied by the chance that it still covers its car (`still_right`). Its place, and a
map's weight, count by the inverse of their variance (`precision`). Both are relative to the freshest look at hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit

from sortie.perception.classes import NEAR_M, PERSON
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.frames import instant

Floats = NDArray[np.float64]

SIGMA0_M = 0.35
"""Standard deviation of a fresh box's place, along each axis."""
SPEED_MPS = 5.9
"""Speed of the cars that move."""
MOVING = 0.45
"""Share of the boxes whose cars move."""


class Movement(NamedTuple):
    """How a class of targets moves: numbers, or one of each for every box."""

    sigma0_m2: Floats | float
    """Variance of a fresh box's place, along each axis."""
    speed_mps: Floats | float
    """Speed of those that move."""
    moving: Floats | float
    """Share of those that move."""


CARS = Movement(SIGMA0_M**2, SPEED_MPS, MOVING)
PEOPLE = Movement(1.0, 1.4, 0.9)
"""Assumptions, not fitted: the default error of a thermal camera's places, and a walking speed."""
_BY_CLASS = Movement(*(np.array(v) for v in zip(CARS, CARS, PEOPLE, strict=True)))  # trucks drive as cars do


def movement(kind: NDArray[np.integer]) -> Movement:
    """How boxes of these classes move; of cars alone it is the same for all."""
    return Movement(*(v[kind] for v in _BY_CLASS)) if kind.any() else CARS  # type: ignore[index]


def variance_m2(age_s: ArrayLike, of: Movement = CARS) -> Floats:
    """Variance of a box's place along each axis at an age, over all of its class: σ0² + m (v · a)²."""
    return of.sigma0_m2 + of.moving * (of.speed_mps * np.asarray(age_s, np.float64)) ** 2


def moving_m2(age_s: ArrayLike, of: Movement = CARS) -> Floats:
    """The same for one that moves: σ0² + (v · a)²."""
    return of.sigma0_m2 + (of.speed_mps * np.asarray(age_s, np.float64)) ** 2


def map_weight(age_s: float, freshest_s: float) -> float:
    """What a map of an age counts beside one of the freshest age: the inverse ratio of their variances, at most 1."""
    return min(float(variance_m2(freshest_s) / variance_m2(age_s)), 1.0)


def own_age_s(ego: Capture, shares: Sequence[Share]) -> float:
    """The age of an ego's own look at the fusion, from the ages of what it received; 0 where they are not given."""
    now_s = min((s.capture.t_s + s.age_s for s in shares), default=ego.t_s)
    return max(0.0, now_s - ego.t_s)


def weighed(ego: Capture, shares: Sequence[Share]) -> list[Share]:
    """The shares with the weights at which their maps are fused: a late one counts by `map_weight` beside the ego's own.

    Beside the freshest one where the ego has no look of its own. Boxes stay as they are.
    """
    freshest_s = own_age_s(ego, shares) if ego.looked else min((s.age_s for s in shares), default=0.0)
    return [
        s._replace(weight=s.weight * map_weight(s.age_s, freshest_s))
        if s.is_map and instant(s.age_s) > instant(freshest_s)
        else s
        for s in shares
    ]


def stands(off_m: Floats, apart_s: Floats, of: Movement = CARS) -> Floats:
    """The chance that a car stands, from two boxes of it that lie `off_m` apart and were seen `apart_s` apart, [n].

    Boxes of a standing car differ by 2 σ0² along each axis, those of a moving car by (v · apart)² more.
    """
    still = 2.0 * of.sigma0_m2
    moved = still + (of.speed_mps * apart_s) ** 2
    log_odds = np.log((1.0 - of.moving) / of.moving * moved / still) - off_m**2 / 2.0 * (1.0 / still - 1.0 / moved)
    return np.asarray(expit(log_odds), np.float64)


def reach_m(size_m: NDArray[np.floating]) -> Floats:
    """How far off boxes [n, 2] (length, width) may lie and still have an IoU of 0.5, [n].

    A shift along a car reaches that at a third of its length, a shift across it at a third of its width. This is the
    geometric mean of both.
    """
    return np.asarray(np.sqrt(size_m.prod(axis=-1, dtype=np.float64)) / 3.0)


def reach_of(boxes: Boxes) -> Floats:
    """How far off boxes may lie and still match what they are of, [n]: people by `NEAR_M`, vehicles as `reach_m`."""
    reach = reach_m(boxes.size_m)
    return np.where(boxes.kind == PERSON, NEAR_M, reach) if boxes.kind.any() else reach


def still_right(reach_m: ArrayLike, age_s: ArrayLike, of: Movement = CARS) -> Floats:
    """The chance that a box which was right when it was made still is, at an age: 1 at age 0."""
    reach, age = np.asarray(reach_m, np.float64), np.asarray(age_s, np.float64)
    late = within(reach, moving_m2(age, of))
    return np.asarray(1.0 - of.moving + of.moving * late / within(reach, of.sigma0_m2))


def still_right_of(reach_m: ArrayLike, variance_m2: ArrayLike, of: Movement = CARS) -> Floats:
    """The same for a box with a known variance of its place; at most 1."""
    return np.minimum(within(reach_m, variance_m2) / within(reach_m, of.sigma0_m2), 1.0)


def within(reach_m: ArrayLike, variance_m2: ArrayLike) -> Floats:
    """The chance that a place with this variance along each axis is off by less than `reach_m` (Rayleigh)."""
    ratio = np.asarray(reach_m, np.float64) ** 2 / (2.0 * np.asarray(variance_m2, np.float64))
    return np.asarray(-np.expm1(-ratio))
