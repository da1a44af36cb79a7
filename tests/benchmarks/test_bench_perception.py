"""What perception costs: `make bench-all` runs these; nothing here asserts a time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely
import torch
from perception_examples import cross

from sortie.perception.budget import cells_sent
from sortie.perception.geometry import FULL
from sortie.perception.metrics.ap import corners, iou_pairs
from sortie.perception.network.bev import lift
from sortie.perception.network.detector import TorchDetector
from sortie.perception.network.fusion.base import takes_part
from sortie.perception.network.model import CarNet
from sortie.perception.network.warp import warp
from sortie.perception.scene.render import Renderer
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Share
from sortie.scenarios.schema import Perception, Scene

pytestmark = pytest.mark.slow

FLEET = cross(10.0, 20.0, 0.3)


@pytest.fixture(scope="module")
def scene() -> SceneModel:
    return SceneModel(Scene(), None, (-50, -50, 50, 50))


def test_render_five_drones(benchmark: Any, scene: SceneModel) -> None:
    renderer = Renderer(scene, 1)
    renderer.render(FLEET)  # the scenery is rasterised once
    assert benchmark(renderer.render, FLEET).any()


def test_lift_five_drones(benchmark: Any, scene: SceneModel) -> None:
    views = Renderer(scene, 1).render(FLEET)
    assert benchmark(lift, views, FLEET).any()


def test_forward_of_a_fleet_frame(benchmark: Any) -> None:
    """Five encodings, five fusions of five, five heads."""
    net = CarNet().eval()
    images = torch.randint(0, 255, (5, 4, 256, 256), dtype=torch.uint8)
    poses = torch.tensor([(c.position_m[0], c.position_m[1], 0.3) for c in FLEET])
    everywhere = torch.ones(4, 1, 64, 64, dtype=torch.bool)

    @torch.inference_mode()
    def forward() -> int:
        features = torch.cat([net.encoder(image[None]) for image in images])
        for ego in range(5):
            peers = [k for k in range(5) if k != ego]
            moved, sent, inside = warp(features[peers], everywhere, poses[ego], poses[peers], FULL.cell_m)
            part = takes_part(sent[None, :, 0], inside[None, :, 0], torch.ones(1, 4), "masked")
            out = net.head(net.fusion(torch.cat([features[ego : ego + 1], moved])[None], part, torch.ones(1, 5)))
        return len(out)

    assert benchmark(forward) == 1


def test_detect_for_five_egos_render_included(benchmark: Any, scene: SceneModel) -> None:
    detector = TorchDetector(scene, Perception(), seed=1)
    times = iter(np.arange(1.0, 10_000.0, 0.5))

    def fresh() -> tuple[tuple[Any], dict[str, Any]]:
        fleet = cross(10.0, 20.0, 0.3, t_s=float(next(times)))
        return ([(e, [Share(c, "features", 0.1, None, 1.0) for c in fleet if c is not e]) for e in fleet],), {}

    assert len(benchmark.pedantic(detector.detect, setup=fresh, rounds=8, warmup_rounds=1)) == 5


def test_cells_of_a_link(benchmark: Any) -> None:
    assert benchmark(cells_sent, 0.25, (20.0, 10.0, 32.0), 3.0, 4.0, 0.2) > 0


def test_cars_near_a_drone(benchmark: Any, scene: SceneModel) -> None:
    assert benchmark(scene.cars_near, 5.0, 0.0, 0.0, 102.4) > 0


def some_pairs() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.Generator(np.random.PCG64(1))
    low, high = (-2, -2, 4, 1.7, -3), (2, 2, 5, 2, 3)
    return rng.uniform(low, high, (2000, 5)), rng.uniform(low, high, (2000, 5))


def test_rotated_overlap_vectorised(benchmark: Any) -> None:
    assert benchmark(iou_pairs, *some_pairs()).max() <= 1


def test_rotated_overlap_in_a_shapely_loop(benchmark: Any) -> None:
    a, b = some_pairs()

    def loop() -> float:
        best = 0.0
        for one, other in zip(corners(a), corners(b), strict=True):
            p, q = shapely.Polygon(one), shapely.Polygon(other)
            best = max(best, p.intersection(q).area / p.union(q).area)
        return best

    assert benchmark(loop) <= 1
