"""The study's networks: they load from their files, detect as they were trained, and no flight takes them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from research.flip.networks import StudyConfig, StudyNet, config_of, load
from research.flip.run import SHIPPED
from sortie.perception.errors import InputError
from sortie.perception.network.checkpoint import load_weights, save_weights
from sortie.perception.network.inference import folded
from sortie.perception.network.model import CarNet, ModelConfig


@pytest.mark.parametrize(("job", "field"), [("signed-0", "exchange"), ("deep-0", "decoder")])
def test_a_study_network_loads_here_and_flights_refuse_it(job: str, field: str) -> None:
    path = SHIPPED / f"{job}.safetensors"
    net = load(path)
    assert isinstance(net, StudyNet)
    image = torch.randint(0, 256, (1, 4, 256, 256), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))
    quick = folded(net)
    with torch.inference_mode():
        features, quickly = net.encoder(image), quick.encoder(image)
        out, quick_out = net.head(features), quick.head(features)
    assert bool((features < 0).any()) == (field == "exchange")
    assert torch.allclose(features, quickly, rtol=2e-3, atol=1e-3)
    assert torch.allclose(out, quick_out, atol=1e-4 * float(out.abs().max()))
    with pytest.raises(InputError, match=rf"{job}\.safetensors: model\.{field} is not known"):
        load_weights(path)


def test_networks_of_flights_load_here_as_they_do_there() -> None:
    path = SHIPPED / "full-0.safetensors"
    assert type(load(path)) is CarNet
    assert load(path).config == load_weights(path).config == ModelConfig()


def test_a_trained_network_comes_back_with_its_parts(tmp_path: Path) -> None:
    config = config_of({"decoder": "deep", "exchange": "signed"})
    assert config == StudyConfig(decoder="deep", exchange="signed")
    assert type(config_of({"decoder": "shallow", "fusion": "late"})) is ModelConfig
    net = StudyNet(StudyConfig(decoder="deep"))
    save_weights(net, tmp_path / "w.safetensors")
    again = load(tmp_path / "w.safetensors")
    assert again.config == net.config
    assert torch.equal(again.head.trunk.down_16[0][0].weight, net.head.trunk.down_16[0][0].weight)
    object.__setattr__(net, "config", StudyConfig(decoder="wide"))  # type: ignore[arg-type]
    save_weights(net, tmp_path / "w.safetensors")
    with pytest.raises(InputError, match=r"w\.safetensors: model\.decoder is 'wide', must be shallow or deep"):
        load(tmp_path / "w.safetensors")
