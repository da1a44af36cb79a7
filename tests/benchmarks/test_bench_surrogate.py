"""The surrogate beside the torch detector, on the same moments; and a whole sortie with it. `make bench-all` prints them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from perception_examples import cross

from sortie.perception.detectors import Detector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Capture, Share
from sortie.scenarios.reading.load import load
from sortie.scenarios.schema import Perception, Scene
from sortie.sim.engine.sortie import run_sortie

pytestmark = pytest.mark.slow

Moments = list[list[tuple[Capture, list[Share]]]]


def moments(count: int, begin_s: float) -> Moments:
    fleets = [cross(10.0, 20.0, 0.3, t_s=begin_s + 0.5 * k) for k in range(count)]
    return [[(e, [Share(c, "features", 0.25, None, 1.0) for c in f if c is not e]) for e in f] for f in fleets]


@pytest.mark.benchmark(group="five egos of four moments")
@pytest.mark.parametrize("which", ["torch", "surrogate"])
def test_five_egos_of_four_moments(benchmark: Any, which: str) -> None:
    from sortie.perception.network.detector import TorchDetector
    from sortie.perception.surrogate.detector import SurrogateDetector

    scene = SceneModel(Scene(), None, (-50, -50, 50, 50))
    detector: Detector = (
        TorchDetector(scene, Perception(), 1) if which == "torch" else SurrogateDetector(scene, Perception(), 1)
    )
    begins = iter(np.arange(1.0, 1000.0, 5.0).tolist())

    def detect_job(asked: Moments) -> int:
        return sum(len(detector.detect(jobs)) for jobs in asked)

    assert (
        benchmark.pedantic(detect_job, setup=lambda: ((moments(4, next(begins)),), {}), rounds=3, warmup_rounds=1) == 20
    )


@pytest.mark.benchmark(group="scoring of a sortie of 120 s at 2 Hz")
def test_a_whole_sorties_moments_at_once(benchmark: Any) -> None:
    from sortie.perception.surrogate.detector import SurrogateDetector

    detector = SurrogateDetector(SceneModel(Scene(), None, (-50, -50, 50, 50)), Perception(), 1)
    assert len(list(benchmark.pedantic(detector.detect_many, (moments(240, 0.0),), rounds=3, warmup_rounds=1))) == 1200


@pytest.mark.benchmark(group="sortie of 120 s, five drones, surrogate at 2 Hz")
def test_a_sortie_with_the_surrogate(benchmark: Any) -> None:
    scenario = load("track_target", ["perception.detector=surrogate"])
    record = benchmark.pedantic(run_sortie, (scenario,), rounds=3, warmup_rounds=1)
    assert record.tables["fusions"].num_rows == 1200
