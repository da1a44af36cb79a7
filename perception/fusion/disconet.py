"""DiscoNet's fusion (Li et al., NeurIPS 2021), written from its description.

A small edge network gives one logit per agent and cell from the ego's features beside the agent's; a softmax over
the agents that take part weighs them.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)
from torch.nn.utils.fusion import fuse_linear_bn_eval

from perception.fusion.base import Fusion
from perception.geometry import CHANNELS


class EdgeWeights(nn.Module):
    """One logit ≥ 0 per row and agent: per-cell layers 160 → 128 → 32 → 8 → 1, batch norm on the first three."""

    def __init__(self) -> None:
        super().__init__()
        widths = (2 * CHANNELS, 128, 32, 8)
        self.layers = nn.ModuleList(nn.Linear(a, b, bias=False) for a, b in pairwise(widths))
        self.norms = nn.ModuleList(nn.BatchNorm1d(b) for b in widths[1:])
        self.last = nn.Linear(widths[-1], 1)

    def forward(self, rows: Tensor) -> Tensor:
        """[p, agents, 80], the ego first → [p, agents]."""
        first, norm = self.layers[0], self.norms[0]
        # the ego's half of the first layer is the same beside every agent
        ego = F.linear(rows[:, :1], first.weight[:, :CHANNELS])  # type: ignore[index]
        x = F.linear(rows, first.weight[:, CHANNELS:], first.bias) + ego  # type: ignore[index,arg-type]
        x = F.relu(norm(x.flatten(0, 1)), inplace=True)
        for layer, norm in zip(list(self.layers)[1:], list(self.norms)[1:], strict=True):
            x = F.relu(norm(layer(x)), inplace=True)
        logit: Tensor = F.relu(self.last(x)).view(rows.shape[:2])
        return logit


class DiscoNet(Fusion):
    """Softmax over agents per cell; a link's weight multiplies its softmax weight."""

    name = "disconet"

    def __init__(self) -> None:
        super().__init__()
        self.edge = EdgeWeights()

    def forward(self, agents: Tensor, takes_part: Tensor, weight: Tensor) -> Tensor:
        n, many, channels, height, width = agents.shape
        rows = agents.permute(0, 3, 4, 1, 2).reshape(-1, many, channels)
        part = takes_part.permute(0, 2, 3, 1).reshape(-1, many)
        # where no peer has a say the ego's features stay as they are: under a budget, most cells
        at = part[:, 1:].any(dim=1).nonzero().squeeze(1)
        if not len(at):
            return agents[:, 0]
        said, part = rows[at], part[at]
        bias = weight.clamp_min(1e-12).log()[torch.div(at, height * width, rounding_mode="floor")]
        logit = (self.edge(said) + bias).masked_fill(~part, -math.inf)
        mixed = torch.einsum("pa,pac->pc", logit.softmax(dim=1), said)
        out = rows[:, 0].index_copy(0, at, mixed)
        return out.view(n, height, width, channels).permute(0, 3, 1, 2)

    def fold(self) -> None:
        edge: Any = self.edge
        for i, (layer, norm) in enumerate(zip(edge.layers, edge.norms, strict=True)):
            edge.layers[i] = fuse_linear_bn_eval(layer, norm)
            edge.norms[i] = nn.Identity()
