"""HOTA by hand and against a program after TrackEval; the bootstrap against explicit resampling."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from wrong_rows import wrong_rows

from sortie.perception.classes import CAR, TRUCK
from sortie.perception.metrics.ap import Matched, average_precision
from sortie.perception.metrics.bootstrap import compare, rank
from sortie.perception.metrics.hota import Followed, Hota, hota
from sortie.perception.metrics.overlap import iou_pairs
from sortie.scenarios.intervals import benjamini_hochberg, p_value, percentile_interval, resamples

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


def test_the_order_of_a_frame_s_boxes_does_not_matter() -> None:
    """Two tracks lie on one car all the time: one of them is the car's in all frames, however they are listed."""
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


def test_it_is_what_a_plain_program_has() -> None:
    def check(seed: int) -> None:
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

    assert wrong_rows(range(8), check) == {}


def units(seed: int, count: int, quality: float = 0.7, found: int = 40, per_score: int = 1000) -> list[Matched]:
    """Frames whose detections are right the more often the higher they score; scores tie if `per_score` is small."""
    rng = np.random.Generator(np.random.PCG64(seed))
    out = []
    for _ in range(count):
        n = int(rng.integers(0, found))
        score = -np.sort(-np.floor(rng.random(n) * per_score) / per_score)
        out.append(Matched(score, rng.random(n) < quality * score, int(rng.integers(n // 2, n + 3))))
    return out


def again(frames: list[Matched], weights: np.ndarray, groups: list[int]) -> float:
    """AP of the resample written out: every frame as often as its group was drawn."""
    labels = sorted(set(groups))
    return average_precision(
        [f for f, g in zip(frames, groups, strict=True) for _ in range(int(weights[labels.index(g)]))]
    )


@pytest.mark.parametrize("per_score", [5, 100_000])
def test_draws_equal_explicit_resampling(per_score: int) -> None:
    frames, groups = units(1, 30, per_score=per_score), [k // 3 for k in range(30)]
    weights = resamples(10, 50, seed=4)
    assert weights.sum(axis=1).tolist() == [10] * 50
    draws = rank(frames, groups, bins=0).ap(weights)
    assert draws == pytest.approx([again(frames, row, groups) for row in weights], abs=1e-12)


def test_bins_cost_less_than_a_tenth_of_a_point() -> None:
    frames, groups = units(2, 200, found=150, per_score=10**6), [k // 5 for k in range(200)]
    weights = resamples(40, 300)
    exact, binned = rank(frames, groups, bins=0), rank(frames, groups)
    assert binned.hits.shape[1] < 2100 < exact.hits.shape[1]
    assert binned.hits.sum(axis=1).tolist() == exact.hits.sum(axis=1).tolist()
    assert binned.ap(weights) == pytest.approx(exact.ap(weights), abs=1e-3)
    assert binned.ap(weights).mean() == pytest.approx(exact.ap(weights).mean(), abs=2e-4)
    assert binned.ap(np.ones((1, 40)))[0] == pytest.approx(average_precision(frames), abs=1e-12)


def test_the_paired_interval_is_that_of_explicit_resampling() -> None:
    a = units(3, 12)
    b = [Matched(m.score, m.hit & (np.arange(len(m.hit)) % 3 > 0), m.truths) for m in a]
    found = compare(b, a, draws=200, seed=4)
    gains = [again(a, row, list(range(12))) - again(b, row, list(range(12))) for row in resamples(12, 200, 4)]
    assert (found.low, found.high) == pytest.approx(tuple(np.percentile(gains, [2.5, 97.5])), abs=1e-9)
    assert found.delta == pytest.approx(average_precision(a) - average_precision(b))
    assert found.low < found.delta < found.high
    assert found.p == pytest.approx(p_value(np.array(gains)))


def test_nothing_differs_from_itself_and_groups_widen() -> None:
    a = units(5, 12)
    same = compare(a, a)
    assert (same.delta, same.low, same.high, same.p) == (0.0, 0.0, 0.0, 1.0)
    b = [Matched(m.score, m.hit & (k % 4 > 0), m.truths) for k, m in enumerate(a)]
    by_group = compare(a + a, b + b, groups=[k % 12 for k in range(24)], seed=1)
    by_frame = compare(a + a, b + b, seed=1)
    assert by_group.high - by_group.low > by_frame.high - by_frame.low


def test_a_single_frame_or_group_has_no_interval() -> None:
    a, b = units(5, 4), units(6, 4)
    for found in (compare(a[:1], b[:1]), compare(a, b, groups=[7] * 4)):
        assert math.isfinite(found.delta)
        assert all(math.isnan(v) for v in (found.low, found.high, found.p))


def test_compare_refuses_unequal_frames() -> None:
    with pytest.raises(ValueError, match=r"a has 0 frames and b has 1, must be the same"):
        compare([], [Matched(np.zeros(0), np.zeros(0, bool), 1)])


def test_labels_may_be_anything_that_sorts() -> None:
    frames = units(6, 9)
    by_name = rank(frames, list("abcabcabc"), bins=0)
    by_number = rank(frames, [7, 8, 9] * 3, bins=0)
    assert np.array_equal(by_name.hits, by_number.hits)
    assert by_name.truths.tolist() == [sum(f.truths for f in frames[k::3]) for k in range(3)]


def test_nothing_to_find_and_nothing_found() -> None:
    none = Matched(np.zeros(0), np.zeros(0, bool), 0)
    cars = Matched(np.zeros(0), np.zeros(0, bool), 3)
    wrong = Matched(np.array([0.5]), np.zeros(1, bool), 0)
    assert np.isnan(rank([none, none]).ap(resamples(2, 5))).all()
    assert np.isnan(rank([wrong]).ap(np.ones((1, 1)))).all()
    assert rank([cars, none], [0, 0]).ap(np.ones((3, 1))).tolist() == [0, 0, 0]
    assert math.isnan(rank([cars, wrong]).ap(np.array([[0.0, 1.0]]))[0])
    many = Matched(np.linspace(1, 0, 5000), np.zeros(5000, bool), 3)
    assert rank([many]).ap(np.ones((1, 1)))[0] == 0
    assert rank([]).ap(np.zeros((2, 0))).shape == (2,)


@pytest.mark.slow
def test_the_interval_covers_the_truth_as_often_as_it_says() -> None:
    """200 experiments of 40 frames each, five alike egos a frame; the true AP from 10,000 frames."""

    def experiment(seed: int, frames: int) -> list[Matched]:
        rng = np.random.Generator(np.random.PCG64(seed))
        out = []
        for _ in range(frames):
            quality = rng.uniform(0.3, 1.0)  # a frame is easy or hard as a whole, for all of its egos
            for _ in range(5):
                score = -np.sort(-rng.random(8))
                out.append(Matched(score, rng.random(8) < quality * score, 5))
        return out

    real = average_precision(experiment(10**6, 10_000))
    by_frame = by_ego = 0
    for seed in range(200):
        sample = experiment(seed, 40)
        weights = resamples(40, 200, seed)
        low, high = percentile_interval(rank(sample, np.repeat(np.arange(40), 5), bins=60).ap(weights))
        by_frame += low <= real <= high
        low, high = percentile_interval(rank(sample, bins=60).ap(resamples(200, 200, seed)))
        by_ego += low <= real <= high
    assert 0.87 <= by_frame / 200 <= 0.99
    assert by_ego < by_frame - 15, "egos of one frame are not independent, and taking them for it is overconfident"


def test_p_of_known_draws() -> None:
    assert p_value(np.arange(1.0, 1000.0)) == pytest.approx(2 / 1000)
    assert p_value(np.concatenate([np.full(25, -1.0), np.full(974, 1.0)])) == pytest.approx(2 * 26 / 1000)
    assert p_value(np.zeros(99)) == 1.0
    assert p_value(np.array([1.0, np.nan, 1.0])) == pytest.approx(2 / 3)


@given(st.lists(st.floats(0.001, 1), min_size=1, max_size=20))
def test_benjamini_hochberg_by_its_definition(p: list[float]) -> None:
    adjusted = benjamini_hochberg(p)
    by = sorted(range(len(p)), key=lambda i: p[i])
    for place, i in enumerate(by):
        expected = min(min(1.0, p[j] * len(p) / (later + 1)) for later, j in enumerate(by) if later >= place)
        assert adjusted[i] == pytest.approx(expected)
    assert benjamini_hochberg([]) == []
