"""Codes: a codebook by brute force, its file, and what a detector fuses of them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from perception_examples import cross

from research.paper.instrument import CarNetView
from research.train.codebook import CodebookRecipe, card, fit
from sortie.perception.budget import cells_in
from sortie.perception.evaluation.sharing import Exchange
from sortie.perception.network.checkpoint import load_weights
from sortie.perception.network.codebook import (
    Codebook,
    load_codebook,
)
from sortie.perception.network.detector import SHIPPED_WEIGHTS, TorchDetector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.schema import Perception, Scene
from sortie.scenarios.shipped import CODEBOOK, beside


def test_the_fit_finds_clusters_stage_by_stage_and_repeats() -> None:
    rng = np.random.default_rng(6)
    # a network's features are rectified, so none is below zero
    coarse, fine = rng.uniform(size=(12, 80)) * 8.0, rng.uniform(size=(9, 80)) * 0.4
    cells = (coarse[rng.integers(12, size=900)] + fine[rng.integers(9, size=900)]).astype(np.float32)
    recipe = CodebookRecipe(stages=2, iterations=10)
    stages = fit(cells, recipe)
    codebook = Codebook(torch.from_numpy(stages), "of none")
    read = codebook.decode(codebook.encode(torch.from_numpy(cells), 2)).numpy()
    assert ((cells - read) ** 2).sum() < 0.01 * ((cells - cells.mean(axis=0)) ** 2).sum()
    np.testing.assert_array_equal(fit(cells, recipe), stages)
    with pytest.raises(ValueError, match="100 cells, must be at least 256"):
        fit(cells[:100], recipe)


@pytest.mark.parametrize(("seed", "told"), [(0, "--seed 4`."), (7, "--seed 4 --bench-seed 7`.")])
def test_a_codebook_s_card_names_the_command_that_repeats_it(seed: int, told: str) -> None:
    facts = {
        "weights": "w.safetensors", "benchmark": {"key": "k", "seed": seed, "density": "default"}, "stages": 2, "scenes": 3,
        "iterations": 5, "seed": 4, "cells": 77, "unexplained": {1: 0.5},
    }  # fmt: skip
    command = "python -m research fit codebook --weights w.safetensors --out c.safetensors --stages 2 --scenes 3 --iterations 5"
    assert f"Made by `{command} {told}" in card("c.safetensors", facts)


# --- what is fused -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene() -> SceneModel:
    return SceneModel(Scene(), None, (-50, -50, 50, 50))


@pytest.fixture(scope="module")
def fleet() -> list[Capture]:
    return cross(10.0, 20.0, 0.3)[:3]


def same(a: Boxes, b: Boxes) -> bool:
    return len(a) == len(b) and all(np.array_equal(getattr(a, f), getattr(b, f)) for f in Boxes.__slots__)


def codes(c: Capture, rho: float = 0.05) -> Share:
    return Share(c, "codes", rho, None, 1.0)


def test_a_detector_fuses_what_is_read_from_codes(scene: SceneModel, fleet: list[Capture]) -> None:
    """As if peers' features were those of the codebook, in the same cells."""
    detector = TorchDetector(scene, Perception(code_bytes=5), 1)
    alone, coarse, plain = detector.detect(
        [(fleet[0], []), (fleet[0], [codes(c) for c in fleet[1:]]), (fleet[0], [codes(c)._replace(representation="features") for c in fleet[1:]])]
    )  # fmt: skip
    assert not same(alone, coarse)
    assert not same(plain, coarse)
    known = detector._encode(fleet)
    shares = [codes(c) for c in fleet[1:]]
    book = load_codebook(beside(SHIPPED_WEIGHTS, CODEBOOK), load_weights(SHIPPED_WEIGHTS))
    features = torch.stack([known[c].features.result() for c in fleet])
    sent = np.stack([detector._sent(s, known)[0].numpy() for s in shares])
    assert sent.sum() == 2 * cells_in(0.05)
    centre = np.array([*np.mean([c.est_pose[:2] for c in fleet], axis=0), 0.0])
    est = torch.from_numpy(np.array([c.est_pose for c in fleet]) - centre).float()
    read = torch.stack([book.read(f, 5) for f in features])
    view = CarNetView(detector._net, features, est, read)
    local = view.detect([Exchange(0, (1, 2), sent, "masked")], 0.1)[0]
    x, y, yaw = fleet[0].est_pose
    placed = Boxes.placed(local.astype(np.float32), (x, y, yaw))
    best = placed.xy_m[np.argmax(placed.score)]
    assert np.hypot(*(coarse.xy_m - best).T).min() < 0.01
    assert float(coarse.score[0]) == pytest.approx(float(placed.score.max()), abs=1e-4)
