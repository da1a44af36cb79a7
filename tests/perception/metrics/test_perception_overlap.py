"""Overlap against exact clipping of polygons, in fractions; suppression and matching against plain loops."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from overlap_examples import box, exact_iou, plain_iou, polygon
from wrong_rows import wrong_rows

from sortie.perception.classes import CAR, PERSON, TRUCK
from sortie.perception.metrics import ap
from sortie.perception.metrics.ap import best_first, hits, iou_pairs, match, suppress, suppressed
from sortie.perception.metrics.overlap import near_pairs, overlapping
from sortie.perception.types import Boxes

little = st.one_of(
    st.just(0.0), st.tuples(st.sampled_from([1.0, -1.0]), st.floats(-17, -6)).map(lambda e: e[0] * 10 ** e[1])
)


pairs = st.one_of(
    st.tuples(box, box),
    st.tuples(box, st.tuples(*[little] * 5)).map(lambda pair: (pair[0], tuple(map(sum, zip(*pair, strict=True))))),
)


@settings(max_examples=300, deadline=None)
@given(pair=pairs)
@example(pair=((0, 0, 6, 3, -2.3215356402153233), (0, 3.1e-16, 6, 3, -2.3215356402153233)))  # empty for shapely
@example(pair=((0, 0, 4.5, 1.9, 0), (-1e-9, -1e-9, 4.5, 1.9, 0)))
def test_iou_equals_exact_clipping(pair: tuple[tuple[float, ...], tuple[float, ...]]) -> None:
    a, b = (np.array([each], float) for each in pair)
    assert iou_pairs(a, b)[0] == pytest.approx(plain_iou(a[0], b[0]), abs=1e-12)
    assert iou_pairs(b, a)[0] == pytest.approx(plain_iou(a[0], b[0]), abs=1e-12)


def test_edges_that_coincide() -> None:
    rows = product(
        [0.0, 0.3, math.pi / 2, math.pi, 1e-10, -1e-8], [0.0, math.pi / 2, math.pi, 1e-12, -1e-10, 1e-9, 1e-6]
    )

    def check(turn: float, twist: float) -> None:
        c, s = math.cos(turn), math.sin(turn)
        at = [
            (u, v, *size)
            for u in (0, 1, 2.5, 4, 4.0000000001)
            for v in (0, 0.5, 1.0000000001, 2, -2)
            for size in ((4, 2), (2, 1), (4, 1))
        ]
        b = np.array(
            [(7 + c * u - s * v, 9 + s * u + c * v, length, width, turn + twist) for u, v, length, width in at]
        )
        a = np.tile((7.0, 9.0, 4.0, 2.0, turn), (len(b), 1))
        assert iou_pairs(a, b) == pytest.approx([plain_iou(p, q) for p, q in zip(a, b, strict=True)], abs=1e-12)
        assert iou_pairs(b, a) == pytest.approx(iou_pairs(a, b), abs=1e-12)

    assert wrong_rows(rows, check) == {}


@settings(max_examples=100, deadline=None)
@given(a=box, b=box)
def test_axis_aligned_overlap_is_of_the_hulls(a: tuple[float, ...], b: tuple[float, ...]) -> None:
    p, q = polygon(np.array(a)).envelope, polygon(np.array(b)).envelope
    _, _, value = overlapping(np.array([a]), np.array([b]), kind="axis-aligned")
    assert (value[0] if len(value) else 0.0) == pytest.approx(exact_iou(p, q), abs=1e-12)


def crowd(seed: int, images: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes that crowd one another, with their images and scores, in the order of `best_first`."""
    rng = np.random.Generator(np.random.PCG64(seed))
    n = int(rng.integers(0, 400))
    boxes = rng.uniform((-15, -15, 3.5, 1.6, -4), (15, 15, 5, 2.1, 4), (n, 5))
    image, score = rng.integers(0, images, n), np.round(rng.random(n), 2)
    order = best_first(boxes, score, image)
    return boxes[order], image[order], score[order]


def test_near_pairs_are_brute_forces() -> None:
    a, of_a, _ = crowd(1)
    b, of_b, _ = crowd(2)
    i, j = near_pairs(a, b, of_a, of_b)
    reach = 0.5 * (np.hypot(*a[:, 2:4].T)[:, None] + np.hypot(*b[:, 2:4].T))
    apart = np.hypot(*(a[:, None, :2] - b[None, :, :2]).transpose(2, 0, 1))
    expected = np.argwhere((apart <= reach) & (of_a[:, None] == of_b))
    assert sorted(zip(i.tolist(), j.tolist(), strict=True)) == [tuple(row) for row in expected.tolist()]
    assert len(expected) > 100
    assert [len(x) for x in near_pairs(a, b[:0], of_a, of_b[:0])] == [0, 0]


# --- suppression and matching -----------------------------------------------------------------------------


def test_suppression_of_many_images_is_the_loop_over_boxes() -> None:
    def check(seed: int) -> None:
        boxes, image, _ = crowd(seed)
        keep: list[int] = []
        for k in range(len(boxes)):
            rivals = [j for j in keep if image[j] == image[k]]
            if not rivals or iou_pairs(boxes[rivals], np.repeat(boxes[k : k + 1], len(rivals), 0)).max() <= 0.15:
                keep.append(k)
        assert np.flatnonzero(suppressed(boxes, np.arange(len(boxes)), image, 0.15)).tolist() == keep

    assert wrong_rows(range(8), check) == {}


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 11), st.integers(0, 7), st.sampled_from([0.5, 0.6, 0.7, 0.8])), max_size=40),
    st.lists(st.sampled_from([0.1, 0.2, 0.3]), min_size=12, max_size=12),
    st.sampled_from(["remaining", "first"]),
)
def test_matching_in_rounds_is_the_loop_over_pairs(
    pairs: list[tuple[int, int, float]], scores: list[float], rule: str
) -> None:
    unique = sorted({(-scores[i], -v, i, j) for i, j, v in {(i, j): (i, j, v) for i, j, v in pairs}.values()})
    open_i, open_j, expected = set(range(12)), set(range(8)), [False] * 12
    for *_, i, j in unique:
        if i in open_i and j in open_j:
            expected[i] = True
            open_j.remove(j)
            open_i.remove(i)
        elif rule == "first":
            open_i.discard(i)
    i, j = (np.array([pair[k] for pair in unique], int) for k in (2, 3))
    assert hits(12, i, j, rule).tolist() == expected


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_a_threshold_after_is_a_threshold_before(seed: int, tau: float) -> None:
    """Suppression and matching go best first, so what is below τ changes nothing above it."""
    rng = np.random.Generator(np.random.PCG64(seed))
    truth = Boxes(rng.uniform(-12, 12, (9, 2)), np.tile((4.5, 1.9), (9, 1)), rng.uniform(-3, 3, 9), np.ones(9))
    near = rng.integers(0, 9, 60)
    found = Boxes(
        truth.xy_m[near] + rng.normal(0, 1, (60, 2)),
        truth.size_m[near],
        truth.yaw_rad[near],
        np.round(rng.random(60), 1),
    )
    after = match(suppress(found, 0.15), truth).at(tau)
    before = match(suppress(found.take(found.score >= tau), 0.15), truth)
    assert after.score.tolist() == before.score.tolist()
    assert after.hit.tolist() == before.hit.tolist()


def boxes(rng: np.random.Generator, count: int) -> Boxes:
    """Of all classes; crowded, so that detections compete; scores in tenths, so that they tie."""
    xy = rng.uniform(-5, 5, (count, 2)).astype(np.float32)
    size = np.tile(np.float32([4.5, 1.9]), (count, 1))
    yaw = rng.uniform(-0.1, 0.1, count).astype(np.float32)
    kind = rng.choice(np.int8([CAR, CAR, CAR, TRUCK, PERSON]), count)
    return Boxes(xy, size, yaw, (rng.integers(0, 10, count) / 10).astype(np.float32), kind=kind)


def test_frame_by_frame_or_all_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def check(batch: int) -> None:
        monkeypatch.setattr(ap, "MATCH_BATCH", batch)
        rng = np.random.default_rng(4)
        found = [boxes(rng, n) for n in (30, 0, 12, 0, 45, 1, 20)]
        truth = [boxes(rng, n) for n in (25, 3, 0, 0, 30, 1, 18)]
        many = ap.match_many(found, truth)
        assert sum(m.hit.sum() for m in many) > 20
        for one, f, t in zip(many, found, truth, strict=True):
            alone = ap.match(f, t)
            assert one.score.tolist() == alone.score.tolist()
            assert one.hit.tolist() == alone.hit.tolist()
            assert one.truths == alone.truths
        assert ap.match_many([], []) == []

    assert wrong_rows([1, 3, 64], check) == {}
