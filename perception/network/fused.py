"""One ego's fused map from its own map and its peers': a function of tensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sortie.perception.joining import Pose
from sortie.perception.network.fusion.base import UnsentCells, takes_part
from sortie.perception.network.model import CarNet
from sortie.perception.network.warp import arriving, rows, support


class Peer(NamedTuple):
    """What is there of one peer."""

    pose: Pose
    """x, y, yaw that place its map in the world."""
    weight: float
    """Of the link, 0 … 1."""
    map: Tensor
    """[channels, n, n] on its own grid, as it is fused."""
    sent: Tensor
    """[64, 64] bool: the cells that came."""
    whole: Tensor | None = None
    """Its own map, by which it answers a handshake, where `map` is what was read from the codes of some cells."""


def fused_map(net: CarNet, pose: Pose, own: Tensor | None, peers: Sequence[Peer], unsent: UnsentCells) -> Tensor | None:
    """The fused map [1, channels, n, n] on the ego's grid; None where no peer takes part in any cell. For inference mode.

    Args:
        pose: x, y, yaw of the ego, ENU.
        own: [channels, n, n]; None of an ego without a look of its own, whose peers are fused alone.
        peers: one or more.
        unsent: as for `takes_part`.
    """
    # relative to the ego, so that float32 keeps millimetres kilometres from the origin
    x, y, yaw = pose
    there = torch.tensor([(px - x, py - y, pyaw) for (px, py, pyaw), *_ in peers])
    config = net.config
    under = support(torch.tensor((0.0, 0.0, yaw)), there, config.fused_cell_m, config.fused_cells)
    sent = net.sent(torch.stack([p.sent.flatten() for p in peers]))
    weights, arrived = arriving(under, sent)
    weight = torch.tensor([[p.weight for p in peers]])
    part = takes_part(arrived[None], under.inside[None], weight, unsent)
    if not bool(part[:, 1:].any()):
        return None
    tables = [p.map.permute(1, 2, 0).flatten(0, 1) for p in peers]
    offset = under.offset.flatten(1, 2)
    taps = list(zip(tables, under.cells.flatten(1, 2), weights.flatten(1, 2), offset, under.turn[:, None], strict=True))

    def said(at: Tensor, out: Tensor) -> Tensor:
        """What each peer says in those cells, into `out` [k, p, c]; one peer after another, so that it stays in the cache."""
        for (table, cells, shares, lies, turn), into in zip(taps, out, strict=True):
            moved = rows(table, cells.index_select(0, at), shares.index_select(0, at))
            net.aligned(moved[None], lies.index_select(0, at)[None], turn, into[None])
        return out

    if own is None:
        return _without_own(net, said, part[0, 1:], arrived, weight[0])
    if net.fusion.weighs:
        whole = [p.map if p.whole is None else p.whole for p in peers]
        weight = net.fusion.weigh(own[None], torch.stack(whole)[None], weight)
    return _with_ego(net, own, said, part[0], weight[0])


Said = Callable[[Tensor, Tensor], Tensor]


def _with_ego(net: CarNet, own: Tensor, said: Said, part: Tensor, weight: Tensor) -> Tensor:
    """An ego's map [c, h, w] and what its k peers say; `part` [1 + k, h, w] and `weight` [k] as for `Fusion.fuse`."""
    table = own.permute(1, 2, 0).reshape(-1, len(own))

    def agents(at: Tensor) -> Tensor:
        out = torch.empty(len(part), len(at), len(own))
        torch.index_select(table, 0, at, out=out[0])
        said(at, out[1:])
        return out

    return net.fusion.fuse(own, agents, part, F.pad(weight, (1, 0), value=1.0))


def _without_own(net: CarNet, said: Said, part: Tensor, arrived: Tensor, weight: Tensor) -> Tensor:
    """Peers alone: in each cell the one that counts most takes the ego's place.

    Args:
        part, arrived: [k, h, w] which peer takes part in which cell, and which cells it sent; weight: [k].
    """
    k, height, width = part.shape
    channels = net.config.fused_channels
    lead = (weight[:, None, None] * arrived).argmax(dim=0)  # of equals the first
    own = said(torch.arange(height * width), torch.empty(k, height * width, channels)).view(k, height, width, -1)
    own = own.gather(0, lead[None, ..., None].expand(1, -1, -1, channels))[0].permute(2, 0, 1)
    own = own * arrived.any(dim=0)
    follows = part & (torch.arange(k)[:, None, None] != lead)
    if not bool(follows.any()):
        return own[None]
    return _with_ego(net, own, said, torch.cat([torch.ones_like(part[:1]), follows]), weight / weight.max())
