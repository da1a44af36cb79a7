"""Where2comm's fusion and its choice of cells (Hu et al., NeurIPS 2022), written from their description.

Attention over agents cell by cell, each agent's confidence as its prior; who sends what follows from the sender's
confidence C and, from a second round on, the receiver's request R = 1 − C.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sortie.perception.geometry import CHANNELS
from sortie.perception.network.fusion.base import PerCell, weighted_sum
from sortie.perception.network.fusion.traffic import LinkBytes, features_of

HEADS = 4


class Where2comm(PerCell):
    """Softmax over agents of query · key / √d, times the agent's confidence in the cell and its link's weight.

    Values are the features themselves, a quarter of the channels to each head; a per-cell residual layer follows,
    as far as the most trusted peer's weight goes.
    Receivers work out a peer's confidence from the features that came, so it costs no bytes.
    """

    name = "where2comm"
    about = "attention over agents cell by cell, a linear confidence as the prior (Where2comm, without its calibrated confidence)"

    def __init__(self) -> None:
        super().__init__()
        self.query = nn.Linear(CHANNELS, CHANNELS)
        self.key = nn.Linear(CHANNELS, CHANNELS)
        self.confidence = nn.Linear(CHANNELS, 1)
        self.widen = nn.Linear(CHANNELS, CHANNELS)
        self.narrow = nn.Linear(CHANNELS, CHANNELS)
        nn.init.zeros_(self.narrow.weight)  # begin as plain attention
        nn.init.zeros_(self.narrow.bias)

    def mix(self, features: Tensor, part: Tensor, weight: Tensor) -> Tensor:
        agents, p, channels = features.shape
        query = self.query(features[0]).view(p, HEADS, -1)
        key = self.key(features).view(agents, p, HEADS, -1)
        logit = (query * key).sum(dim=-1) / math.sqrt(channels // HEADS)
        prior = F.logsigmoid(self.confidence(features)[..., 0]) + weight.clamp_min(1e-12).log()
        logit = (logit + prior[..., None]).masked_fill(~part[..., None], -math.inf)
        share = logit.softmax(dim=0)
        heads = [weighted_sum(share[..., h], value) for h, value in enumerate(features.chunk(HEADS, dim=-1))]
        mixed = torch.cat(heads, dim=-1)
        trust = (weight * part)[1:].amax(dim=0)[:, None]
        out: Tensor = mixed + trust * self.narrow(F.relu(self.widen(mixed)))
        return out

    @classmethod
    def link_bytes(cls, cells: int = 0, boxes: int = 0, rounds: int = 1) -> LinkBytes:
        """The first round sends by the sender's confidence alone; each later one costs a request map before it.

        Raises:
            ValueError: fewer than one round.
        """
        if rounds < 1:
            raise ValueError(f"rounds is {rounds}, must be at least 1")
        return features_of(cells, requests=rounds - 1)


def confidence_map(heat: Tensor) -> Tensor:
    """Heat logits [n, 128, 128] → confidence C [n, 64, 64], 0 … 1: a cell's best, smoothed by a 5 × 5 Gaussian of σ = 1."""
    best = F.max_pool2d(heat[:, None].sigmoid(), 2)
    axis = torch.exp(-0.5 * torch.arange(-2.0, 3.0, device=heat.device) ** 2)
    kernel = axis[:, None] * axis
    return F.conv2d(best, (kernel / kernel.sum())[None, None], padding=2)[:, 0]


def requested_rank(sender: Tensor, receiver: Tensor) -> Tensor:
    """What ranks a sender's cells from the second round on: C_i ⊙ R_j with R = 1 − C, both on the sender's grid."""
    return sender * (1.0 - receiver)
