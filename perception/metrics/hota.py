"""HOTA, higher order tracking accuracy: how well cars are detected (DetA) and keep their identity (AssA). Free of torch.

J. Luiten et al., *HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking*, IJCV 129, 2021, as their program
TrackEval works it out. The similarity of a track's box and a car is their rotated IoU on the ground, as for AP. Only boxes
of one class match.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sortie.perception.metrics.assignment import least_cost
from sortie.perception.metrics.overlap import overlapping
from sortie.scenarios import scratch

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
    kind: NDArray[np.int8]
    """[n] its class, as `TargetClass`."""

    def by_frame(self) -> Followed:
        """The same, frame by frame, and by identity in each: the order of a frame's boxes does not decide between equals."""
        order = np.lexsort((self.identity, self.frame))
        return Followed(self.boxes[order], self.frame[order], self.identity[order], self.kind[order])


def hota(cars: Followed, tracks: Followed) -> Hota | None:
    """HOTA over all sequences together, as TrackEval combines them; None without a car."""
    return hota_of([(cars, tracks)])


_PAIR = np.dtype(
    [("i", "i8"), ("j", "i8"), ("frame", "i8"), ("car", "i8"), ("track", "i8"), ("iou", "f8"), ("share", "f8")]
)
"""A car and a track box of one frame and one class that overlap."""


def hota_of(blocks: Iterable[tuple[Followed, Followed]]) -> Hota | None:
    """The same of cars and tracks that come in blocks of frames, each after all frames of the block before."""
    tape, sizes = scratch.Tape(), []
    car_count = track_count = np.zeros(0, np.int64)
    for cars, tracks in blocks:
        pairs = _pairs(cars.by_frame(), tracks.by_frame())
        car_count, track_count = _counted(car_count, cars.identity), _counted(track_count, tracks.identity)
        tape.append(pairs.tobytes())
        sizes.append(len(pairs))
    if not car_count.sum():
        return None
    kept = tape.finish()

    def each_block() -> Iterator[NDArray[np.void]]:
        at = 0
        for size in sizes:
            if size:
                yield np.frombuffer(kept, _PAIR, size, at)
            at += size * _PAIR.itemsize
            scratch.release()

    width = max(len(track_count), 1)
    known = np.zeros(0, np.int64)  # which cars and tracks ever overlap
    for pairs in each_block():
        known = np.union1d(known, pairs["car"] * width + pairs["track"])
    fit = np.zeros(len(known))  # how far each car and each track fit together over the whole sequence
    for pairs in each_block():
        np.add.at(fit, _place(known, pairs, width), pairs["share"])
    counts = (car_count[known // width] + track_count[known % width]).astype(np.float64)
    alignment = fit / (counts - fit)
    hits = np.zeros((len(ALPHAS), len(known)), np.int64)
    for pairs in each_block():
        place, iou = _place(known, pairs, width), np.ascontiguousarray(pairs["iou"])
        taken = least_cost(pairs["i"], pairs["j"], -alignment[place] * iou, pairs["frame"], 0.0)
        reached, matched = iou[taken], place[taken]
        for k, alpha in enumerate(ALPHAS):
            hits[k] += np.bincount(matched[reached >= alpha - _EPS], minlength=len(known))
    return _of_hits(hits, counts, int(car_count.sum() + track_count.sum()))


def _pairs(cars: Followed, tracks: Followed) -> NDArray[np.void]:
    """Those of a block, and the share of each in what overlaps with its two boxes."""
    first = min(cars.frame.min(initial=np.iinfo(np.int64).max), tracks.frame.min(initial=np.iinfo(np.int64).max))
    i, j, iou = overlapping(cars.boxes, tracks.boxes, cars.frame - first, tracks.frame - first)
    some = (iou > 0.0) & (cars.kind[i] == tracks.kind[j])
    i, j, iou = i[some], j[some], iou[some]
    total = np.bincount(i, iou, len(cars.frame))[i] + np.bincount(j, iou, len(tracks.frame))[j] - iou
    pairs = np.empty(len(i), _PAIR)
    columns = i, j, cars.frame[i], cars.identity[i], tracks.identity[j], iou, iou / total
    for name, values in zip(_PAIR.names or (), columns, strict=True):
        pairs[name] = values
    return pairs


def _counted(count: Ints, identity: Ints) -> Ints:
    """Boxes by identity, with some more."""
    more = np.bincount(identity, minlength=len(count))
    more[: len(count)] += count
    return more


def _place(known: Ints, pairs: NDArray[np.void], width: int) -> Ints:
    return np.asarray(np.searchsorted(known, pairs["car"] * width + pairs["track"]))


def _of_hits(hits: Ints, counts: Floats, boxes: int) -> Hota:
    """From the hits of each car and track at each of `ALPHAS`, and their boxes."""
    det_a, ass_a = np.zeros(len(ALPHAS)), np.zeros(len(ALPHAS))
    for k, own in enumerate(hits.astype(np.float64)):
        right = own.sum()
        det_a[k] = right / max(1.0, boxes - right)
        ass_a[k] = (own * own / np.maximum(1.0, counts - own)).sum() / max(1.0, right)
    return Hota(float(np.sqrt(det_a * ass_a).mean()), float(det_a.mean()), float(ass_a.mean()))
