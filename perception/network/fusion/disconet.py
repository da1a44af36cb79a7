"""DiscoNet's fusion (Li et al., NeurIPS 2021), written from its description.

A small edge network gives one logit per agent and cell from the ego's features beside the agent's; a softmax over
the agents that take part weighs them.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)
from torch.nn.utils.fusion import fuse_linear_bn_eval

from sortie.perception.geometry import CHANNELS
from sortie.perception.network.fusion.base import PerCell, weighted_sum


class EdgeWeights(nn.Module):
    """One logit ≥ 0 per row and agent, by layers a cell with batch norm on all but the last.

    Of 80 channels, 160 → 128 → 32 → 8 → 1; of others, which are of finer cells, 2 c → 24 → 16 → 8 → 1.
    """

    def __init__(self, channels: int = CHANNELS) -> None:
        super().__init__()
        self.channels = channels
        widths = (2 * channels, 128, 32, 8) if channels == CHANNELS else (2 * channels, 24, 16, 8)
        self.layers = nn.ModuleList(nn.Linear(a, b, bias=False) for a, b in pairwise(widths))
        self.norms = nn.ModuleList(nn.BatchNorm1d(b) for b in widths[1:])
        self.last = nn.Linear(widths[-1], 1)

    def forward(self, features: Tensor) -> Tensor:
        """[agents, p, channels], the ego first → [agents, p]."""
        first, norm = self.layers[0], self.norms[0]
        # the ego's half of the first layer is the same beside every agent
        ego = F.linear(features[0], first.weight[:, : self.channels])  # type: ignore[index]
        x = F.linear(features, first.weight[:, self.channels :], first.bias)  # type: ignore[index,arg-type]
        x += ego
        x = F.relu(norm(x.flatten(0, 1)), inplace=True)
        for layer, norm in zip(list(self.layers)[1:], list(self.norms)[1:], strict=True):
            x = F.relu(norm(layer(x)), inplace=True)
        logit: Tensor = F.relu(self.last(x)).view(features.shape[:2])
        return logit


class DiscoNet(PerCell):
    """Softmax over agents per cell; a link's weight multiplies its softmax weight."""

    name = "disconet"
    about = "an edge network's softmax over agents, cell by cell (DiscoNet, without its distillation)"

    def __init__(self, channels: int = CHANNELS) -> None:
        super().__init__()
        self.edge = EdgeWeights(channels)

    def weights(self, features: Tensor, part: Tensor, weight: Tensor) -> Tensor:
        """Each agent's softmax weight, [agents, p]; as for `mix`."""
        return softmax(self.edge(features), part, weight)

    def mix(self, features: Tensor, part: Tensor, weight: Tensor) -> Tensor:
        return weighted_sum(self.weights(features, part, weight), features)

    def fold(self) -> None:
        edge: Any = self.edge
        for i, (layer, norm) in enumerate(zip(edge.layers, edge.norms, strict=True)):
            edge.layers[i] = fuse_linear_bn_eval(layer, norm)
            edge.norms[i] = nn.Identity()


def softmax(logit: Tensor, part: Tensor, weight: Tensor) -> Tensor:
    """Each agent's softmax weight from the edge network's logits, all [agents, p]; a link's weight multiplies it."""
    return (logit + weight.clamp_min(1e-12).log()).masked_fill(~part, -math.inf).softmax(dim=0)
