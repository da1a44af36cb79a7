"""The fine network: exchanged cells spread over four, corrected for how they lie, fused and found in the head's cells."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from perception_examples import cross
from torch import Tensor

from research.benchmark.dataset import Frames
from research.paper.instrument import CarNetInstrument, CarNetView
from research.train.learn import _fit, draw_batch, gradients, loss_of, step_loss, targets
from research.train.recipe import Recipe
from sortie.perception.evaluation.sharing import Exchange
from sortie.perception.network import warp
from sortie.perception.network.checkpoint import load_weights, read_config, save_weights
from sortie.perception.network.decode import decode
from sortie.perception.network.detector import TorchDetector
from sortie.perception.network.fusion.base import takes_part
from sortie.perception.network.inference import folded
from sortie.perception.network.model import Align, CarNet, ModelConfig
from sortie.perception.network.warp import arriving, moved, support
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Share
from sortie.scenarios.schema import Perception, Scene, Target

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


def test_each_exchanged_cell_is_spread_by_itself() -> None:
    net = network()
    features = torch.rand(1, 80, 64, 64)
    sent = torch.rand(1, 64 * 64) < 0.3
    with torch.inference_mode():
        whole, part = net.spread(features), net.spread(features * sent.view(1, 1, 64, 64))
    assert whole.shape == (1, 40, 128, 128)
    wide = net.sent(sent).view(1, 1, 128, 128)
    assert torch.allclose(whole * wide, part * wide, atol=1e-6)
    assert wide[0, 0, 2 * 7 : 2 * 8, 2 * 9 : 2 * 10].eq(sent.view(64, 64)[7, 9]).all()
    assert CarNet().sent(sent) is sent  # a coarse network fuses what is exchanged


def test_where_cells_lie_between_a_peers_cells() -> None:
    ego, peer = torch.tensor([10.0, 0.0, 0.5]), torch.tensor([[10.0, 0.0, 0.5], [10.4, 0.0, 0.0], [10.0, 0.0, 0.8]])
    under = support(ego, peer, 1.6, 128)
    assert torch.allclose(under.offset[0], torch.zeros(128, 128, 2), atol=1e-4)  # it stands where the ego stands
    assert under.turn.tolist() == pytest.approx([0.0, -0.5, 0.3])
    level = support(torch.zeros(3), torch.tensor([[0.4, -0.6, 0.0]]), 1.6, 128)
    assert level.offset[0, 64, 64].tolist() == pytest.approx([-0.25, 0.375], abs=1e-5)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(3.2, 64), (1.6, 128)]), st.sampled_from([0.0, 5.0, 100.0, 300.0]))
def test_compiled_loops_lay_cells_as_tensors_do(seed: int, grid: tuple[float, int], spread_m: float) -> None:
    """Bit for bit, also where grids hardly overlap or not at all."""
    cell_m, n = grid
    rng = np.random.default_rng(seed)
    poses = torch.from_numpy(np.column_stack([rng.normal(0, spread_m, (3, 2)), rng.uniform(-7, 7, 3)])).float()
    if spread_m < 1.0:  # whole and half cells: some cells have exactly half of their support
        poses = torch.from_numpy(np.column_stack([rng.integers(-3, 4, (3, 2)) * cell_m / 2, np.zeros(3)])).float()
    sent = torch.from_numpy(rng.random((2, n * n)) < rng.random((2, 1)))
    seen: list[Sequence[Tensor]] = []

    def laid(place: Sequence[Any], *into: Any) -> None:
        seen.append([torch.from_numpy(v.copy()) for v in place])

    under = support(poses[0], poses[1:], cell_m, n)
    with mock.patch.object(warp, "_lay", lambda *of: laid(of[:4])):
        support(poses[0], poses[1:], cell_m, n)
    for compiled, plain in zip(under, warp._laid(seen[0], n), strict=False):
        assert torch.equal(compiled, plain)
    for compiled, plain in zip(arriving(under, sent), warp._arrived(under, sent), strict=True):
        assert torch.equal(compiled, plain)


@pytest.mark.parametrize("odd", [math.nan, math.inf])
def test_poses_that_are_not_finite_are_an_error(odd: float) -> None:
    peers = torch.tensor([[1.0, 2.0, 0.5], [odd, 0.0, 0.0]])
    with pytest.raises(ValueError, match=rf"^poses are \[0\.0, 0\.0, 0\.0\] and \[.*{odd}.*\], must be finite$"):
        support(torch.zeros(3), peers, 1.6, 128)


def test_the_correction_begins_as_none_and_leaves_silence() -> None:
    torch.manual_seed(0)
    align = Align(8)
    said = torch.rand(2, 30, 8)
    said[0, :10] = 0.0
    offset, turn = torch.rand(2, 30, 2) - 0.5, torch.tensor([0.0, 1.0])
    assert torch.equal(align(said, offset, turn), said)
    torch.nn.init.normal_(align.out.weight)
    torch.nn.init.normal_(align.out.bias)
    with torch.inference_mode():
        out = align(said, offset, turn)
        assert not out[0, :10].any()
        assert out[0, 10:].any()
        assert not torch.allclose(align(said, -offset, turn), out)
        assert not torch.allclose(align(said, offset, turn + 0.5), out)
        assert torch.allclose(align(said, offset, turn + 2 * math.pi), out, atol=1e-5)


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


def test_it_flies_as_the_harness_measures_it(tmp_path: Path) -> None:
    """One ego and three shares: in full, in part, and one that is trusted half."""
    scene = SceneModel(Scene(), Target(waypoints_m=((0, 0), (100, 0))), (-50, -50, 50, 50))
    save_weights(network(), tmp_path / "fine.safetensors")
    detector = TorchDetector(scene, Perception(), 1, tmp_path / "fine.safetensors")
    ego, *peers = cross(10.0, 20.0, 0.3)[:4]
    shares = [Share(peers[0], "features", 1.0, None, 1.0), Share(peers[1], "features", 0.05, None, 1.0)]
    shares.append(Share(peers[2], "features", 1.0, None, 0.5))
    (found,) = detector.detect([(ego, shares)])
    (alone,) = detector.detect([(ego, ())])
    known, net = detector._encode([ego, *peers]), detector._net
    with torch.inference_mode():
        maps = [known[c].maps.result() for c in (ego, *peers)]
        sent = torch.stack([detector._sent(s, known).flatten() for s in shares])
        assert int(sent[1].sum()) == int(0.05 * 4096)
        place = torch.tensor(
            [(c.est_pose[0] - ego.est_pose[0], c.est_pose[1] - ego.est_pose[1], c.est_pose[2]) for c in peers]
        )
        under = support(torch.tensor((0.0, 0.0, ego.est_pose[2])), place.float(), 1.6, 128)
        weights, arrived = arriving(under, net.sent(sent))
        rows = moved(torch.stack(maps[1:]), under, weights).permute(0, 2, 3, 1).flatten(1, 2)
        said = net.aligned(rows, under.offset.flatten(1, 2), under.turn).view(3, 128, 128, -1).permute(0, 3, 1, 2)
        trust = torch.tensor([[1.0, 1.0, 1.0, 0.5]])
        part = takes_part(arrived[None], under.inside[None], trust[:, 1:], "masked")
        out = net.head(net.fusion(torch.cat([maps[0][None], said])[None], part, trust))[0]
        wanted = detector._place(out, ego.est_pose)
    assert len(found) == len(wanted) > 50
    assert found.score == pytest.approx(wanted.score, abs=1e-4)
    assert not np.array_equal(found.score[:20], alone.score[:20])


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


def test_a_score_is_the_mean_of_heat_and_fit() -> None:
    out = torch.full((8, 128, 128), -20.0)
    out[1:7] = 0.0
    out[0, 40, 40], out[7, 40, 40] = math.log(0.9 / 0.1), math.log(0.4 / 0.6)
    (box,) = decode(out, 0.1)
    assert float(box[5]) == pytest.approx(math.sqrt(0.9 * 0.4))
    assert float(decode(out[:7], 0.1)[0, 5]) == pytest.approx(0.9)


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


def test_a_fusion_for_maps_of_eighty_channels_is_refused() -> None:
    with pytest.raises(
        ValueError, match="fusion is 'v2vnet' of a fine network, must be one of disconet, fcooper, none, late"
    ):
        CarNet(ModelConfig(grid="fine", fusion="v2vnet"))


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
