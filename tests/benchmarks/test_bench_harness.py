"""What the harness costs, part by part: `make bench-all` runs these; nothing here asserts a time.

The evaluator's benchmark records how many times as fast it is as plain loops over shapely polygons (`extra_info`).
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
import shapely
import torch
from numpy.typing import NDArray

from sortie.perception.evaluation import Settings, sharing
from sortie.perception.evaluation.harness import match_all
from sortie.perception.geometry import FULL
from sortie.perception.metrics.ap import Matched, average_precision, match, suppress
from sortie.perception.metrics.bootstrap import rank
from sortie.perception.metrics.overlap import corners, iou_pairs
from sortie.perception.network.fusion.base import takes_part
from sortie.perception.network.inference import folded
from sortie.perception.network.model import CarNet
from sortie.perception.network.warp import warp
from sortie.perception.types import Boxes
from sortie.scenarios.intervals import resamples

pytestmark = pytest.mark.slow

EGOS = [e for e in range(5) for p in range(5) if p != e]
PEERS = [p for e in range(5) for p in range(5) if p != e]
POSES = torch.tensor([(0.0, 0.0, 0.1), (20.0, 1.0, 0.12), (0.0, 20.0, 0.1), (-20.0, 0.5, 0.09), (1.0, -20.0, 0.1)])


def crowd(images: int, seed: int = 1) -> tuple[list[NDArray[np.float64]], list[NDArray[np.float64]]]:
    """Detections [m, 6] and cars [t, 5] per image: 40 cars over ±100 m, most of them found, doubles and inventions."""
    rng = np.random.Generator(np.random.PCG64(seed))
    found, cars = [], []
    for _ in range(images):
        truth = rng.uniform((-100, -100, 4, 1.7, -3), (100, 100, 5, 2, 3), (40, 5))
        near = truth[rng.integers(0, 40, 60)] + rng.normal(0, 0.4, (60, 5)) * (1, 1, 0.2, 0.1, 0.1)
        wild = rng.uniform((-100, -100, 4, 1.7, -3), (100, 100, 5, 2, 3), (20, 5))
        boxes = np.concatenate([near, wild])
        found.append(np.concatenate([boxes, rng.random((80, 1))], axis=1))
        cars.append(truth)
    return found, cars


def by_loops(found: list[NDArray[np.float64]], cars: list[NDArray[np.float64]]) -> float:
    """Suppression at 0.15, matching at 0.5 and AP as a plain reader would write them, polygon by polygon."""
    frames = []
    for boxes, truth in zip(found, cars, strict=True):
        boxes = boxes[np.argsort(-boxes[:, 5], kind="stable")]
        polygons, there = shapely.polygons(corners(boxes[:, :5])), shapely.polygons(corners(truth))
        kept: list[int] = []
        for k in range(len(boxes)):
            if all(
                polygons[k].intersection(polygons[j]).area <= 0.15 * polygons[k].union(polygons[j]).area for j in kept
            ):
                kept.append(k)
        left, hit = list(range(len(truth))), []
        for k in kept:
            ious = [polygons[k].intersection(there[t]).area / polygons[k].union(there[t]).area for t in left]
            best = int(np.argmax(ious)) if ious else -1
            hit.append(bool(ious) and ious[best] >= 0.5)
            if hit[-1]:
                left.pop(best)
        frames.append(Matched(boxes[kept, 5], np.array(hit, bool), len(truth)))
    return average_precision(frames)


def at_once(found: list[NDArray[np.float64]], cars: list[NDArray[np.float64]]) -> float:
    """The same by the harness's evaluator; it is given all images of a frame together, five egos under every condition."""
    n = len(found)
    there = [Boxes(t[:, :2], t[:, 2:4], t[:, 4], np.ones(len(t))) for t in cars]
    return average_precision(
        match_all(found, np.arange(n), np.zeros((n, 3)), there, {"full": None}, Settings())["full"]
    )


def test_evaluator_against_shapely_loops(benchmark: Any) -> None:
    found, cars = crowd(50)
    start = time.process_time()
    plain = by_loops(found, cars)
    loops_s = time.process_time() - start
    value = benchmark(at_once, found, cars)
    assert value == pytest.approx(plain, abs=1e-6)
    start = time.process_time()
    for _ in range(5):
        at_once(found, cars)
    benchmark.extra_info["times_as_fast_as_shapely_loops"] = round(5 * loops_s / (time.process_time() - start), 1)


def test_evaluator_one_image_at_a_time(benchmark: Any) -> None:
    found, cars = crowd(50)

    def loop() -> float:
        units = []
        for boxes, truth in zip(found, cars, strict=True):
            kept = suppress(Boxes(boxes[:, :2], boxes[:, 2:4], boxes[:, 4], boxes[:, 5]), 0.15)
            units.append(match(kept, Boxes(truth[:, :2], truth[:, 2:4], truth[:, 4], np.ones(len(truth)))))
        return average_precision(units)

    assert benchmark(loop) == pytest.approx(at_once(found, cars), abs=1e-6)


def some_pairs() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rng = np.random.Generator(np.random.PCG64(1))
    low, high = (-2, -2, 4, 1.7, -3), (2, 2, 5, 2, 3)
    return rng.uniform(low, high, (2000, 5)), rng.uniform(low, high, (2000, 5))


def test_rotated_overlap_of_2000_pairs(benchmark: Any) -> None:
    assert benchmark(iou_pairs, *some_pairs()).max() <= 1


def test_rotated_overlap_of_2000_pairs_by_vectorised_shapely(benchmark: Any) -> None:
    a, b = some_pairs()

    def areas() -> NDArray[np.float64]:
        p, q = shapely.polygons(corners(a)), shapely.polygons(corners(b))
        return np.asarray(shapely.area(shapely.intersection(p, q)) / shapely.area(shapely.union(p, q)))

    assert benchmark(areas) == pytest.approx(iou_pairs(a, b), abs=1e-6)


def test_sending_order_of_five_drones(benchmark: Any) -> None:
    """All that top-k needs for every budget of a frame: a budget of b cells is `order < b` (below)."""
    scores = np.random.Generator(np.random.PCG64(1)).random((5, 64, 64), np.float32)
    first = sharing.in_disc(POSES.numpy().astype(np.float64), (5.0, 5.0, 32.0))
    assert benchmark(sharing.sending_order, scores, first).max() == 4095


def test_top_k_of_twenty_links_given_the_order(benchmark: Any) -> None:
    order = sharing.sending_order(np.random.Generator(np.random.PCG64(1)).random((5, 64, 64), np.float32))
    counts = np.full(20, 82)[:, None, None]
    assert benchmark(lambda: order[PEERS] < counts).sum() == 20 * 82


@pytest.mark.parametrize("rho", [0.02, 1.0])
def test_warp_twenty_links(benchmark: Any, rho: float) -> None:
    features = torch.randn(5, 80, 64, 64).contiguous(memory_format=torch.channels_last)
    sent = torch.rand(20, 1, 64, 64) < rho
    with torch.inference_mode():
        moved, _, _ = benchmark(warp, features[PEERS], sent, POSES[EGOS], POSES[PEERS], FULL.cell_m)
    assert moved.shape == (20, 80, 64, 64)


@pytest.mark.parametrize("rho", [0.02, 1.0])
def test_fusion_of_five_egos(benchmark: Any, rho: float) -> None:
    net = folded(CarNet().eval())
    agents = (
        torch.randn(5, 5, 80, 64, 64).flatten(0, 1).contiguous(memory_format=torch.channels_last).unflatten(0, (5, 5))
    )
    arrived = torch.rand(5, 4, 64, 64) < rho
    part = takes_part(arrived, torch.ones_like(arrived), torch.ones(5, 4), "masked")
    with torch.inference_mode():
        assert benchmark(net.fusion, agents, part, torch.ones(5, 5)).shape == (5, 80, 64, 64)


def test_head_of_five_egos(benchmark: Any) -> None:
    net = folded(CarNet().eval())
    maps = torch.randn(5, 80, 64, 64).contiguous(memory_format=torch.channels_last)
    with torch.inference_mode():
        assert benchmark(net.head, maps).shape == (5, 7, 128, 128)


def test_bootstrap_of_a_condition(benchmark: Any) -> None:
    """1,000 draws of 80 frames × 5 egos with 100 detections each, bins and products together."""
    rng = np.random.Generator(np.random.PCG64(1))
    units = []
    for _ in range(400):
        score = -np.sort(-rng.random(100))
        units.append(Matched(score, rng.random(100) < 0.8 * score, 45))
    groups, weights = np.repeat(np.arange(80), 5), resamples(80)
    assert benchmark(lambda: rank(units, groups).ap(weights)).shape == (1000,)
