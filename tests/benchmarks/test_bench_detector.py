"""What a scored fleet-frame of the torch detector costs, part by part: `make bench-all` runs these; nothing here asserts a time.

A sortie scored at 10 Hz keeps real time where a fleet-frame costs less than 0.1 s of wall clock.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from perception_examples import cross

from sortie.perception.network.bev import lift
from sortie.perception.network.detector import TorchDetector
from sortie.perception.network.fusion.base import takes_part
from sortie.perception.network.fusion.registry import FUSIONS
from sortie.perception.network.winograd import WinogradReLU
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Share
from sortie.scenarios.schema import Perception, Scene

pytestmark = pytest.mark.slow

ROI = (10.0, 20.0, 32.0)
QUESTIONS: dict[str, tuple[float, tuple[float, float, float] | None] | None] = {
    "alone": None,
    "a twentieth in the mission's disc": (0.05, ROI),
    "a tenth": (0.1, None),
    "everything": (1.0, None),
}


@pytest.fixture(scope="module")
def detector() -> TorchDetector:
    return TorchDetector(SceneModel(Scene(), None, (-50, -50, 50, 50)), Perception(), seed=1)


@pytest.mark.parametrize("asked", QUESTIONS)
def test_a_fresh_fleet_frame(benchmark: Any, detector: TorchDetector, asked: str) -> None:
    """Five captures that nobody has seen, rendered, lifted and encoded, five egos with four peers each."""
    moments = iter(range(1, 10_000))

    def fresh() -> tuple[tuple[Any], dict[str, Any]]:
        fleet = cross(10.0, 20.0, 0.3, t_s=0.1 * next(moments))
        budget = QUESTIONS[asked]
        peers = {e: [] if budget is None else [c for c in fleet if c is not e] for e in fleet}
        rho, roi = budget or (0.0, None)
        return ([(e, [Share(c, "features", rho, roi, 1.0) for c in peers[e]]) for e in fleet],), {}

    assert len(benchmark.pedantic(detector.detect, setup=fresh, rounds=8, warmup_rounds=1)) == 5


@pytest.mark.parametrize("part", ["render", "lift", "encode", "spread", "head"])
def test_a_part_for_one_drone(benchmark: Any, detector: TorchDetector, part: str) -> None:
    """One capture through one stage, in one thread as the detector runs it."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    one = cross(10.0, 20.0, 0.3)[:1]
    views = detector._renderer.render(one)
    with torch.inference_mode():
        image = lift(views, one)
        features = detector._net.encoder(image)
        fine = detector._net.spread(features)
        do = {
            "render": lambda: detector._renderer.render(one),
            "lift": lambda: lift(views, one),
            "encode": lambda: detector._net.encoder(image),
            "spread": lambda: detector._net.spread(features),
            "head": lambda: detector._net.head(fine),
        }[part]
        assert len(benchmark(do)) == 1
    torch.set_num_threads(threads)


@pytest.mark.parametrize("sent", [1.0, 0.05])
@pytest.mark.parametrize("method", FUSIONS)
def test_one_ego_of_five_by_method(benchmark: Any, method: str, sent: float) -> None:
    """Fusion alone, four peers, maps as the encoder lays them out."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    rng = torch.Generator().manual_seed(1)
    fusion = FUSIONS[method]().eval()
    fusion.fold()
    agents = torch.randn(5, 80, 64, 64, generator=rng).relu().contiguous(memory_format=torch.channels_last)[None]
    arrived = torch.rand(1, 4, 64, 64, generator=rng) < sent
    part = takes_part(arrived, torch.ones_like(arrived), torch.ones(1, 4), "masked")
    with torch.inference_mode():
        assert benchmark(fusion, agents, part, torch.ones(1, 5)).shape == (1, 80, 64, 64)
    torch.set_num_threads(threads)


LAYERS = {
    "80 → 80 at 64": (80, 80, 64, 1),
    "80 → 80 at 64, dilated": (80, 80, 64, 2),
    "40 → 40 at 128": (40, 40, 128, 1),
}


@pytest.mark.parametrize("way", ["winograd", "plain"])
@pytest.mark.parametrize("layer", LAYERS)
def test_a_convolution_and_its_relu(benchmark: Any, layer: str, way: str) -> None:
    """The layers that the detector spends its time in, both ways, in one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    c, o, side, dilation = LAYERS[layer]
    benchmark.group = f"convolution, {layer}"
    conv = torch.nn.Conv2d(c, o, 3, padding=dilation, dilation=dilation)
    conv.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    x = torch.randn(1, c, side, side).relu().contiguous(memory_format=torch.channels_last)
    do = WinogradReLU(conv) if way == "winograd" else torch.nn.Sequential(conv, torch.nn.ReLU(inplace=True))
    with torch.inference_mode():
        assert benchmark(do, x).shape == (1, o, side, side)
    torch.set_num_threads(threads)
