"""HOTA against cases worked out by hand, and against a plain program that follows TrackEval step by step."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from sortie.perception.classes import CAR, TRUCK
from sortie.perception.metrics.hota import Followed, Hota, hota
from sortie.perception.metrics.overlap import iou_pairs

Sequence = list[tuple[dict[int, NDArray[np.float64]], dict[int, NDArray[np.float64]]]]
"""Frame by frame: the cars' boxes by identity, and the tracks'."""


def car(x_m: float, y_m: float = 0.0) -> NDArray[np.float64]:
    return np.array([x_m, y_m, 4.0, 2.0, 0.0])


def flat(sequences: list[Sequence], which: int) -> Followed:
    rows = [
        (box, 1000 * s + f, 1000 * s + identity)
        for s, frames in enumerate(sequences)
        for f, frame in enumerate(frames)
        for identity, box in frame[which].items()
    ]
    if not rows:
        return Followed(np.zeros((0, 5)), *np.zeros((2, 0), np.int64), np.zeros(0, np.int8))
    boxes, frame_of, who = zip(*rows, strict=True)
    return Followed(np.array(boxes), np.array(frame_of), np.array(who), np.full(len(who), CAR, np.int8))


def judged(*sequences: Sequence) -> Hota:
    value = hota(flat(list(sequences), 0), flat(list(sequences), 1))
    assert value is not None
    return value


@pytest.mark.parametrize(
    ("frames", "hota_", "det_a", "ass_a"),
    [
        ([({0: car(0)}, {5: car(0)})] * 4, 1.0, 1.0, 1.0),
        # the identity changes after two of four frames: each box's association is 2 of 4
        ([({0: car(0)}, {5: car(0)})] * 2 + [({0: car(0)}, {6: car(0)})] * 2, np.sqrt(0.5), 1.0, 0.5),
        # found in two of four frames: 2 of 4 detected, 2 of 4 associated
        ([({0: car(0)}, {5: car(0)})] * 2 + [({0: car(0)}, {})] * 2, 0.5, 0.5, 0.5),
        # a track that goes on elsewhere: two of six boxes and cars are right, and 2 of 6 in the pair
        ([({0: car(0)}, {5: car(0)})] * 2 + [({0: car(0)}, {5: car(50)})] * 2, 1 / 3, 1 / 3, 1 / 3),
        # shifted by half its length: IoU 1/3, so right at 0.05 … 0.30, six limits of nineteen
        ([({0: car(0)}, {5: car(2)})] * 3, 6 / 19, 6 / 19, 6 / 19),
        ([({0: car(0)}, {})], 0.0, 0.0, 0.0),
        ([({0: car(0)}, {5: car(90)})], 0.0, 0.0, 0.0),
    ],
)
def test_cases_by_hand(frames: Sequence, hota_: float, det_a: float, ass_a: float) -> None:
    assert judged(frames) == pytest.approx((hota_, det_a, ass_a))


def test_the_pair_that_fits_over_the_whole_sequence_is_matched_though_another_overlaps_more() -> None:
    """In the last frame a stray track lies exactly on the car; the car's own, near it, keeps it (TrackEval's global score)."""
    frames: Sequence = [({0: car(0)}, {5: car(0.2)})] * 9
    frames = [*frames, ({0: car(0)}, {5: car(0.2), 6: car(0.0)})]
    # IoU 3.8 / 4.2 = 0.905, right at 18 limits: ten of eleven boxes, and all ten of one track
    assert judged(frames)[1:] == pytest.approx((18 / 19 * 10 / 11, 18 / 19))


def test_the_order_of_a_frame_s_boxes_does_not_matter() -> None:
    """Two tracks lie on one car all the time: one of them is the car's in all frames, in whatever order they are listed."""
    frames: Sequence = [({0: car(0)}, {6 - k % 2: car(0), 5 + k % 2: car(0)}) for k in range(8)]
    assert judged(frames) == judged([(there, dict(sorted(told.items()))) for there, told in frames])
    assert judged(frames).ass_a == pytest.approx(1.0)


def test_a_track_of_another_class_on_a_car_is_a_miss_and_a_false_positive() -> None:
    """Two vehicles are followed in full, the second as what it is not: one hit of three."""
    frames: Sequence = [({0: car(0), 1: car(50)}, {5: car(0), 6: car(50)})] * 4
    there, told = flat([frames], 0), flat([frames], 1)
    trucks = told._replace(kind=np.where(told.identity == 6, TRUCK, CAR).astype(np.int8))
    value = hota(there, trucks)
    assert value is not None
    assert (value.det_a, value.ass_a) == pytest.approx((1 / 3, 1.0))
    right = hota(there._replace(kind=np.where(there.identity == 1, TRUCK, CAR).astype(np.int8)), trucks)
    assert right == pytest.approx((1.0, 1.0, 1.0))


def test_no_car_has_no_hota() -> None:
    frames: Sequence = [({}, {5: car(0)})]
    assert hota(flat([frames], 0), flat([frames], 1)) is None


def plainly(sequences: list[Sequence]) -> tuple[float, float, float]:
    """TrackEval's `HOTA.eval_sequence` and `combine_sequences`, with whole tables and loops."""
    alphas = np.arange(0.05, 0.99, 0.05)
    right, missed, false, associated = (np.zeros(len(alphas)) for _ in range(4))
    for frames in sequences:
        cars = sorted({i for truth, _ in frames for i in truth})
        tracks = sorted({i for _, told in frames for i in told})
        overlaps = []
        potential = np.zeros((len(cars), len(tracks)))
        car_count, track_count = np.zeros((len(cars), 1)), np.zeros((1, len(tracks)))
        for truth, told in frames:
            a, b = [cars.index(i) for i in truth], [tracks.index(i) for i in told]
            table = np.zeros((len(a), len(b)))
            for i, box in enumerate(truth.values()):
                for j, other in enumerate(told.values()):
                    table[i, j] = iou_pairs(box[None], other[None])[0]
            whole = table.sum(0)[None] + table.sum(1)[:, None] - table
            share = np.zeros_like(table)
            share[whole > 0] = table[whole > 0] / whole[whole > 0]
            potential[np.ix_(a, b)] += share
            car_count[a] += 1
            track_count[0, b] += 1
            overlaps.append((a, b, table))
        alignment = potential / (car_count + track_count - potential)
        matches = [np.zeros_like(potential) for _ in alphas]
        for a, b, table in overlaps:
            rows, columns = linear_sum_assignment(-alignment[np.ix_(a, b)] * table)
            for k, alpha in enumerate(alphas):
                good = table[rows, columns] >= alpha - np.finfo(float).eps
                right[k] += good.sum()
                missed[k] += len(a) - good.sum()
                false[k] += len(b) - good.sum()
                for r, c in zip(rows[good], columns[good], strict=True):
                    matches[k][a[r], b[c]] += 1
        for k, count in enumerate(matches):
            associated[k] += (count * count / np.maximum(1, car_count + track_count - count)).sum()
    det_a, ass_a = right / np.maximum(1, right + missed + false), associated / np.maximum(1, right)
    return float(np.sqrt(det_a * ass_a).mean()), float(det_a.mean()), float(ass_a.mean())


@pytest.mark.parametrize("seed", range(8))
def test_it_is_what_a_plain_program_has(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sequences: list[Sequence] = []
    for _ in range(3):
        frames: Sequence = []
        at = rng.uniform(0, 18, (6, 2))
        swap = np.arange(6)
        for _ in range(12):
            at = at + rng.normal(0, 0.5, at.shape)
            if rng.random() < 0.3:
                swap = rng.permutation(swap)
            truth = {i: car(*at[i]) for i in range(6) if rng.random() < 0.9}
            told = {int(swap[i]): car(*(at[i] + rng.normal(0, 0.6, 2))) for i in range(6) if rng.random() < 0.8}
            told |= {9: car(*rng.uniform(0, 18, 2))} if rng.random() < 0.5 else {}
            frames.append((truth, told))
        sequences.append(frames)
    assert judged(*sequences) == pytest.approx(plainly(sequences), abs=1e-12)
