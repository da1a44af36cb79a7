"""Interventions on the fusion's softmax: closed forms of the weights, and what they refuse."""

from __future__ import annotations

import math

import pytest
import torch

from sortie.perception.errors import InputError
from sortie.perception.geometry import CHANNELS
from sortie.perception.network.fusion.disconet import DiscoNet
from sortie.perception.network.fusion.where2comm import Where2comm


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
    fusion.tune(temperature=math.inf)
    assert fusion.weights(features, part, weight)[:3] == pytest.approx(torch.full((3, 50), 1 / 3))
    fusion.tune(temperature=1e9)  # what a scenario can say, whose numbers are finite
    assert fusion.weights(features, part, weight)[:3] == pytest.approx(torch.full((3, 50), 1 / 3))
    fusion.tune(temperature=math.inf)
    weight[1] = 0.5
    assert fusion.weights(features, part, weight)[:, 0].tolist() == pytest.approx([0.4, 0.2, 0.4, 0.0])


@torch.inference_mode()
def test_the_temperature_is_a_power_of_ratios(fusion: DiscoNet) -> None:
    features, part, weight = rows()
    plain = fusion.weights(features, part, weight)
    fusion.tune(temperature=2.0)
    warm = fusion.weights(features, part, weight)
    assert warm[1] / warm[0] == pytest.approx(torch.sqrt(plain[1] / plain[0]), rel=1e-5)
    fusion.tune()
    assert torch.equal(fusion.weights(features, part, weight), plain)


@torch.inference_mode()
def test_a_silent_weight_multiplies_the_odds_of_silent_cells_alone(fusion: DiscoNet) -> None:
    features, part, weight = rows()
    plain = fusion.weights(features, part, weight)
    fusion.tune(silent_weight=0.35)
    moved = fusion.weights(features, part, weight)
    assert moved[2] / moved[0] == pytest.approx(math.exp(0.35) * plain[2] / plain[0], rel=1e-5)
    assert moved[1] / moved[0] == pytest.approx(plain[1] / plain[0], rel=1e-5)
    features[0] = 0.0  # an ego that sees nothing is not silent
    fusion.tune()
    plain = fusion.weights(features, part, weight)
    fusion.tune(silent_weight=0.35)
    assert fusion.weights(features, part, weight)[2] == pytest.approx(
        math.exp(0.35) * plain[2] / (plain[0] + plain[1] + math.exp(0.35) * plain[2]), rel=1e-5
    )


@pytest.mark.parametrize(
    ("params", "told"),
    [
        ({"temperature": 0.0}, "perception.fusion_params.temperature is 0.0, must be a number above 0"),
        ({"temperature": "hot"}, "perception.fusion_params.temperature is 'hot', must be a number above 0"),
        ({"silent_weight": math.inf}, "perception.fusion_params.silent_weight is inf, must be a finite number"),
        ({"heat": 1.0}, "perception.fusion_params.heat: fusion disconet has no such parameter"),
    ],
)
def test_what_cannot_be_tuned_is_named(fusion: DiscoNet, params: dict[str, float], told: str) -> None:
    with pytest.raises(InputError) as refused:
        fusion.tune(**params)
    assert str(refused.value) == told


def test_other_methods_have_no_such_knobs() -> None:
    with pytest.raises(InputError, match=r"^perception\.fusion_params\.temperature: fusion where2comm has no such"):
        Where2comm().tune(temperature=2.0)
