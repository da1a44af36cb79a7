"""Interventions on the fusion's softmax: closed forms of the weights, what they refuse, and how a sortie flies them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from perception_examples import cross

from research.flip import fusion as dosed_fusion
from research.flip.fusion import DosedDiscoNet
from sortie.perception.errors import InputError
from sortie.perception.geometry import CHANNELS
from sortie.perception.network.detector import TorchDetector
from sortie.perception.network.fusion.disconet import DiscoNet
from sortie.perception.network.fusion.where2comm import Where2comm
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Share
from sortie.scenarios.schema import Perception, Scene


@pytest.fixture
def fusion() -> DiscoNet:
    torch.manual_seed(1)
    made = DiscoNet().eval()
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return made


def rows(agents: int = 4, cells: int = 50) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Features of which agent 2 sent nothing and agent 3 has no part, who takes part, and weights of 1."""
    rng = torch.Generator().manual_seed(2)
    features = torch.randn(agents, cells, CHANNELS, generator=rng).relu()
    features[2] = 0.0
    part = torch.ones(agents, cells, dtype=torch.bool)
    part[3] = False
    return features, part, torch.ones(agents, cells)


@torch.inference_mode()
def test_an_infinite_temperature_gives_equal_weights(fusion: DiscoNet) -> None:
    features, part, weight = rows()
    for temperature in (math.inf, 1e9):  # the second is what a scenario can say, whose numbers are finite
        even = DosedDiscoNet(fusion, temperature=temperature)
        assert even.weights(features, part, weight)[:3] == pytest.approx(torch.full((3, 50), 1 / 3))
    weight[1] = 0.5
    even = DosedDiscoNet(fusion, temperature=math.inf)
    assert even.weights(features, part, weight)[:, 0].tolist() == pytest.approx([0.4, 0.2, 0.4, 0.0])


@torch.inference_mode()
def test_the_temperature_is_a_power_of_ratios(fusion: DiscoNet) -> None:
    features, part, weight = rows()
    plain = fusion.weights(features, part, weight)
    warm = DosedDiscoNet(fusion, temperature=2.0).weights(features, part, weight)
    assert warm[1] / warm[0] == pytest.approx(torch.sqrt(plain[1] / plain[0]), rel=1e-5)
    assert torch.equal(DosedDiscoNet(fusion).weights(features, part, weight), plain)


@torch.inference_mode()
def test_a_silent_weight_multiplies_the_odds_of_silent_cells_alone(fusion: DiscoNet) -> None:
    features, part, weight = rows()
    dosed = DosedDiscoNet(fusion, silent_weight=0.35)
    plain, moved = (f.weights(features, part, weight) for f in (fusion, dosed))
    assert moved[2] / moved[0] == pytest.approx(math.exp(0.35) * plain[2] / plain[0], rel=1e-5)
    assert moved[1] / moved[0] == pytest.approx(plain[1] / plain[0], rel=1e-5)
    features[0] = 0.0  # an ego that sees nothing is not silent
    plain = fusion.weights(features, part, weight)
    assert dosed.weights(features, part, weight)[2] == pytest.approx(
        math.exp(0.35) * plain[2] / (plain[0] + plain[1] + math.exp(0.35) * plain[2]), rel=1e-5
    )


@pytest.mark.parametrize(
    ("params", "told"),
    [
        ({"temperature": 0.0}, "temperature is 0.0, must be a number above 0"),
        ({"temperature": "hot"}, "temperature is 'hot', must be a number above 0"),
        ({"silent_weight": math.inf}, "silent_weight is inf, must be a finite number"),
        ({"trained": Where2comm()}, "fusion is where2comm, must be disconet"),
    ],
)
def test_what_cannot_be_dosed_is_named(fusion: DiscoNet, params: dict[str, float], told: str) -> None:
    with pytest.raises(InputError) as refused:
        DosedDiscoNet(**{"trained": fusion, **params})  # type: ignore[arg-type]
    assert str(refused.value) == told


def test_a_sortie_flies_a_dose_as_a_fusion_of_a_user_s_own() -> None:
    """Without a change it detects what the built-in fusion does."""
    scene, (ego, *peers) = SceneModel(Scene(), None, (-50, -50, 50, 50)), cross(10.0, 20.0, 0.3)

    def found(**options: object) -> Boxes:
        config = Perception.model_validate({"unsent_cells": "zero", **options})
        shares = [Share(peer, "features", 0.02, None, 1.0) for peer in peers]
        (boxes,) = TorchDetector(scene, config, 1, Path("disconet.safetensors")).detect([(ego, shares)])
        return boxes

    own = f"{dosed_fusion.__file__}:DosedDiscoNet"
    plain = found()
    same, dosed = (
        found(fusion=own, fusion_params={"weights": "disconet.safetensors", **dose})
        for dose in ({}, {"temperature": 1e9, "silent_weight": 0.7})
    )
    np.testing.assert_allclose(same.table(), plain.table(), atol=1e-3)
    np.testing.assert_allclose(same.score, plain.score, atol=1e-4)
    assert len(dosed) != len(plain) or np.abs(dosed.score - plain.score).max() > 0.01
