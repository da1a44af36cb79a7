"""Warp, fusion, decoding and weights: what must come out whatever the network has learned."""

import math
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from sortie.perception.geometry import CELLS, CHANNELS, FULL
from sortie.perception.network.checkpoint import load_weights, save_weights
from sortie.perception.network.decode import decode
from sortie.perception.network.fusion.base import UnsentCells, takes_part
from sortie.perception.network.model import CarNet
from sortie.perception.network.warp import warp as warp_by

CELL_M = FULL.cell_m

EVERYWHERE = torch.ones(1, 1, CELLS, CELLS, dtype=torch.bool)


@pytest.fixture(scope="module")
def net() -> CarNet:
    torch.manual_seed(3)
    return CarNet().eval()


def warp(
    maps: torch.Tensor, sent: torch.Tensor, ego: torch.Tensor, peer: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return warp_by(maps, sent, ego, peer, CELL_M)


def fuse(
    net: CarNet,
    ego: torch.Tensor,
    peers: torch.Tensor,
    sent: torch.Tensor,
    inside: torch.Tensor,
    weight: torch.Tensor,
    unsent: UnsentCells,
) -> torch.Tensor:
    """One ego [1, 80, 64, 64] with k peers [k, 80, 64, 64]."""
    part = takes_part(sent[None, :, 0], inside[None, :, 0], weight[None], unsent)
    out: torch.Tensor = net.fusion(torch.cat([ego, peers])[None], part, torch.cat([torch.ones(1), weight])[None])
    return out


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
    moved, arrived, inside = warp(world_map(peer), EVERYWHERE, torch.tensor(ego), torch.tensor([peer]))
    well_inside = (world_map(ego)[0] - torch.tensor(peer[:2])[:, None, None]).norm(dim=0) < 30 * CELL_M
    assert arrived[0, 0][well_inside].all()
    assert (moved[0] - world_map(ego)[0]).abs()[:, well_inside].max() < 1e-3
    assert (inside | ~arrived).all()


def test_unsent_cells_do_not_arrive_and_do_not_dilute_their_neighbours() -> None:
    sent = EVERYWHERE.clone()
    sent[..., :32] = False
    ego, peer = torch.tensor([0.0, 0.0, 0.0]), torch.tensor([[0.0, 1.0, 0.0]])
    moved, arrived, _ = warp(torch.full((1, 4, CELLS, CELLS), 7.0), sent, ego, peer)
    assert moved[arrived.expand_as(moved)].unique().tolist() == pytest.approx([7.0])
    assert (moved[~arrived.expand_as(moved)] == 0).all()
    assert arrived[..., 40:60].all()
    assert not arrived[..., :30].any()


def test_a_peer_that_is_absent_mute_or_weightless_changes_nothing(net: CarNet) -> None:
    ego, peers = features(1, 1), features(2, 2)
    sent = EVERYWHERE.expand(2, -1, -1, -1)
    one = torch.ones(2)
    with torch.inference_mode():
        assert torch.equal(fuse(net, ego, peers[:0], sent[:0], sent[:0], one[:0], "masked"), ego)
        assert torch.allclose(fuse(net, ego, 0 * peers, ~sent, sent, one, "masked"), ego, atol=1e-6)
        assert torch.allclose(fuse(net, ego, peers, sent, sent, 0 * one, "masked"), ego, atol=1e-6)
        first = fuse(net, ego, peers[:1], sent[:1], sent[:1], one[:1], "masked")
        both = fuse(net, ego, peers, sent, sent, torch.tensor([1.0, 0.0]), "masked")
    assert torch.allclose(first, both, atol=1e-6)
    assert not torch.allclose(first, ego, atol=1e-2)


def test_fusion_is_the_stated_formula_and_peers_have_no_order(net: CarNet) -> None:
    ego, peers = features(1, 1), features(2, 3)
    sent = torch.rand(3, 1, CELLS, CELLS, generator=torch.Generator().manual_seed(9)) > 0.4
    peers = peers * sent
    weight = torch.tensor([0.5, 1.0, 0.25])
    with torch.inference_mode():
        fused = fuse(net, ego, peers, sent, torch.ones_like(sent), weight, "masked")
        back = fuse(net, ego, peers.flip(0), sent.flip(0), torch.ones_like(sent), weight.flip(0), "masked")
        own = ego.flatten(2)[0].T  # [4096, 80]

        def edge(agent: torch.Tensor) -> torch.Tensor:
            return net.fusion.edge(torch.stack([own, agent.flatten(1).T]))[1].view(1, 1, CELLS, CELLS)

        parts = [edge(ego[0]).exp()]
        parts += [edge(p).exp() * w * s for p, w, s in zip(peers, weight, sent, strict=True)]
        total = sum(parts)
        plain = (parts[0] * ego + sum(q * p for q, p in zip(parts[1:], peers, strict=True))) / total
    assert torch.allclose(fused, plain, atol=1e-4)
    assert torch.allclose(fused, back, atol=1e-5)


def test_zeros_dilute_where_a_mask_does_not(net: CarNet) -> None:
    ego, nothing = features(1, 1).abs(), torch.zeros(1, CHANNELS, CELLS, CELLS)
    with torch.inference_mode():
        zero = fuse(net, ego, nothing, ~EVERYWHERE, EVERYWHERE, torch.ones(1), "zero")
        full = features(4, 1)
        same = [fuse(net, ego, full, EVERYWHERE, EVERYWHERE, torch.ones(1), u) for u in ("zero", "masked")]
    assert (zero < ego).float().mean() > 0.95
    assert torch.equal(*same)


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
