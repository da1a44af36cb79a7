"""How much a late box is still worth: the parameters of `sortie.perception.joining.LATENESS`, fitted on calibration towns.

The plan, committed before anything was measured:

- Model. A box of age a is off by a normal error along each axis, with variance sigma0² where the car stands and
  sigma0² + (speed · a)² where it moves; a share `moving` of the cars moves. A box counts (IoU 0.5) while it is off by less
  than r = √(length · width) / 3: a shift along a car reaches IoU 0.5 at a third of its length, one across it at a third of
  its width, and r is their geometric mean. So a box of age a is right, relative to a fresh one, with probability
  F(a) = ((1 − moving) · P(0) + moving · P(a)) / P(0), with P(a) = 1 − exp(−r² / (2 σ²(a))).
- Fit. Maximum likelihood of `speed`, `moving` and `sigma0` on single drones' boxes: whether a box found at t is still
  right (its best free truth, IoU ≥ 0.5) at t + a, among those that were right at t. Towns of the calibration's `fit` split;
  ages 0.1 … 2 s; the surrogate's boxes, all moments from fixed draws. No town of the library, of a set of conditions
  or of the `held-out` split is in it.
- Check, with the parameters fixed: on the `held-out` split, AP of every rung at every age against leaving it out.

One thing was changed after the first fit. `sigma0` cannot be read from boxes that were right when they were made (the
likelihood fell to zero and was flat), so it is measured: the root mean square, over both axes, of how far off right boxes
lie at age 0. `speed` and `moving` are fitted with it.

    python -m research.validation.joining_age     # prints the fit, half a minute
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit

from research.calibrate import plan
from sortie.perception.lateness import reach_m, within
from sortie.perception.metrics.ap import match
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.scenarios.schema import Perception

AGES_S = (0.1, 0.2, 0.3, 0.5, 0.8, 1.2, 2.0)
SEED = 1
TOWNS = 40

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Kept:
    """Boxes that were right when they were made, once for every age."""

    age_s: Floats
    """[n]"""
    reach_m: Floats
    """[n] as in the plan."""
    right: NDArray[np.bool_]
    """[n] whether it still is."""
    off_m: Floats
    """[n, 2] how far off it lay when it was made."""


def observed(towns: Iterable[int], ages_s: Sequence[float] = AGES_S) -> Kept:
    """Every right box of five drones alone, in both moments of each calibration town, at every age."""
    rows: list[tuple[Floats, Floats, NDArray[np.bool_], Floats]] = []
    for town in towns:
        scene = plan.scene_model(SEED, "fit", town)
        detector = SurrogateDetector(scene, Perception(detector="surrogate"), town)
        for index in range(len(plan.MANNERS)):
            egos = [job.ego for job in plan.moment(SEED, "fit", town, index) if not job.shares]
            for ego, boxes in zip(egos, detector.detect([(ego, ()) for ego in egos]), strict=True):
                truth = detector.truth(ego.t_s, ego)
                boxes = boxes.take(match(boxes, truth).hit)
                away = boxes.xy_m[:, None].astype(np.float64) - truth.xy_m[None]
                off = away[np.arange(len(boxes)), np.hypot(*away.T).T.argmin(axis=1)]
                for age_s in ages_s:
                    right = match(boxes, detector.truth(ego.t_s + age_s, ego)).hit
                    rows.append((np.full(len(boxes), age_s), reach_m(boxes.size_m), right, off))
    age, reach, right, off = (np.concatenate(column) for column in zip(*rows, strict=True))
    return Kept(age, reach, right, off)


def chance(reach: Floats, age_s: Floats, sigma0_m: float, speed_mps: float, moving: float) -> Floats:
    """F of the plan: how likely a box that was right still is."""
    late = within(reach, sigma0_m**2 + (speed_mps * age_s) ** 2)
    return 1 - moving + moving * late / within(reach, sigma0_m**2)


class Fit(NamedTuple):
    """The three parameters."""

    sigma0_m: float
    speed_mps: float
    moving: float


def fitted(kept: Kept) -> Fit:
    """`sigma0_m` as measured, and the other two by maximum likelihood."""
    sigma0 = float(np.sqrt((kept.off_m**2).mean()))

    def loss(raw: Floats) -> float:
        p = chance(kept.reach_m, kept.age_s, sigma0, np.exp(raw[0]), float(expit(raw[1])))
        return -float(np.where(kept.right, np.log(p), np.log1p(-p)).mean())

    speed, moving = minimize(loss, np.array([np.log(8.0), 0.0]), method="Nelder-Mead").x
    return Fit(sigma0, float(np.exp(speed)), float(expit(moving)))


if __name__ == "__main__":
    kept = observed(range(TOWNS))
    found = fitted(kept)
    say = sys.stdout.write
    say(f"sigma0 {found.sigma0_m:.3f} m, speed {found.speed_mps:.2f} m/s, moving {found.moving:.3f}\n")
    for age_s in AGES_S:
        at = kept.age_s == age_s
        model = chance(kept.reach_m[at], kept.age_s[at], *found).mean()
        say(f"{age_s:4.1f} s: {kept.right[at].mean():.3f} still right, model {model:.3f}, {at.sum()} boxes\n")
