"""HOTA, higher order tracking accuracy: how well cars are detected (DetA) and keep their identity (AssA). Free of torch.

J. Luiten et al., *HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking*, IJCV 129, 2021, as their program
TrackEval works it out. The similarity of a track's box and a car is their rotated IoU on the ground, as for AP.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sortie.perception.metrics.assignment import least_cost
from sortie.perception.metrics.overlap import overlapping

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

ALPHAS = np.arange(1, 20) / 20.0
"""The similarities from which a box counts as a car's: 0.05, 0.10 … 0.95."""
_EPS = float(np.finfo(float).eps)


class Hota(NamedTuple):
    """Means over `ALPHAS`, 0 … 1."""

    hota: float
    """Mean of √(DetA · AssA) at each."""
    det_a: float
    ass_a: float


class Followed(NamedTuple):
    """Boxes of many frames with identities: cars that were there, or what a tracker says is there."""

    boxes: Floats
    """[n, 5] x, y, length, width, yaw."""
    frame: Ints
    """[n] the frame of each, ≥ 0; a frame is one sequence's at one moment."""
    identity: Ints
    """[n] whose box it is, ≥ 0; no two sequences share one, and no two boxes of a frame."""

    def by_frame(self) -> Followed:
        """The same, frame by frame."""
        order = np.argsort(self.frame, kind="stable")
        return Followed(self.boxes[order], self.frame[order], self.identity[order])


def hota(cars: Followed, tracks: Followed) -> Hota | None:
    """HOTA over all sequences together, as TrackEval combines them; None without a car."""
    cars, tracks = cars.by_frame(), tracks.by_frame()
    if not len(cars.frame):
        return None
    i, j, similarity = overlapping(cars.boxes, tracks.boxes, cars.frame, tracks.frame)
    some = similarity > 0.0
    return hota_of_pairs(cars, tracks, i[some], j[some], similarity[some])


def hota_of_pairs(cars: Followed, tracks: Followed, i: Ints, j: Ints, similarity: Floats) -> Hota:
    """The same from the similarities > 0 of cars i and track boxes j; all other pairs have none."""
    n, m = len(cars.frame), len(tracks.frame)
    width = int(tracks.identity.max(initial=-1)) + 1
    both = cars.identity[i] * max(width, 1) + tracks.identity[j]
    pairs, pair = np.unique(both, return_inverse=True)
    car_count, track_count = np.bincount(cars.identity), np.bincount(tracks.identity, minlength=1)
    counts = (car_count[pairs // max(width, 1)] + track_count[pairs % max(width, 1)]).astype(np.float64)
    # how far each car and each track fit together over the whole sequence
    total = np.bincount(i, similarity, n)[i] + np.bincount(j, similarity, m)[j] - similarity
    fit = np.bincount(pair, similarity / total, len(pairs))
    alignment = fit / (counts - fit)
    taken = least_cost(i, j, -alignment[pair] * similarity, cars.frame[i], 0.0)
    reached, matched = similarity[taken], pair[taken]
    det_a, ass_a = np.zeros(len(ALPHAS)), np.zeros(len(ALPHAS))
    for k, alpha in enumerate(ALPHAS):
        hits = np.bincount(matched[reached >= alpha - _EPS], minlength=len(pairs)).astype(np.float64)
        right = hits.sum()
        det_a[k] = right / max(1.0, n + m - right)
        ass_a[k] = (hits * hits / np.maximum(1.0, counts - hits)).sum() / max(1.0, right)
    return Hota(float(np.sqrt(det_a * ass_a).mean()), float(det_a.mean()), float(ass_a.mean()))
