"""The detector's network: encode one drone's bird's-eye image, fuse what came from others, find cars.

Grids are level and heading-aligned (x forward along rows, y left along columns, the drone in the middle,
±102.4 m): image 256², features 80 × 64 × 64 (3.2 m cells), heads 128² (1.6 m). Features are rounded to
float16 where they leave the encoder, shared or not, as that is what the radio carries.

Fusion is DiscoNet's (Li et al., NeurIPS 2021), written from its description: a small edge network gives
one logit per agent and cell from the ego's features beside the agent's, a softmax over agents weighs them.
"""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)
from torch.nn.utils.fusion import fuse_conv_bn_eval

from perception.bev import HALF_EXTENT_M, ground_points

CHANNELS = 80
CELLS = 64
CELL_M = 2 * HALF_EXTENT_M / CELLS
HEAD_PX = 128
HEAD_M = 2 * HALF_EXTENT_M / HEAD_PX
UnsentCells = Literal["masked", "zero"]

REFERENCE_SIZE_M = (4.5, 1.85)
"""Length and width for which the size head says 0."""


def _conv(c_in: int, c_out: int, kernel: int = 3, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    pad = dilation * (kernel // 2)
    return nn.Sequential(
        nn.Conv2d(c_in, c_out, kernel, stride, pad, dilation, bias=False), nn.BatchNorm2d(c_out), nn.ReLU(inplace=True)
    )


class Encoder(nn.Module):
    """Bird's-eye image uint8 [n, 4, 256, 256] → features [n, 80, 64, 64], float32 that is exact in float16."""

    place: Tensor

    def __init__(self) -> None:
        super().__init__()
        ground = ground_points().permute(2, 0, 1) / HALF_EXTENT_M
        self.register_buffer("place", torch.cat([ground, ground.norm(dim=0, keepdim=True)])[None], persistent=False)
        self.stem = _conv(7, 24, 5, 2)
        self.down = nn.Sequential(_conv(24, 40), _conv(40, CHANNELS, 3, 2))
        self.body = nn.ModuleList([_conv(CHANNELS, CHANNELS, dilation=2), _conv(CHANNELS, CHANNELS)])

    def forward(self, image: Tensor) -> Tensor:
        seen = image[:, 3:].float() / 255.0
        rgb = (image[:, :3].float() / 255.0 - 0.42) * 4.0 * seen
        x = torch.cat([rgb, seen, self.place.expand(len(image), -1, -1, -1)], dim=1)
        x = self.down(self.stem(x))
        for layer in self.body:
            x = x + layer(x)
        rounded: Tensor = x + (x.half().float() - x).detach()  # straight through backward
        return rounded


class EdgeWeights(nn.Module):
    """One logit ≥ 0 per cell for (ego, agent): 1×1 convolutions 160 → 128 → 32 → 8 → 1."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(2 * CHANNELS, 128, 1, bias=False)
        self.norm = nn.BatchNorm2d(128)
        self.rest = nn.Sequential(_conv(128, 32, 1), _conv(32, 8, 1), nn.Conv2d(8, 1, 1), nn.ReLU())

    def forward(self, ego: Tensor, agent: Tensor) -> Tensor:
        """[n, 80, h, w] each → [n, 1, h, w]. `ego` may be [1, …] for many agents: its half is computed once."""
        half_ego = F.conv2d(ego, self.first.weight[:, :CHANNELS])
        half_agent = F.conv2d(agent, self.first.weight[:, CHANNELS:], self.first.bias)
        out: Tensor = self.rest(F.relu(self.norm(half_agent.add_(half_ego)), inplace=True))
        return out


class Head(nn.Module):
    """Fused features → [n, 7, 128, 128]: heat logit, offset (x, y) in cells, log size (length, width), sin 2ψ, cos 2ψ."""

    def __init__(self) -> None:
        super().__init__()
        self.join = _conv(CHANNELS, CHANNELS)
        self.up = nn.Sequential(
            nn.ConvTranspose2d(CHANNELS, 40, 2, 2, bias=False), nn.BatchNorm2d(40), nn.ReLU(inplace=True)
        )
        self.fine = _conv(40, 40)
        self.out = nn.Conv2d(40, 7, 1)
        with torch.no_grad():
            self.out.bias.zero_()  # type: ignore[union-attr]
            self.out.bias[0] = -4.0  # type: ignore[index]

    def forward(self, fused: Tensor) -> Tensor:
        x = self.up(fused + self.join(fused))
        out: Tensor = self.out(x + self.fine(x))
        return out


class CarNet(nn.Module):
    """Encoder, edge network and head, about 0.27 M parameters."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = Encoder()
        self.edge = EdgeWeights()
        self.head = Head()
        nn.Module.to(self, memory_format=torch.channels_last)  # type: ignore[call-overload]  # a third faster on a CPU

    def fuse(
        self, ego: Tensor, peers: Tensor, sent: Tensor, inside: Tensor, weight: Tensor, unsent: UnsentCells
    ) -> Tensor:
        """Fuse one ego with k peers whose maps already lie in its frame.

        Args:
            ego: [1, 80, 64, 64]; peers: [k, 80, 64, 64], zero where not sent.
            sent: [k, 1, 64, 64], True where the peer's cell arrived.
            inside: [k, 1, 64, 64], True where the peer's grid covers the cell.
            weight: [k], each link's fusion weight; it multiplies the softmax weight, and 0 leaves the peer out.
            unsent: "masked": a cell that was not sent has no say; "zero": it takes part as zeros (inside the peer's grid).

        Returns:
            [1, 80, 64, 64].
        """
        if not len(peers):
            return ego
        takes_part = (inside if unsent == "zero" else sent) & (weight > 0)[:, None, None, None]
        # Where no peer has a say the ego's features stay as they are: under a budget, most cells.
        at = takes_part.any(dim=0).flatten().nonzero().squeeze(1)
        if not len(at):
            return ego
        every = torch.cat([ego, peers]).flatten(2)[:, :, None, at]
        logit = self.edge(every[:1], every)
        bias = torch.where(takes_part, weight.clamp_min(1e-12).log()[:, None, None, None], -math.inf)
        logit[1:] += bias.flatten(2)[:, :, None, at]
        mixed = (logit.softmax(dim=0) * every).sum(dim=0)
        return ego.flatten(2).index_copy(2, at, mixed[:, 0][None]).view_as(ego)


def warp(features: Tensor, sent: Tensor, ego_pose: Tensor, peer_pose: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Peers' maps resampled on the ego's grid by estimated poses.

    Args:
        features: [k, c, 64, 64]; sent: [k, 1, 64, 64] bool.
        ego_pose: [3] or [k, 3] and peer_pose: [k, 3], x, y, yaw in ENU.

    Returns:
        features [k, c, 64, 64] (zero where not sent), sent [k, 1, 64, 64] bool, inside [k, 1, 64, 64] bool. A cell
        counts as sent where at least half of its bilinear support was; its value is the mean of what was sent.
    """
    k, channels = features.shape[:2]
    delta = ego_pose - peer_pose
    c, s = torch.cos(peer_pose[:, 2]), torch.sin(peer_pose[:, 2])
    tx, ty = c * delta[:, 0] + s * delta[:, 1], c * delta[:, 1] - s * delta[:, 0]
    cd, sd = torch.cos(delta[:, 2]), torch.sin(delta[:, 2])
    # a point (x, y) of the ego's grid lies at R(Δψ)(x, y) + t in the peer's; in cells, from the centre of cell (0, 0)
    middle = (CELLS - 1) / 2
    axis = torch.arange(CELLS, device=features.device) - middle
    x, y = (plane[None] for plane in torch.meshgrid(axis, axis, indexing="ij"))
    cd, sd, tx, ty = (v[:, None, None] for v in (cd, sd, tx / CELL_M + middle, ty / CELL_M + middle))
    row, column = cd * x - sd * y + tx, sd * x + cd * y + ty
    half = CELLS - 0.5
    inside = (row >= -0.5) & (row <= half) & (column >= -0.5) & (column <= half)
    taps, weights = [], []
    base = torch.arange(k, device=features.device)[:, None, None] * CELLS**2
    mask = sent.flatten()
    for i in (row.floor(), row.floor() + 1):
        for j in (column.floor(), column.floor() + 1):
            there = (i >= 0) & (i < CELLS) & (j >= 0) & (j < CELLS)
            cell = (i.clamp(0, CELLS - 1) * CELLS + j.clamp(0, CELLS - 1)).long() + base
            taps.append(cell)
            weights.append((1 - (row - i).abs()) * (1 - (column - j).abs()) * (there & mask[cell]))
    support = torch.stack(weights, dim=-1)
    share = support.sum(dim=-1, keepdim=True)
    arrived = (share[..., 0] >= 0.5) & inside
    support = support / share.clamp_min(0.5) * arrived[..., None]
    # a weighted sum of four rows of the peer's table of cells, per cell: what embedding_bag is fast at
    table = features.permute(0, 2, 3, 1).reshape(k * CELLS**2, channels)
    moved = F.embedding_bag(
        torch.stack(taps, dim=-1).view(-1, 4), table, mode="sum", per_sample_weights=support.view(-1, 4)
    )
    moved = moved.view(k, CELLS, CELLS, channels).permute(0, 3, 1, 2)
    return moved, arrived[:, None], inside[:, None]


def decode(out: Tensor, threshold: float, limit: int = 200) -> Tensor:
    """One head output [7, 128, 128] → boxes [m, 6] in the ego's frame: x forward, y left, length, width, yaw, score.

    Peaks are local maxima of the heat map over 3 × 3 cells, at or above `threshold`, at most `limit`, best first.
    """
    heat = out[:1].sigmoid()
    peak = (heat >= F.max_pool2d(heat[None], 3, 1, 1)[0]) & (heat >= threshold)
    flat = peak[0].flatten().nonzero().squeeze(1)
    score = heat.flatten()[flat]
    order = score.argsort(descending=True, stable=True)[:limit]
    flat, score = flat[order], score[order]
    values = out[1:].flatten(1)[:, flat]
    row, column = flat // HEAD_PX, flat % HEAD_PX
    x = (row + 0.5 + values[0]) * HEAD_M - HALF_EXTENT_M
    y = (column + 0.5 + values[1]) * HEAD_M - HALF_EXTENT_M
    size = [REFERENCE_SIZE_M[i] * values[2 + i].clamp(-1, 1).exp() for i in (0, 1)]
    yaw = 0.5 * torch.atan2(values[4], values[5])
    return torch.stack([x, y, *size, yaw, score], dim=1)


def folded(net: CarNet) -> CarNet:
    """A copy for inference, its batch norms folded into the convolutions before them (a seventh faster, equal to rounding)."""
    net = copy.deepcopy(net).eval()
    for layer in list(net.modules()):
        if isinstance(layer, nn.Sequential) and len(layer) > 1 and isinstance(layer[1], nn.BatchNorm2d):
            conv: Any = layer[0]
            layer[0] = fuse_conv_bn_eval(conv, layer[1], transpose=isinstance(conv, nn.ConvTranspose2d))
            layer[1] = nn.Identity()
    net.edge.first = fuse_conv_bn_eval(net.edge.first, net.edge.norm)
    net.edge.norm = nn.Identity()  # type: ignore[assignment]
    return net


def save_weights(net: CarNet, path: Path, metadata: dict[str, str]) -> None:
    """Write every tensor of `net` to a safetensors file, under a temporary name first."""
    from safetensors.torch import save_file

    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    save_file(
        {k: v.contiguous() for k, v in net.state_dict().items() if v.dtype.is_floating_point}, part, metadata=metadata
    )
    part.chmod(0o644)  # the library makes it private
    part.replace(path)


def load_weights(path: Path) -> CarNet:
    """A network in evaluation mode from a safetensors file.

    Raises:
        ValueError: naming the file, and the tensor that is missing, unknown or of another shape.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    if not path.is_file():
        raise ValueError(f"{path}: no such weights file; `sortie train` makes one")
    try:
        found = load_file(path)
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: not a safetensors file ({error})") from None
    net = CarNet()
    wanted = {k: v for k, v in net.state_dict().items() if v.dtype.is_floating_point}
    for name, tensor in wanted.items():
        if name not in found:
            raise ValueError(f"{path}: tensor {name} is missing")
        if found[name].shape != tensor.shape:
            raise ValueError(f"{path}: tensor {name} has shape {list(found[name].shape)}, must be {list(tensor.shape)}")
        if not bool(torch.isfinite(found[name]).all()):
            raise ValueError(f"{path}: tensor {name} holds values that are not finite")
    extra = sorted(set(found) - set(wanted))
    if extra:
        raise ValueError(f"{path}: tensor {extra[0]} is not part of the network")
    net.load_state_dict(found, strict=False)
    return net.eval()
