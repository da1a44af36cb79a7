"""The shipped weights earn their place: cooperation beats a single drone in towns that nobody has seen before."""

import numpy as np
import pytest

from research.benchmark.difficulty import Difficulty
from research.benchmark.scenes import draw_captures, draw_scene
from research.flip.plan import read_plan
from research.flip.run import SHIPPED
from sortie.perception.ground_truth import ground_truth
from sortie.perception.metrics.ap import Matched, match
from sortie.perception.metrics.bootstrap import compare
from sortie.perception.network.checkpoint import read_facts
from sortie.perception.network.detector import TorchDetector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Share
from sortie.scenarios.schema import Perception
from sortie.scenarios.shipped import NETWORKS

SCENES = range(6)
"""Of the test split: no layout of theirs is in any other split."""


@pytest.mark.slow
def test_cooperation_beats_a_single_drone_on_held_out_towns() -> None:
    single: list[Matched] = []
    full: list[Matched] = []
    towns: list[int] = []
    for seed in SCENES:
        scene = SceneModel(draw_scene(5, "test", seed, Difficulty()), None, (-60, -60, 60, 60))
        detector = TorchDetector(scene, Perception(), seed=seed)
        for frame in range(2):
            fleet = draw_captures(5, "test", seed, frame, Difficulty())
            jobs = [(ego, [Share(c, "features", 1.0, None, 1.0) for c in fleet if c is not ego]) for ego in fleet[:3]]
            together = detector.detect(jobs)
            alone = detector.detect([(ego, []) for ego, _ in jobs])
            for (ego, _), one, all_five in zip(jobs, alone, together, strict=True):
                truth = ground_truth(scene.cars_at(ego.t_s).table(), ego.true_pose)
                single.append(match(one, truth))
                full.append(match(all_five, truth))
                towns.append(seed)
    gain = compare(single, full, towns, seed=1)
    assert gain.low > 0, gain
    assert gain.ap_b > 0.2, gain
    assert gain.ap_b > 1.15 * gain.ap_a, gain
    assert np.isfinite(gain.high)


def test_the_coarse_network_is_the_seed_with_the_best_validation_ap_under_full_sharing() -> None:
    plan = read_plan()
    seeds = [SHIPPED / f"{plan.variants[0].job(seed)}.safetensors" for seed in plan.variants[0].seeds]
    best = max(seeds, key=lambda path: read_facts(path)["validation"][0]["gain"]["ap_b"])
    assert (NETWORKS / "disconet.safetensors").read_bytes() == best.read_bytes(), f"must be {best.name}"
