"""Fusion of one's own: a user's torch module in the network's fusion step."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from perception_examples import cross, same

from sortie.perception.detectors import make_detector
from sortie.perception.errors import InputError
from sortie.perception.network.checkpoint import load_weights, save_weights
from sortie.perception.network.detector import SHIPPED_WEIGHTS, shipped
from sortie.perception.network.fusion.own import OwnFusion
from sortie.perception.network.model import CarNet, ModelConfig
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Share
from sortie.scenarios.plugins.reference import PluginError
from sortie.scenarios.schema import Perception, Scene

MODELS = """
import torch
from torch import nn

def alone(agents, takes_part, weight):
    return agents[:, 0]

def largest(agents, takes_part, weight, *, gain=1.0):
    part = (takes_part * weight[:, :, None, None])[:, 1:, None]
    return agents[:, 0] + gain * (part * torch.relu(agents[:, 1:] - agents[:, :1])).amax(1)

class Learned(nn.Module):
    def __init__(self, *, channels=80):
        super().__init__()
        self.layer = nn.Conv2d(channels, channels, 1)
    def forward(self, agents, takes_part, weight):
        return agents[:, 0] + self.layer(agents[:, 1:].sum(1))

class Mute:
    pass

def broken(*, of=1):
    raise KeyError("here")

numpy = lambda agents, takes_part, weight: agents[:, 0].numpy()
short = lambda agents, takes_part, weight: agents[0, 0]
infinite = lambda agents, takes_part, weight: agents[:, 0] / 0.0
whole = lambda agents, takes_part, weight: agents[:, 0].int()
def fails(agents, takes_part, weight):
    raise KeyError("ego")
def changes(agents, takes_part, weight):
    for given in (agents, takes_part, weight):
        given.zero_()
    return agents[:, 0]
"""


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> str:
    file = tmp_path_factory.mktemp("own") / "mine.py"
    file.write_text(MODELS)
    return str(file)


@pytest.fixture(scope="module")
def scene() -> SceneModel:
    return SceneModel(Scene(), None, (-50, -50, 50, 50))


def detected(scene: SceneModel, fusion: str, alone: bool = False, **settings: object) -> Boxes:
    """An ego's boxes with a tenth of the cells of each of four peers, or without peers."""
    detector = make_detector(scene, Perception.model_validate({"fusion": fusion, **settings}), 1)
    assert detector is not None
    ego, *peers = cross(10.0, 20.0, 0.3)
    return detector.detect([(ego, [] if alone else [Share(c, "features", 0.1, None, 0.8) for c in peers])])[0]


def test_the_largest_value_written_by_a_user_is_f_cooper(scene: SceneModel, models: str) -> None:
    weights = str(shipped("fcooper"))
    built_in = detected(scene, "fcooper")
    assert same(detected(scene, f"{models}:largest", weights=weights), built_in)
    assert not same(detected(scene, f"{models}:largest", weights=weights, fusion_params={"gain": 0.5}), built_in)


def test_a_fusion_that_ignores_its_peers_is_a_drone_alone(scene: SceneModel, models: str) -> None:
    assert same(detected(scene, f"{models}:alone"), detected(scene, "disconet", alone=True))
    assert not same(detected(scene, f"{models}:alone"), detected(scene, "disconet"))


def test_parameters_that_nobody_trained_are_the_same_in_every_run(models: str) -> None:
    torch.manual_seed(5)
    first, state = OwnFusion(f"{models}:Learned"), torch.random.get_rng_state()
    torch.manual_seed(5)
    assert torch.equal(state, torch.random.get_rng_state())  # and no other draw moves
    torch.manual_seed(6)
    assert torch.equal(first.model.layer.weight, OwnFusion(f"{models}:Learned").model.layer.weight)


def test_weights_keep_what_a_fusion_learned_and_need_it(models: str, tmp_path: Path) -> None:
    name, path = f"{models}:Learned", tmp_path / "mine.safetensors"
    net = CarNet(ModelConfig(fusion=name), OwnFusion(name))
    torch.nn.init.constant_(net.fusion.model.layer.weight, 0.25)
    save_weights(net, path)
    again = load_weights(path, OwnFusion(name))
    assert (again.fusion.model.layer.weight == 0.25).all()
    fresh = load_weights(SHIPPED_WEIGHTS, OwnFusion(name))
    assert torch.equal(fresh.fusion.model.layer.weight, OwnFusion(name).model.layer.weight)
    assert torch.equal(fresh.head.out.weight, load_weights(SHIPPED_WEIGHTS).head.out.weight)
    message = f"{path}: made for fusion {name!r}, which perception.fusion does not name"
    with pytest.raises(InputError, match=f"^{re.escape(message)}$"):
        load_weights(path)
    with pytest.raises(
        InputError, match=r"tensor fusion\.model\.layer\.weight has shape \[80, 80, 1, 1\], must be \[8"
    ):
        load_weights(path, OwnFusion(name, {"channels": 8}))


def test_a_fusion_cannot_change_the_maps_and_the_weights_of_others(models: str) -> None:
    given = torch.ones(1, 2, 3, 4, 4), torch.ones(1, 2, 4, 4, dtype=torch.bool), torch.ones(1, 2)
    assert not OwnFusion(f"{models}:changes")(*given).any()
    assert all(bool(each.all()) for each in given)


def fused(reference: str, params: dict[str, object]) -> torch.Tensor:
    agents, takes_part = torch.zeros(1, 2, 80, 64, 64), torch.ones(1, 2, 64, 64, dtype=torch.bool)
    out: torch.Tensor = OwnFusion(reference, params)(agents, takes_part, torch.ones(1, 2))
    return out


@pytest.mark.parametrize(
    ("name", "params", "message"),
    [
        ("missing", {}, "fusion file 'mine.py' has no function or class 'missing'"),
        ("largest", {"rise": 1}, "fusion 'mine.py:largest' has no parameter 'rise', it has: gain"),
        ("Mute", {}, "fusion Mute: its objects cannot be called, must have forward"),
        ("numpy", {}, "fusion <lambda>: returns ndarray, must be a torch tensor"),
        ("short", {}, "fusion <lambda>: returns shape (80, 64, 64), must be (1, 80, 64, 64)"),
        ("infinite", {}, "fusion <lambda>: returns torch.float32 with numbers that are not finite"),
        ("whole", {}, "fusion <lambda>: returns torch.int32, must be finite floats"),
        ("broken", {}, "fusion broken: TypeError: broken() takes 0 positional arguments but 3 were given"),
        ("fails", {}, "fusion fails: KeyError: 'ego' (mine.py, line 30)"),
    ],
)
def test_errors_are_of_one_line(
    name: str, params: dict[str, object], message: str, models: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(Path(models).parent)
    with pytest.raises(PluginError) as caught:
        fused(f"mine.py:{name}", params)
    assert str(caught.value).startswith(message)
