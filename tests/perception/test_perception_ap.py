"""AP and overlap against plain shapely, and the bootstrap against explicit resampling."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity

from perception.ap import Matched, average_precision, iou_pairs, match, suppress
from perception.harness.statistics import compare
from perception.types import Boxes

box = st.tuples(
    st.floats(-3, 3), st.floats(-3, 3), st.floats(0.5, 6), st.floats(0.5, 3), st.floats(-7, 7)
)  # x, y, length, width, yaw


def polygon(b: np.ndarray) -> shapely.Polygon:
    flat = shapely.box(-b[2] / 2, -b[3] / 2, b[2] / 2, b[3] / 2)
    return affinity.translate(affinity.rotate(flat, b[4], origin=(0, 0), use_radians=True), b[0], b[1])


def plain_iou(a: np.ndarray, b: np.ndarray) -> float:
    p, q = polygon(a), polygon(b)
    return p.intersection(q).area / p.union(q).area


def plain_ap(frames: list[tuple[Boxes, Boxes]], disc: tuple[float, float, float] | None = None) -> float:
    """The definition, written out: loops, shapely, one threshold at a time."""
    rows, total = [], 0
    for found, truth in frames:
        keep = [k for k in range(len(found)) if disc is None or math.dist(found.xy_m[k], disc[:2]) <= disc[2]]
        cars = [k for k in range(len(truth)) if disc is None or math.dist(truth.xy_m[k], disc[:2]) <= disc[2]]
        total += len(cars)
        for k in sorted(keep, key=lambda k: -found.score[k]):
            ious = {c: plain_iou(found.table()[k], truth.table()[c]) for c in cars}
            best = max(ious, key=lambda c: ious[c], default=None)
            hit = best is not None and ious[best] >= 0.5
            if hit:
                cars.remove(best)
            rows.append((float(found.score[k]), hit))
    points = []
    for level in sorted({score for score, _ in rows}, reverse=True):
        above = [hit for score, hit in rows if score >= level]
        points.append((sum(above) / total, sum(above) / len(above)))
    area, before = 0.0, 0.0
    for k, (recall, _) in enumerate(points):
        area += (recall - before) * max(p for _, p in points[k:])
        before = recall
    return area


def some_frames(seed: int, count: int = 6) -> list[tuple[Boxes, Boxes]]:
    """Truths with noisy detections about them, misses, inventions and tied scores."""
    rng = np.random.Generator(np.random.PCG64(seed))
    frames = []
    for _ in range(count):
        n = int(rng.integers(0, 9))
        xy, size = rng.uniform(-30, 30, (n, 2)), rng.uniform((3.5, 1.6), (5.5, 2.1), (n, 2))
        yaw = rng.uniform(-3, 3, n)
        truth = Boxes(xy, size, yaw, np.ones(n))
        k = np.concatenate([rng.permutation(n)[: n - n // 4], rng.integers(0, n, n // 2) if n else []]).astype(int)
        wild = int(rng.integers(0, 3))
        found = Boxes(
            np.concatenate([xy[k] + rng.normal(0, 0.35, (len(k), 2)), rng.uniform(-30, 30, (wild, 2))]),
            np.concatenate([size[k] * rng.uniform(0.9, 1.1, (len(k), 2)), np.full((wild, 2), (4.5, 1.8))]),
            np.concatenate([yaw[k] + rng.normal(0, 0.1, len(k)), np.zeros(wild)]),
            np.round(rng.random(len(k) + wild), 1),  # so that scores tie
        )
        # ties inside a frame would make the greedy order a matter of taste, so part them there
        frames.append(
            (Boxes(found.xy_m, found.size_m, found.yaw_rad, found.score + 1e-6 * np.arange(len(found))), truth)
        )
    return frames


def ap_of(frames: list[tuple[Boxes, Boxes]], disc: tuple[float, float, float] | None = None) -> float:
    return average_precision([match(f, t, disc) for f, t in frames])


@settings(max_examples=300, deadline=None)
@given(a=box, b=box)
def test_iou_equals_shapely(a: tuple[float, ...], b: tuple[float, ...]) -> None:
    pair = np.array([a]), np.array([b])
    assert iou_pairs(*pair)[0] == pytest.approx(plain_iou(pair[0][0], pair[1][0]), abs=1e-6)


@pytest.mark.parametrize(
    ("b", "expected"),
    [
        ((0, 0, 4, 2, 0), 1.0),
        ((0, 0, 4, 2, math.pi), 1.0),
        ((2, 0, 4, 2, 0), 1 / 3),
        ((0, 0, 2, 4, math.pi / 2), 1.0),
        ((0, 0, 4, 2, math.pi / 2), 4 / 12),
        ((4, 0, 4, 2, 0), 0.0),
        ((0, 0, 2, 1, 0.5), 0.25),
        ((100, 0, 4, 2, 0), 0.0),
    ],
)
def test_iou_of_known_pairs(b: tuple[float, ...], expected: float) -> None:
    assert iou_pairs(np.array([(0, 0, 4, 2, 0)], float), np.array([b], float))[0] == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("disc", [None, (3.0, -2.0, 18.0)])
def test_ap_equals_the_plain_definition(seed: int, disc: tuple[float, float, float] | None) -> None:
    frames = some_frames(seed)
    assert ap_of(frames, disc) == pytest.approx(plain_ap(frames, disc), abs=1e-6)


def test_frame_order_does_not_matter() -> None:
    frames = [(Boxes(f.xy_m, f.size_m, f.yaw_rad, np.round(f.score, 1)), t) for f, t in some_frames(3, 12)]
    value = ap_of(frames)
    for shift in range(1, 12, 3):
        assert ap_of(frames[shift:] + frames[:shift]) == pytest.approx(value, abs=1e-12)


def test_tied_scores_are_one_point_of_the_curve() -> None:
    truth = Boxes(np.zeros((1, 2)), np.array([(4.0, 2.0)]), np.zeros(1), np.ones(1))
    both = Boxes(np.array([(50.0, 0.0), (0.0, 0.0)]), np.tile((4.0, 2.0), (2, 1)), np.zeros(2), np.full(2, 0.7))
    assert ap_of([(both, truth)]) == pytest.approx(0.5)
    assert ap_of([(both.take(np.array([1, 0])), truth)]) == pytest.approx(0.5)


def test_each_truth_is_matched_once_and_to_the_best_remaining() -> None:
    size = np.array([(4.0, 2.0)])
    truth = Boxes(np.array([(0.0, 0.0), (0.8, 0.0)]), size.repeat(2, 0), np.zeros(2), np.ones(2))
    found = Boxes(
        np.array([(0.5, 0.0), (0.6, 0.0), (0.7, 0.0)]), size.repeat(3, 0), np.zeros(3), np.array([0.9, 0.8, 0.7])
    )
    # the first is nearest to the second truth, the second takes what remains, the third finds nothing
    assert match(found, truth).hit.tolist() == [True, True, False]


def test_empty_frames() -> None:
    none = Boxes.empty()
    one = Boxes(np.zeros((1, 2)), np.array([(4.0, 2.0)]), np.zeros(1), np.ones(1))
    assert math.isnan(ap_of([(none, none)]))
    assert math.isnan(ap_of([]))
    assert ap_of([(none, one)]) == 0.0
    assert ap_of([(one, one), (one, none)]) == pytest.approx(0.5)
    assert ap_of([(one, one), (none, none)]) == 1.0


def test_suppression_keeps_the_best_of_each_heap() -> None:
    xy = np.array([(0.0, 0.0), (0.5, 0.0), (20.0, 0.0), (0.2, 0.1), (20.0, 3.0)])
    boxes = Boxes(xy, np.tile((4.0, 2.0), (5, 1)), np.zeros(5), np.array([0.5, 0.9, 0.3, 0.1, 0.8]))
    assert suppress(boxes, 0.15).score.tolist() == [0.9, 0.8, 0.3]
    assert len(suppress(Boxes.empty(), 0.15)) == 0


def test_suppression_leaves_no_overlap_above_the_limit() -> None:
    rng = np.random.Generator(np.random.PCG64(5))
    boxes = Boxes(rng.uniform(-12, 12, (60, 2)), np.tile((4.5, 1.9), (60, 1)), rng.uniform(-3, 3, 60), rng.random(60))
    kept = suppress(boxes, 0.15).table()
    i, j = np.triu_indices(len(kept), 1)
    assert iou_pairs(kept[i], kept[j]).max() <= 0.15
    assert len(kept) > 5


def test_bootstrap_equals_explicit_resampling() -> None:
    frames = some_frames(8, 10)
    a = [match(f, t) for f, t in frames]
    b = [Matched(m.score, m.hit & (np.arange(len(m.hit)) % 3 > 0), m.truths) for m in a]
    found = compare(b, a, draws=200, seed=4)
    from scenarios.streams import stream

    weights = stream(4, 0, (), "ap.bootstrap").multinomial(10, np.full(10, 0.1), size=200)
    gains = []
    for row in weights:
        again_a = [m for m, w in zip(a, row, strict=True) for _ in range(w)]
        again_b = [m for m, w in zip(b, row, strict=True) for _ in range(w)]
        gains.append(average_precision(again_a) - average_precision(again_b))
    assert (found.low, found.high) == pytest.approx(tuple(np.percentile(gains, [2.5, 97.5])), abs=1e-9)
    assert found.delta == pytest.approx(average_precision(a) - average_precision(b))
    assert found.low < found.delta < found.high


def test_bootstrap_of_equals_is_nothing_and_groups_widen_it() -> None:
    a = [match(f, t) for f, t in some_frames(9, 12)]
    same = compare(a, a)
    assert (same.delta, same.low, same.high) == (0.0, 0.0, 0.0)
    b = [Matched(m.score, m.hit & (k % 4 > 0), m.truths) for k, m in enumerate(a)]
    by_group = compare(a + a, b + b, groups=[k % 12 for k in range(24)], seed=1)
    by_frame = compare(a + a, b + b, seed=1)
    assert by_group.high - by_group.low > by_frame.high - by_frame.low


def test_bootstrap_refuses_unequal_frames() -> None:
    with pytest.raises(ValueError, match=r"a has 0 frames and b has 1, must be the same"):
        compare([], [Matched(np.zeros(0), np.zeros(0, bool), 1)])
