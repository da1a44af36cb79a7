"""When2com's and Who2com's handshake and fusion (Liu et al., CVPR 2020 and ICRA 2020), written from their description.

Each drone makes a short query and a longer key from its own whole map. The query goes to every peer. A peer answers with
its score: the match of its key with the query. A softmax over the scores, the drone's score of itself included, is the
attention. It decides whom to ask for a map (`asked`), and it weighs the maps that come.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sortie.perception.geometry import CHANNELS
from sortie.perception.network.fusion.base import PerCell, weighted_sum
from sortie.perception.network.fusion.traffic import LinkBytes, features_of

QUERY, KEY = 32, 256
"""Floats of a query, which goes over the air, and of a key, which stays where it is."""
HANDSHAKE_BYTES = 4 * QUERY + 4
"""To each peer: a query, and the score for the peer's query."""
POOLED = 4
"""Cells of the pooled map, each way."""


class Handshake(nn.Module):
    """Query and key of a map: two strided convolutions, pooled to 4 × 4 cells, one hidden layer; and how keys match queries."""

    def __init__(self) -> None:
        super().__init__()
        self.look = nn.Sequential(
            nn.Conv2d(CHANNELS, 32, 3, 2, 1),
            nn.ReLU(),
            nn.Conv2d(32, 32, 3, 2, 1),
            nn.ReLU(),
            nn.AdaptiveAvgPool2d(POOLED),
            nn.Flatten(),
            nn.Linear(32 * POOLED**2, 128),
            nn.ReLU(),
        )
        self.query = nn.Linear(128, QUERY)
        self.key = nn.Linear(128, KEY)
        self.match = nn.Linear(QUERY, KEY, bias=False)

    def forward(self, own: Tensor, peers: Tensor) -> Tensor:
        """Scores [n, 1 + k], the drone's own first, of maps [n, c, h, w] and [n, k, c, h, w], each on its own grid."""
        seen = self.look(torch.cat([own[:, None], peers], dim=1).flatten(0, 1)).unflatten(0, (len(own), -1))
        wanted = self.match(self.query(seen[:, 0]))
        scores: Tensor = (self.key(seen) * wanted[:, None]).sum(dim=-1) / KEY**0.5
        return scores


class When2com(PerCell):
    """The mean of the maps by attention, over the agents that take part in a cell."""

    name = "when2com"
    weighs = True
    about = "mean by attention from a handshake of learned keys and queries (When2com, Who2com)"

    def __init__(self) -> None:
        super().__init__()
        self.handshake = Handshake()

    def attention(self, own: Tensor, peers: Tensor) -> Tensor:
        """[n, 1 + k], the drone's own first: sums to 1 in each row."""
        scores: Tensor = self.handshake(own, peers)
        return scores.softmax(dim=1)

    def weigh(self, own: Tensor, peers: Tensor, weight: Tensor) -> Tensor:
        scores: Tensor = self.handshake(own, peers)
        return weight * (scores[:, 1:] - scores[:, :1]).clamp(-60, 60).exp()  # beyond, a float overflows

    def mix(self, features: Tensor, part: Tensor, weight: Tensor) -> Tensor:
        share = weight * part
        return weighted_sum(share / share.sum(dim=0), features)

    @classmethod
    def link_bytes(cls, cells: int = 0, boxes: int = 0) -> LinkBytes:
        return LinkBytes(features_of(cells).payload, features_of(cells).index, HANDSHAKE_BYTES)


def asked(attention: Tensor, threshold: float | None = None) -> Tensor:
    """Whom each drone asks for its map, bool [n, k], from its attention [n, 1 + k].

    Args:
        threshold: When2com: every peer with more attention than this, so nobody where the drone's own dominates. None:
            Who2com: exactly one peer, the one with the most.
    """
    if threshold is not None:
        return attention[:, 1:] > threshold
    return F.one_hot(attention[:, 1:].argmax(dim=1), attention.shape[1] - 1).bool()
