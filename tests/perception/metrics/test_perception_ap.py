"""Overlap against exact clipping of shapely's polygons, AP against its definition, and in the field's conventions against
pycocotools."""

import contextlib
import io
import math
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from shapely import affinity

from sortie.perception.classes import CAR, PERSON, TRUCK
from sortie.perception.metrics.ap import (
    CONVENTIONS,
    Convention,
    Matched,
    average_precision,
    best_first,
    hits,
    iou_pairs,
    match,
    match_many,
    suppress,
    suppressed,
)
from sortie.perception.metrics.overlap import near_pairs, overlapping
from sortie.perception.types import Boxes
from sortie.scenarios.disc import Disc

box = st.tuples(
    st.floats(-3, 3), st.floats(-3, 3), st.floats(0.5, 6), st.floats(0.5, 3), st.floats(-7, 7)
)  # x, y, length, width, yaw


def polygon(b: np.ndarray) -> shapely.Polygon:
    flat = shapely.box(-b[2] / 2, -b[3] / 2, b[2] / 2, b[3] / 2)
    return affinity.translate(affinity.rotate(flat, b[4], origin=(0, 0), use_radians=True), b[0], b[1])


def plain_iou(a: np.ndarray, b: np.ndarray) -> float:
    return exact_iou(polygon(a), polygon(b))


def exact_iou(p: shapely.Polygon, q: shapely.Polygon) -> float:
    """IoU of two convex polygons by clipping one with every edge of the other, in fractions.

    shapely's own intersection is empty for some polygons that lie 1e-16 m apart.
    """
    clipped, other = (
        [(Fraction(x), Fraction(y)) for x, y in shapely.orient_polygons(each).exterior.coords[:-1]] for each in (p, q)
    )
    union = shoelace(clipped) + shoelace(other)
    for (x0, y0), (x1, y1) in zip(other, other[1:] + other[:1], strict=True):
        side = [(x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) for x, y in clipped]
        left = []
        for k, ((x, y), d) in enumerate(zip(clipped, side, strict=True)):
            (before_x, before_y), e = clipped[k - 1], side[k - 1]
            if d * e < 0:
                left.append((x + (before_x - x) * d / (d - e), y + (before_y - y) * d / (d - e)))
            if d >= 0:
                left.append((x, y))
        clipped = left
    return float(shoelace(clipped) / (union - shoelace(clipped)))


def shoelace(points: list[tuple[Fraction, Fraction]]) -> Fraction:
    return (
        sum((x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in zip(points, points[1:] + points[:1], strict=True)), Fraction())
        / 2
    )


def plain_ap(frames: list[tuple[Boxes, Boxes]], disc: tuple[float, float, float] | None = None) -> float:
    """The definition, written out: loops over pairs, exact overlaps, one threshold at a time."""
    rows, total = [], 0
    for found, truth in frames:
        keep = [k for k in range(len(found)) if disc is None or math.dist(found.xy_m[k], disc[:2]) <= disc[2]]
        cars = [k for k in range(len(truth)) if disc is None or math.dist(truth.xy_m[k], disc[:2]) <= disc[2]]
        total += len(cars)
        pairs = [(-found.score[k], -plain_iou(found.table()[k], truth.table()[c]), k, c) for k in keep for c in cars]
        hit = set()
        for _, iou, k, c in sorted(pairs):
            if -iou >= 0.5 and k not in hit and c in cars:
                hit.add(k)
                cars.remove(c)
        rows += [(float(found.score[k]), k in hit) for k in keep]
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
        frames.append((found, truth))
    return frames


def ap_of(frames: list[tuple[Boxes, Boxes]], disc: tuple[float, float, float] | None = None) -> float:
    return average_precision([match(f, t, disc) for f, t in frames])


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


def equals(seed: int) -> list[tuple[Boxes, Boxes]]:
    """Frames of cars, trucks and people at places in a row: many equal scores, equal overlaps and equal distances."""
    rng = np.random.Generator(np.random.PCG64(seed))

    def some(n: int) -> Boxes:
        kind = rng.choice(np.int8([CAR, CAR, TRUCK, PERSON]), n)
        xy = np.stack([np.zeros(n), rng.integers(0, 12, n) / 2], axis=1)
        return Boxes(xy, np.tile((4.0, 2.0), (n, 1)), np.zeros(n), rng.choice([0.3, 0.6, 0.9], n), kind=kind)

    return [(some(int(rng.integers(0, 24))), some(int(rng.integers(0, 12)))) for _ in range(5)]


def in_convention(name: str) -> Callable[[list[tuple[Boxes, Boxes]]], float]:
    convention = CONVENTIONS[name]
    return lambda frames: average_precision([match(f, t, convention=convention) for f, t in frames], convention)


@pytest.mark.parametrize(
    "figure",
    [
        *map(in_convention, CONVENTIONS),
        lambda frames: ap_of(frames, Disc(0.0, 2.0, 2.5)),
        lambda frames: ap_of([(suppress(f, 0.15), t) for f, t in frames]),
        lambda frames: average_precision(match_many(*zip(*frames, strict=True))),
    ],
    ids=[*CONVENTIONS, "in a disc", "suppressed", "many at once"],
)
@pytest.mark.parametrize("seed", range(12))
def test_no_order_changes_ap(
    figure: Callable[[list[tuple[Boxes, Boxes]]], float], seed: int, request: pytest.FixtureRequest
) -> None:
    """Neither that of boxes, nor of truths, nor of frames (other than OpenCOOD's convention has it)."""
    frames = equals(seed)
    rng = np.random.Generator(np.random.PCG64(seed))
    found = set()
    for _ in range(12):
        mixed = [(f.take(rng.permutation(len(f))), t.take(rng.permutation(len(t)))) for f, t in frames]
        order = range(len(mixed)) if "opencood" in request.node.callspec.id else rng.permutation(len(mixed))
        found.add(figure([mixed[k] for k in order]))
    assert len(found) == 1, found


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_among_equal_scores_the_nearest_pair_is_matched_first(side: float) -> None:
    """A person between two others is left to the one that nobody else is near."""
    truth = Boxes(
        np.array([(0.0, 0.0), (2.4, 0.0)]) * side,
        np.full((2, 2), 0.5),
        np.zeros(2),
        np.ones(2),
        kind=np.int8([PERSON, PERSON]),
    )
    found = replace(truth, xy_m=np.array([(1.1, 0.0), (-1.0, 0.0)]) * side, score=np.full(2, 0.5))
    assert match(found, truth).hit.all()
    assert match(found.take(np.array([1, 0])), truth).hit.all()
    first = replace(found, score=np.array([0.6, 0.5]))
    assert sorted(match(first, truth).hit.tolist()) == [False, True], "of unequal scores the best chooses first"


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


def crowd(seed: int, images: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes that crowd one another, with their images and scores, in the order of `best_first`."""
    rng = np.random.Generator(np.random.PCG64(seed))
    n = int(rng.integers(0, 400))
    boxes = rng.uniform((-15, -15, 3.5, 1.6, -4), (15, 15, 5, 2.1, 4), (n, 5))
    image, score = rng.integers(0, images, n), np.round(rng.random(n), 2)
    order = best_first(boxes, score, image)
    return boxes[order], image[order], score[order]


@pytest.mark.parametrize("seed", range(8))
def test_suppression_of_many_images_is_the_loop_over_boxes(seed: int) -> None:
    boxes, image, _ = crowd(seed)
    keep: list[int] = []
    for k in range(len(boxes)):
        rivals = [j for j in keep if image[j] == image[k]]
        if not rivals or iou_pairs(boxes[rivals], np.repeat(boxes[k : k + 1], len(rivals), 0)).max() <= 0.15:
            keep.append(k)
    assert np.flatnonzero(suppressed(boxes, np.arange(len(boxes)), image, 0.15)).tolist() == keep


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


def outside_ap(frames: list[tuple[Boxes, Boxes]], convention: Convention) -> float:
    """AP by pycocotools: its matching, its sorting and its interpolation, on overlaps that shapely works out.

    It takes the precision at given recalls. In the middle between k and k + 1 hits the interpolated curve is flat, so
    the mean over those recalls is the area under it.
    """
    coco, dt = COCO(), []
    total = sum(len(truth) for _, truth in frames)
    coco.dataset = {"images": [{"id": k} for k in range(len(frames))], "categories": [{"id": 1}], "annotations": []}
    ids = iter(range(1, 1_000_000))
    for k, (found, truth) in enumerate(frames):
        for _ in range(len(truth)):
            one = {"id": next(ids), "image_id": k, "category_id": 1, "bbox": [0, 0, 9, 9], "area": 81, "iscrowd": 0}
            coco.dataset["annotations"].append(one)
        order = np.argsort(-found.score, kind="stable")
        place = np.argsort(order)
        for n in range(len(found)):
            # a sort within frames alone is a sort by (frame, place)
            score = found.score[n] if convention.sort == "all" else -1000.0 * k - place[n]
            dt.append({"image_id": k, "category_id": 1, "bbox": [0, 0, 9, 9], "score": float(score)})
    with contextlib.redirect_stdout(io.StringIO()):
        coco.createIndex()
        if not dt:
            return 0.0
        run = COCOeval(coco, coco.loadRes(dt), "bbox")
        run.params.iouThrs, run.params.maxDets = np.array([0.5]), [10_000]
        run.params.areaRng, run.params.areaRngLbl = [[0, 1e9]], ["all"]
        run.params.recThrs = (
            (np.arange(total) + 0.5) / total if convention.points == "all" else np.arange(11) / 10 - 1e-9
        )

        def overlaps(image: int, category: int) -> np.ndarray:
            found, truth = frames[image]
            table = np.zeros((len(found), len(truth)))
            for row, n in zip(table, np.argsort(-found.score, kind="stable"), strict=True):
                for m in range(len(truth)):
                    p, q = polygon(found.table()[n]), polygon(truth.table()[m])
                    if convention.overlap == "axis-aligned":
                        p, q = p.envelope, q.envelope
                    row[m] = exact_iou(p, q)
            if convention.match == "first" and table.size:
                table *= table == table.max(axis=1, keepdims=True)
            return table

        run.computeIoU = overlaps
        run.evaluate()
        run.accumulate()
    return float(run.eval["precision"].mean())


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("name", CONVENTIONS)
def test_every_convention_equals_an_outside_implementation(name: str, seed: int) -> None:
    convention = CONVENTIONS[name]
    frames = some_frames(100 + seed, 10)
    # no two scores alike: what ties are worth is each implementation's own choice
    scores = iter(np.random.Generator(np.random.PCG64(seed)).permutation(2000) / 2000)
    frames = [
        (Boxes(f.xy_m, f.size_m, f.yaw_rad, np.array([next(scores) for _ in range(len(f))])), t) for f, t in frames
    ]
    ours = average_precision([match(f, t, convention=convention) for f, t in frames], convention)
    assert ours == pytest.approx(outside_ap(frames, convention), abs=1e-6)
    assert 0.05 < ours < 0.95


def test_the_conventions_differ_as_they_should() -> None:
    frames = some_frames(3, 12)
    ap = {name: [] for name in CONVENTIONS}
    for shift in range(3):
        for name, convention in CONVENTIONS.items():
            turned = frames[shift:] + frames[:shift]
            ap[name].append(average_precision([match(f, t, convention=convention) for f, t in turned], convention))
    assert max(ap["rotated"]) == min(ap["rotated"])
    assert max(ap["uav3d"]) == min(ap["uav3d"])
    assert max(ap["opencood"]) > min(ap["opencood"]), "there the order of frames decides"
    assert ap["rotated"][0] != ap["uav3d"][0]


def test_a_detection_whose_best_truth_is_gone() -> None:
    size = np.array([(4.0, 2.0)])
    truth = Boxes(np.array([(0.0, 0.0), (0.8, 0.0)]), size.repeat(2, 0), np.zeros(2), np.ones(2))
    found = Boxes(np.array([(0.8, 0.0), (0.5, 0.0)]), size.repeat(2, 0), np.zeros(2), np.array([0.9, 0.8]))
    assert match(found, truth).hit.tolist() == [True, True]
    assert match(found, truth, convention=CONVENTIONS["uav3d"]).hit.tolist() == [True, False]


def test_eleven_points() -> None:
    curve = [Matched(np.array([0.9, 0.8, 0.7, 0.6]), np.array([True, False, True, False]), 4)]
    # recall 0.25 at precision 1, 0.5 at 2/3: levels 0, 0.1, 0.2 see 1, levels 0.3, 0.4, 0.5 see 2/3
    assert average_precision(curve, Convention(points="11")) == pytest.approx((3 * 1 + 3 * 2 / 3) / 11)
    assert average_precision(curve) == pytest.approx(0.25 * 1 + 0.25 * 2 / 3)


@settings(max_examples=100, deadline=None)
@given(a=box, b=box)
def test_axis_aligned_overlap_is_of_the_hulls(a: tuple[float, ...], b: tuple[float, ...]) -> None:
    p, q = polygon(np.array(a)).envelope, polygon(np.array(b)).envelope
    _, _, value = overlapping(np.array([a]), np.array([b]), kind="axis-aligned")
    assert (value[0] if len(value) else 0.0) == pytest.approx(exact_iou(p, q), abs=1e-12)


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


@pytest.mark.parametrize("turn", [0.0, 0.3, math.pi / 2, math.pi, 1e-10, -1e-8])
@pytest.mark.parametrize("twist", [0.0, math.pi / 2, math.pi, 1e-12, -1e-10, 1e-9, 1e-6])
def test_edges_that_coincide(turn: float, twist: float) -> None:
    c, s = math.cos(turn), math.sin(turn)
    at = [
        (u, v, *size)
        for u in (0, 1, 2.5, 4, 4.0000000001)
        for v in (0, 0.5, 1.0000000001, 2, -2)
        for size in ((4, 2), (2, 1), (4, 1))
    ]
    b = np.array([(7 + c * u - s * v, 9 + s * u + c * v, length, width, turn + twist) for u, v, length, width in at])
    a = np.tile((7.0, 9.0, 4.0, 2.0, turn), (len(b), 1))
    assert iou_pairs(a, b) == pytest.approx([plain_iou(p, q) for p, q in zip(a, b, strict=True)], abs=1e-12)
    assert iou_pairs(b, a) == pytest.approx(iou_pairs(a, b), abs=1e-12)
