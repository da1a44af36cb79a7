"""The bootstrap against explicit resampling and against repeated experiments; p-values; the correction for many."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sortie.perception.metrics.ap import Matched, average_precision
from sortie.perception.metrics.bootstrap import compare, rank
from sortie.scenarios.intervals import benjamini_hochberg, p_value, percentile_interval, resamples


def units(seed: int, count: int, quality: float = 0.7, found: int = 40, per_score: int = 1000) -> list[Matched]:
    """Matched frames whose detections are right the more often the higher they score; scores tie if `per_score` is small."""
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


@pytest.mark.slow
def test_p_values_of_no_difference_are_even() -> None:
    """Two conditions that are equally good: p below 0.1 in about a tenth of the experiments."""
    p = []
    for seed in range(100):
        a, b = units(2 * seed, 25), units(2 * seed + 1, 25)
        truths = [Matched(m.score, m.hit, 25) for m in a], [Matched(m.score, m.hit, 25) for m in b]
        p.append(compare(*truths, draws=150, seed=seed).p)
    assert 0.03 <= np.mean(np.array(p) < 0.1) <= 0.19
    assert 0.35 <= np.mean(np.array(p) < 0.5) <= 0.65


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
