"""Warp, fusion, decoding and weights; the network as it is flown against the one that was trained; sharp images."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from perception_examples import capture
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812
from wrong_rows import wrong_rows

from sortie.perception.errors import InputError
from sortie.perception.geometry import CELLS, CHANNELS, FULL, Cameras, Geometry
from sortie.perception.network.bev import lift
from sortie.perception.network.checkpoint import load_weights, read_config, save_weights
from sortie.perception.network.decode import decode
from sortie.perception.network.fusion.base import takes_part
from sortie.perception.network.inference import _coloured, folded
from sortie.perception.network.model import CarNet, ModelConfig, colours
from sortie.perception.network.warp import warp
from sortie.perception.network.winograd import WinogradReLU, suits
from sortie.perception.scene.render import camera_axes

CELL_M = FULL.cell_m
EVERYWHERE = torch.ones(1, 1, CELLS, CELLS, dtype=torch.bool)


@pytest.fixture(scope="module")
def net() -> CarNet:
    torch.manual_seed(3)
    return CarNet().eval()


def features(seed: int, count: int) -> torch.Tensor:
    return torch.randn(count, CHANNELS, CELLS, CELLS, generator=torch.Generator().manual_seed(seed))


def world_map(pose: tuple[float, float, float]) -> torch.Tensor:
    """[1, 2, 64, 64]: each cell's own place in the world."""
    axis = (torch.arange(CELLS) + 0.5 - CELLS / 2) * CELL_M
    f, s = torch.meshgrid(axis, axis, indexing="ij")
    x, y, yaw = pose
    return torch.stack([x + math.cos(yaw) * f - math.sin(yaw) * s, y + math.sin(yaw) * f + math.cos(yaw) * s])[None]


@pytest.mark.parametrize("peer", [(5.0, -7.0, 0.4), (20.0, 3.0, -1.2), (-10.0, 30.0, 2.8), (5.0, 13.0, 0.4)])
def test_warp_brings_every_cell_to_its_place(peer: tuple[float, float, float]) -> None:
    ego = (5.0, -7.0, 0.4)
    moved, arrived, inside = warp(world_map(peer), EVERYWHERE, torch.tensor(ego), torch.tensor([peer]), CELL_M)
    well_inside = (world_map(ego)[0] - torch.tensor(peer[:2])[:, None, None]).norm(dim=0) < 30 * CELL_M
    assert arrived[0, 0][well_inside].all()
    assert (moved[0] - world_map(ego)[0]).abs()[:, well_inside].max() < 1e-3
    assert (inside | ~arrived).all()


def test_unsent_cells_do_not_arrive_and_do_not_dilute_their_neighbours() -> None:
    sent = EVERYWHERE.clone()
    sent[..., :32] = False
    ego, peer = torch.tensor([0.0, 0.0, 0.0]), torch.tensor([[0.0, 1.0, 0.0]])
    moved, arrived, _ = warp(torch.full((1, 4, CELLS, CELLS), 7.0), sent, ego, peer, CELL_M)
    assert moved[arrived.expand_as(moved)].unique().tolist() == pytest.approx([7.0])
    assert (moved[~arrived.expand_as(moved)] == 0).all()
    assert arrived[..., 40:60].all()
    assert not arrived[..., :30].any()


def test_disconet_is_the_stated_formula_and_peers_have_no_order(net: CarNet) -> None:
    ego, peers = features(1, 1), features(2, 3)
    sent = torch.rand(3, CELLS, CELLS, generator=torch.Generator().manual_seed(9)) > 0.4
    peers, weight = peers * sent[:, None], torch.tensor([0.5, 1.0, 0.25])

    def fused(order: list[int]) -> torch.Tensor:
        part = takes_part(sent[None, order], torch.ones_like(sent)[None], weight[None, order], "masked")
        maps = torch.cat([ego, peers[order]])[None]
        out: torch.Tensor = net.fusion(maps, part, torch.cat([torch.ones(1), weight[order]])[None])
        return out

    def edge(agent: torch.Tensor) -> torch.Tensor:
        own = ego.flatten(2)[0].T  # [4096, 80]
        return net.fusion.edge(torch.stack([own, agent.flatten(1).T]))[1].view(1, 1, CELLS, CELLS).exp()

    with torch.inference_mode():
        parts = [edge(ego[0]), *(edge(p) * w * s for p, w, s in zip(peers, weight, sent, strict=True))]
        plain = sum(q * p for q, p in zip(parts, [ego, *peers], strict=True)) / sum(parts)
        assert torch.allclose(fused([0, 1, 2]), plain, atol=1e-4)
        assert torch.allclose(fused([0, 1, 2]), fused([2, 1, 0]), atol=1e-5)


def test_features_survive_the_radio_unchanged(net: CarNet) -> None:
    image = torch.randint(0, 255, (1, 4, 256, 256), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        out = net.encoder(image)
    assert out.shape == (1, CHANNELS, CELLS, CELLS)
    assert torch.equal(out, out.half().float())


@pytest.mark.parametrize("threshold", [0.0, 0.05, 0.5])
def test_peaks_are_the_maxima_of_their_neighbourhood(threshold: float) -> None:
    """By its definition over the whole map: at the border, where neighbours tie, and in plateaus."""
    out = torch.randn(7, 128, 128, generator=torch.Generator().manual_seed(4))
    out[0, 0, 0] = out[0, 127, 127] = out[0, 0, 127] = out[0, 127, 64] = 6.0
    out[0, 40:43, 40:43] = 5.0
    heat = out[:1].sigmoid()
    peak = (heat == torch.nn.functional.max_pool2d(heat[None], 3, 1, 1)[0]) & (heat >= threshold)
    found = decode(out, threshold, limit=10_000)
    assert len(found) == int(peak.sum()) > 20
    assert torch.equal(found[:, 5], heat[peak].sort(descending=True).values)
    row, column = peak[0].nonzero().T[:, heat[peak].argsort(descending=True, stable=True)]
    assert torch.allclose(found[:, 0], (row + 0.5 + out[1][row, column]) * FULL.head_m - FULL.half_extent_m, atol=1e-4)
    assert torch.allclose(
        found[:, 1], (column + 0.5 + out[2][row, column]) * FULL.head_m - FULL.half_extent_m, atol=1e-4
    )


def test_weights_come_back_as_they_went(net: CarNet, tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    save_weights(net, path, {"runs": []})
    again = load_weights(path)
    assert not again.training
    for name, value in net.state_dict().items():
        assert torch.equal(again.state_dict()[name], value), name
    assert [p.name for p in tmp_path.iterdir()] == ["w.safetensors"]


def test_broken_weights_name_the_file_and_the_tensor(net: CarNet, tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"

    def refusal() -> str:
        with pytest.raises(ValueError) as caught:
            load_weights(path)
        return str(caught.value).replace(str(path), "PATH")

    assert refusal() == "PATH: no such weights file; `python -m research train` makes one"
    path.write_bytes(b"\x80\x04K\x01.")
    assert refusal().startswith("PATH: not a weights file of this project (")
    save_weights(net, path, {})
    whole = load_file(path)
    name = "head.out.weight"
    save_file({k: v for k, v in whole.items() if k != name}, path)
    assert refusal() == "PATH: tensor head.out.weight is missing"
    save_file({**whole, name: whole[name][:3].contiguous()}, path)
    assert refusal() == "PATH: tensor head.out.weight has shape [3, 40, 1, 1], must be [7, 40, 1, 1]"
    save_file({**whole, "extra": torch.zeros(1)}, path)
    assert refusal() == "PATH: tensor extra is not part of the network"
    save_file({**whole, name: whole[name] * float("nan")}, path)
    assert refusal() == "PATH: tensor head.out.weight holds values that are not finite"


def layer(c: int, o: int, dilation: int = 1, seed: int = 0) -> nn.Conv2d:
    torch.manual_seed(seed)
    return nn.Conv2d(c, o, 3, padding=dilation, dilation=dilation)


def exact(conv: nn.Conv2d, x: Tensor) -> Tensor:
    """Bias, convolution and ReLU in doubles."""
    assert conv.bias is not None
    out = F.conv2d(x.double(), conv.weight.double(), conv.bias.double(), 1, conv.padding, conv.dilation)
    return F.relu(out)


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    n=st.integers(1, 3),
    c=st.sampled_from([1, 3, 8, 24, 40]),
    o=st.sampled_from([1, 5, 16, 40]),
    tiles=st.tuples(st.integers(1, 6), st.integers(1, 6)),
    dilation=st.sampled_from([1, 2, 3]),
    seed=st.integers(0, 2**16),
)
def test_winograd_is_the_convolution(n: int, c: int, o: int, tiles: tuple[int, int], dilation: int, seed: int) -> None:
    conv = layer(c, o, dilation, seed)
    x = torch.randn(n, c, tiles[0] * 4 * dilation, tiles[1] * 4 * dilation)
    with torch.inference_mode():
        got = WinogradReLU(conv)(x)
        want = exact(conv, x)
    assert got.shape == want.shape
    assert torch.allclose(got.double(), want, atol=1e-5 * float(want.max().clamp_min(1.0)))


@pytest.mark.parametrize("dilation", [1, 2])
def test_a_residual_is_added(dilation: int) -> None:
    conv = layer(16, 16, dilation)
    x = torch.randn(2, 16, 32, 24)
    with torch.inference_mode():
        got = WinogradReLU(conv, residual=True)(x)
        assert torch.allclose(got.double(), x + exact(conv, x), atol=1e-5)


@pytest.mark.parametrize("shape", [(1, 8, 18, 16), (1, 8, 16, 20)])
def test_maps_of_no_whole_number_of_tiles_are_convolved_plainly(shape: tuple[int, ...]) -> None:
    conv, x = layer(8, 8, 2), torch.randn(shape)
    with torch.inference_mode():
        assert torch.equal(WinogradReLU(conv)(x), F.relu(conv(x)))
        assert torch.equal(WinogradReLU(conv, residual=True)(x), x + F.relu(conv(x)))


def test_a_gradient_is_followed() -> None:
    conv, x = layer(8, 8), torch.randn(1, 8, 16, 16)
    WinogradReLU(conv)(x).sum().backward()
    assert conv.weight.grad is not None
    assert float(conv.weight.grad.abs().sum()) > 0.0


def test_what_suits() -> None:
    rows = [
        (nn.Conv2d(8, 8, 3, padding=1), True),
        (nn.Conv2d(8, 8, 3, padding=2, dilation=2), True),
        (nn.Conv2d(8, 8, 3, padding=3, dilation=3), True),
        (nn.Conv2d(8, 8, 3, padding=(1, 2), dilation=(1, 2)), False),
        (nn.Conv2d(8, 8, 3, padding=1, dilation=2), False),
        (nn.Conv2d(8, 8, 3, padding=0), False),
        (nn.Conv2d(8, 8, 3, stride=2, padding=1), False),
        (nn.Conv2d(8, 8, 5, padding=2), False),
        (nn.Conv2d(8, 8, 3, padding=1, groups=2), False),
        (nn.Conv2d(8, 8, 3, padding=1, bias=False), False),
        (nn.Conv2d(8, 8, 3, padding=1, padding_mode="reflect"), False),
        (nn.ConvTranspose2d(8, 8, 3, padding=1), False),
        (nn.ReLU(), False),
    ]

    def check(conv: nn.Module, fits: bool) -> None:
        assert suits(conv) is fits

    assert wrong_rows(rows, check) == {}


def lively(config: ModelConfig) -> CarNet:
    """A network whose batch norms do something."""
    torch.manual_seed(3)
    net = CarNet(config)
    for module in net.modules():
        if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.uniform_(module.bias, -0.3, 0.3)
            assert module.running_mean is not None
            assert module.running_var is not None
            module.running_mean.uniform_(-0.2, 0.2)
            module.running_var.uniform_(0.5, 2.0)
    return net.eval()


def test_the_network_that_flies_is_the_one_that_was_trained() -> None:
    net = lively(ModelConfig())
    before = {k: v.clone() for k, v in net.state_dict().items()}
    quick = folded(net)
    assert all(torch.equal(v, before[k]) for k, v in net.state_dict().items()), "folding leaves it as it was"
    image = torch.randint(0, 256, (2, 4, 256, 256), dtype=torch.uint8)
    image[:, 3] = torch.where(image[:, 3] > 40, 255, 0)
    with torch.inference_mode():
        features, quickly = net.encoder(image), quick.encoder(image)
        out, quick_out = net.head(features), quick.head(features)
    # features are rounded to float16 at the exchange: neighbours there, where the sums' last bits differ
    assert torch.allclose(features, quickly, rtol=2e-3, atol=1e-4)
    assert float((features != quickly).float().mean()) < 0.05
    assert torch.allclose(out, quick_out, atol=1e-4 * float(out.abs().max()))


def test_colours_are_the_same_to_the_bit_where_a_compiled_loop_reckons_them() -> None:
    image = torch.randint(0, 256, (2, 4, 64, 48), dtype=torch.uint8)
    assert torch.equal(_coloured(image), colours(image))


SHARP = Geometry(image_px=512)
NETWORK = ModelConfig(grid="fine", image_px=512)


def level(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Colours of a made ground: they rise by a level a metre ahead, by one to the left, and fall by a half for both."""
    return np.stack([128.0 + x_m, 128.0 + y_m, 128.0 - (x_m + y_m) / 2], axis=-1)


def pictures(cameras: Cameras, height_m: float) -> np.ndarray:
    """That ground in the pictures of a drone that hovers over the middle, by a pinhole in each pixel's centre."""
    column, row = np.meshgrid(np.arange(cameras.width_px) + 0.5, np.arange(cameras.height_px) + 0.5)
    lens = cameras.lens
    across = (2 * column / cameras.width_px - 1) * lens.half_h
    down = (2 * row / cameras.height_px - 1) * lens.half_v
    rays = np.stack([across, down, np.ones_like(down)], axis=-1) @ np.asarray(camera_axes(cameras), float)[:, None]
    far = height_m / np.maximum(-rays[..., 2], 1e-3)
    return np.clip(np.rint(level(rays[..., 0] * far, rays[..., 1] * far)), 0, 255).astype(np.uint8)


def test_a_sharp_image_averaged_over_two_by_two_pixels_is_the_usual_one() -> None:
    """And both are the ground: a plane of colours has in a pixel's middle what four quarters of it have on average."""
    images = []
    for geometry in (FULL, SHARP):
        c = capture()._replace(cameras=geometry.cameras)
        images.append(lift(pictures(c.cameras, 60.0)[None], [c], geometry)[0].double().numpy())
    usual, sharp = images
    assert (usual.shape, sharp.shape) == ((4, 256, 256), (4, 512, 512))
    averaged = sharp.reshape(4, 256, 2, 256, 2).mean(axis=(2, 4))
    axis = (np.arange(256) + 0.5) * 0.8 - 102.4
    x, y = np.meshgrid(axis, axis, indexing="ij")
    seen = (usual[3] == 255) & (averaged[3] == 255) & (np.hypot(x, y) < 70)
    assert seen.sum() > 0.9 * np.pi * (70 / 0.8) ** 2
    ground = level(x, y)[seen].T
    assert np.quantile(np.abs(averaged[:3, seen] - usual[:3, seen]), 0.999) < 1.1
    assert np.quantile(np.abs(usual[:3, seen] - ground), 0.999) < 1.1
    assert np.quantile(np.abs(averaged[:3, seen] - ground), 0.999) < 0.7, "rounding, averaged"
    assert np.abs((averaged[:3, seen] - ground).mean(axis=1)).max() < 0.05, "not even half a pixel aside, 0.2 levels"


def test_a_sharp_network_has_the_usual_features_and_one_layer_more() -> None:
    torch.manual_seed(2)
    usual, sharp = CarNet(ModelConfig(grid="fine")).eval(), CarNet(NETWORK).eval()
    image = torch.randint(0, 256, (1, 4, 512, 512), dtype=torch.uint8)
    with torch.inference_mode():
        assert sharp.encoder.stem(image).shape == (1, 16, 256, 256)
        features = sharp.encoder(image)
        assert features.shape == usual.encoder(image[..., ::2, ::2]).shape == (1, 80, 64, 64)
        quickly = folded(sharp).encoder(image)
        assert sharp.head(sharp.spread(features)).shape == (1, 8, 128, 128)
    assert torch.allclose(features, quickly, rtol=2e-3, atol=1e-4)
    shapes = [{k: v.shape for k, v in net.state_dict().items() if "encoder" not in k} for net in (usual, sharp)]
    assert shapes[0] == shapes[1]


def test_the_image_travels_with_the_weights_and_older_files_have_the_usual_one(tmp_path: Path) -> None:
    net = CarNet(NETWORK)
    save_weights(net, tmp_path / "sharp.safetensors")
    assert load_weights(tmp_path / "sharp.safetensors").config == NETWORK
    old = CarNet(ModelConfig(grid="fine"))
    model = {k: v for k, v in asdict(old.config).items() if k != "image_px"}
    tensors = {k: v.contiguous() for k, v in old.state_dict().items() if v.dtype.is_floating_point}
    save_file(tensors, tmp_path / "old.safetensors", metadata={"model": json.dumps(model)})
    assert load_weights(tmp_path / "old.safetensors").config == ModelConfig(grid="fine")
    save_file(tensors, tmp_path / "odd.safetensors", metadata={"model": json.dumps(model | {"image_px": 300})})
    with pytest.raises(InputError, match=r"odd\.safetensors: model\.image_px is 300, must be one of 256, 512"):
        read_config(tmp_path / "odd.safetensors")
