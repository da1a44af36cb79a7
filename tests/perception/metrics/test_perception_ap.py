"""AP against its definition, and in the field's conventions against pycocotools."""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from overlap_examples import exact_iou, plain_iou, polygon
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from wrong_rows import wrong_rows

from sortie.perception.classes import CAR, PERSON, TRUCK
from sortie.perception.metrics.ap import (
    CONVENTIONS,
    Convention,
    Matched,
    average_precision,
    match,
    match_many,
    suppress,
)
from sortie.perception.types import Boxes
from sortie.scenarios.disc import Disc


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


def test_ap_equals_the_plain_definition() -> None:
    def check(seed: int, disc: tuple[float, float, float] | None) -> None:
        frames = some_frames(seed)
        assert ap_of(frames, disc) == pytest.approx(plain_ap(frames, disc), abs=1e-6)

    assert wrong_rows(product(range(12), [None, (3.0, -2.0, 18.0)]), check) == {}


def equals(seed: int) -> list[tuple[Boxes, Boxes]]:
    """Frames of cars, trucks and people at places in a row: many equal scores, equal overlaps and equal distances."""
    rng = np.random.Generator(np.random.PCG64(seed))

    def some(n: int) -> Boxes:
        kind = rng.choice(np.int8([CAR, CAR, TRUCK, PERSON]), n)
        xy = np.stack([np.zeros(n), rng.integers(0, 12, n) / 2], axis=1)
        return Boxes(xy, np.tile((4.0, 2.0), (n, 1)), np.zeros(n), rng.choice([0.3, 0.6, 0.9], n), kind=kind)

    return [(some(int(rng.integers(0, 24))), some(int(rng.integers(0, 12)))) for _ in range(5)]


def test_no_order_changes_ap() -> None:
    """Neither that of boxes, nor of truths, nor of frames, unless OpenCOOD's convention has it so."""

    def in_convention(name: str) -> Callable[[list[tuple[Boxes, Boxes]]], float]:
        c = CONVENTIONS[name]
        return lambda frames: average_precision([match(f, t, convention=c) for f, t in frames], c)

    figures: dict[str, Callable[[list[tuple[Boxes, Boxes]]], float]] = {
        name: in_convention(name) for name in CONVENTIONS
    }
    figures["in a disc"] = lambda frames: ap_of(frames, Disc(0.0, 2.0, 2.5))
    figures["suppressed"] = lambda frames: ap_of([(suppress(f, 0.15), t) for f, t in frames])
    figures["many at once"] = lambda frames: average_precision(match_many(*zip(*frames, strict=True)))

    def check(name: str, seed: int) -> None:
        frames, rng, found = equals(seed), np.random.Generator(np.random.PCG64(seed)), set()
        for _ in range(12):
            mixed = [(f.take(rng.permutation(len(f))), t.take(rng.permutation(len(t)))) for f, t in frames]
            order = range(len(mixed)) if name == "opencood" else rng.permutation(len(mixed))
            found.add(figures[name]([mixed[k] for k in order]))
        assert len(found) == 1, found

    assert wrong_rows(product(figures, range(12)), check) == {}


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
    """Whatever their order is: hit and miss at one score have a precision of one half together."""
    for hit in ([True, False], [False, True]):
        assert average_precision([Matched(np.array([0.5, 0.5]), np.array(hit), 1)]) == pytest.approx(0.5)
    first = Matched(np.array([0.9, 0.5]), np.array([True, False]), 2)
    second = Matched(np.array([0.5]), np.array([True]), 0)
    for frames in ([first, second], [second, first]):
        assert average_precision(frames) == pytest.approx(0.5 * 1.0 + 0.5 * 2 / 3)


def test_empty_frames() -> None:
    none = Boxes.empty()
    one = Boxes(np.zeros((1, 2)), np.array([(4.0, 2.0)]), np.zeros(1), np.ones(1))
    assert math.isnan(ap_of([(none, none)]))
    assert math.isnan(ap_of([]))
    assert ap_of([(none, one)]) == 0.0
    assert ap_of([(one, one), (one, none)]) == pytest.approx(0.5)
    assert ap_of([(one, one), (none, none)]) == 1.0


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


def test_every_convention_equals_an_outside_implementation() -> None:
    def check(seed: int, name: str) -> None:
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

    assert wrong_rows(product(range(6), CONVENTIONS), check) == {}


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
