"""The fine network: exchanged cells spread over four, corrected for how they lie, fused and found in the head's cells."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from research.benchmark.dataset import Frames
from research.paper.instrument import CarNetInstrument, CarNetView
from research.train.learn import _fit, draw_batch, gradients, loss_of, step_loss, targets
from research.train.recipe import Recipe
from sortie.perception.evaluation.sharing import Exchange
from sortie.perception.network.checkpoint import load_weights, read_config, save_weights
from sortie.perception.network.decode import decode
from sortie.perception.network.fusion.base import takes_part
from sortie.perception.network.inference import folded
from sortie.perception.network.model import CarNet, ModelConfig
from sortie.perception.network.warp import arriving, moved, support

FINE = ModelConfig(grid="fine")
CPU = torch.device("cpu")


def network(seed: int = 0) -> CarNet:
    """Random weights, the correction for lying between cells among them."""
    torch.manual_seed(seed)
    net = CarNet(FINE).eval()
    with torch.no_grad():
        for parameter in (*net.fusion.parameters(), *net.align.parameters()):
            parameter.add_(0.1 * torch.randn_like(parameter))
        net.head.out.bias[0] = -1.0
    return net


@pytest.fixture(scope="module")
def fleet() -> Frames:
    """Two frames of five drones that look different ways, over pictures of blocks."""
    rng = np.random.default_rng(5)
    blocks = rng.integers(0, 255, (2, 5, 4, 32, 32), dtype=np.uint8).repeat(8, axis=3).repeat(8, axis=4)
    pose = np.concatenate([rng.uniform(-20, 20, (2, 5, 2)), rng.uniform(-3, 3, (2, 5, 1))], axis=-1)
    cars = np.concatenate([rng.uniform(-80, 80, (2, 30, 2)), np.tile([4.5, 1.85], (2, 30, 1)), rng.uniform(-3, 3, (2, 30, 1))], axis=-1)  # fmt: skip
    return Frames(blocks, pose, pose + 0.1, cars, np.arange(2))


@torch.inference_mode()
def everywhere(net: CarNet, features: Tensor, frames: Frames, e: Exchange) -> Tensor:
    """The head's output by whole maps."""
    est = torch.from_numpy(frames.est_pose[0] - frames.est_pose[0].mean(axis=0) * (1, 1, 0)).float()
    peers, k = list(e.peers), len(e.peers)
    maps = net.spread(features)
    under = support(est[e.ego], est[peers], 1.6, 128)
    weights, arrived = arriving(under, net.sent(torch.from_numpy(e.sent).flatten(1)))
    said = moved(maps[peers], under, weights)
    rows = said.permute(0, 2, 3, 1).flatten(1, 2)
    said = net.aligned(rows, under.offset.flatten(1, 2), under.turn).view(k, 128, 128, -1).permute(0, 3, 1, 2)
    part = takes_part(arrived[None], under.inside[None], torch.ones(1, k), e.unsent)
    agents = torch.cat([maps[e.ego : e.ego + 1], said])[None]
    out: Tensor = net.head(net.fusion(agents, part, torch.ones(1, 1 + k)))[0]
    return out


@pytest.mark.parametrize("unsent", ["zero", pytest.param("masked", marks=pytest.mark.slow)])
def test_fusing_where_something_arrived_is_fusing_everywhere(fleet: Frames, unsent: str) -> None:
    net = network()
    view = CarNetInstrument(net).look(fleet, 0)
    quick = folded(net)
    with torch.inference_mode():
        features = quick.encoder(torch.from_numpy(fleet.images[0]))
        alone = quick.head(quick.spread(features[:1]))[0]
    rng = np.random.default_rng(1)
    cases = [
        Exchange(ego, peers, rng.random((len(peers), 64, 64)) < share, unsent)  # type: ignore[arg-type]
        for share, ego, peers in ((0.02, 0, (1, 2, 3, 4)), (0.3, 3, (0, 4)))
    ]
    *found, own = view.detect([*cases, Exchange(0, (), np.zeros((0, 64, 64), bool))], 0.01)
    assert np.sort(own[:, 5]) == pytest.approx(np.sort(decode(alone, 0.01).double().numpy()[:, 5]), abs=1e-4)
    for e, ours in zip(cases, found, strict=True):
        theirs = decode(everywhere(quick, features, fleet, e), 0.01).double().numpy()
        assert len(ours) == len(theirs) > 50
        assert np.sort(ours[:, 5]) == pytest.approx(np.sort(theirs[:, 5]), abs=2e-5)


def test_a_view_takes_features_that_were_computed_for_inference(fleet: Frames) -> None:
    """Its maps are spread at once, wherever it is made."""
    net = folded(network())
    with torch.inference_mode():
        features = net.encoder(torch.from_numpy(fleet.images[0]))
    view = CarNetView(net, features, torch.zeros(5, 3))
    assert len(view.detect([Exchange(0, (), np.zeros((0, 64, 64), bool))], 0.01)) == 1


def test_it_is_folded_and_kept_as_it_is(fleet: Frames, tmp_path: Path) -> None:
    net = network()
    save_weights(net, tmp_path / "fine.safetensors")
    assert read_config(tmp_path / "fine.safetensors") == FINE
    again, images = load_weights(tmp_path / "fine.safetensors"), torch.from_numpy(fleet.images[0, :1])
    with torch.inference_mode():
        wanted = net.head(net.spread(net.encoder(images)))
        assert torch.equal(again.head(again.spread(again.encoder(images))), wanted)
        quick = folded(again)
        out = quick.head(quick.spread(quick.encoder(images)))
    assert out.shape == (1, 8, 128, 128)
    assert torch.allclose(out, wanted, atol=2e-3 * float(wanted.abs().max()))


def test_fit_is_the_overlap_of_the_told_box_with_the_true_one() -> None:
    true = np.array([[0.1, -0.2, 0.0, 0.0, 0.0, 1.0]], np.float32)
    beside = true + np.array([[0.0, 0.5 / 1.6, 0.0, 0.0, 0.0, 0.0]], np.float32)  # half a metre to the left
    longer = true + np.array([[0.0, 0.0, math.log(1.25), 0.0, 0.0, 0.0]], np.float32)
    across = np.array([[0.1, -0.2, 0.0, 0.0, 0.0, -1.0]], np.float32)
    assert _fit(true, true, 1.6) == pytest.approx([1.0])
    assert _fit(beside, true, 1.6) == pytest.approx([(1.85 - 0.5) / (1.85 + 0.5)], rel=1e-5)
    assert _fit(longer, true, 1.6) == pytest.approx([0.8], rel=1e-5)
    assert _fit(across, true, 1.6) == pytest.approx([1.85**2 / (2 * 4.5 * 1.85 - 1.85**2)], rel=1e-5)


def test_the_fit_is_learned_where_cars_are() -> None:
    car = np.array([[10.0, 5.0, 4.5, 1.85, 0.0]])
    out = torch.zeros(1, 8, 128, 128, requires_grad=True)
    (slope,) = torch.autograd.grad(loss_of(out, targets([car])), out)
    out = out.detach()
    at = [round((v + 102.4) / 1.6 - 0.5) for v in (10.0, 5.0)]
    assert slope[0, 7].nonzero().tolist() == [[at[0] + i, at[1] + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]
    assert float(loss_of(out[:, :7], targets([car]))) < float(loss_of(out, targets([car])))


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_every_part_learns(fleet: Frames, precision: str) -> None:
    net = network().train()
    loss, slopes = gradients(net, draw_batch(fleet, Recipe(batch=2), 1, 0), CPU, None, precision)  # type: ignore[arg-type]
    assert math.isfinite(loss)
    silent = [name for (name, _), g in zip(net.named_parameters(), slopes, strict=True) if not g.any()]
    assert silent == []
    assert all(g.dtype == torch.float32 and bool(g.isfinite().all()) for g in slopes)


def test_half_the_digits_give_nearly_the_same_loss(fleet: Frames) -> None:
    net, batch = network().train(), draw_batch(fleet, Recipe(batch=2), 1, 0)

    def loss(half: bool) -> float:
        with torch.autocast("cpu", torch.bfloat16, enabled=half), torch.no_grad():
            return float(step_loss(net, batch, CPU))

    assert loss(half=True) == pytest.approx(loss(half=False), rel=0.02)
    assert loss(half=True) != loss(half=False)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("varied", 1.5, "varied is 1.5, must be 0 to 1"),
        ("precision", "half", "precision is 'half', must be float32 or bfloat16"),
    ],
)
def test_a_recipe_names_what_is_wrong(field: str, value: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Recipe(**{field: value})  # type: ignore[arg-type]
