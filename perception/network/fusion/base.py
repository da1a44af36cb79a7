"""The interface of feature fusion: several drones' maps on one ego's grid in, one map out."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from sortie.perception.network.fusion.traffic import LinkBytes, features_of

UnsentCells = Literal["masked", "zero"]
Shares = Literal["features", "boxes", "nothing"]


class Fusion(nn.Module):
    """One method of fusion.

    `forward(agents, takes_part, weight)` fuses n egos at once:

    - agents [n, 1 + k, c, h, w]: maps on the ego's grid, the ego's own first, zero where nothing was sent;
    - takes_part [n, 1 + k, h, w] bool: which agent counts in which cell, the ego in all of them;
    - weight [n, 1 + k]: each link's fusion weight from its directive, 0 … 1, after `weigh`; the ego's 1;

    and returns [n, c, h, w]. Where no peer takes part the ego's features come back as they are; a peer of weight 0
    takes no part (`takes_part`); peers have no order. k may be 0.
    """

    name: ClassVar[str]
    about: ClassVar[str]
    """One line for lists."""
    shares: ClassVar[Shares] = "features"
    """What its peers send; `none` and late fusion leave the ego's features alone."""
    weighs: ClassVar[bool] = False
    """Whether `weigh` changes weights. If not, nobody has to stack whole maps for it."""
    reach_cells: ClassVar[int] = 0
    """How far a peer's cell acts on the fused map: 0 where each cell is fused by itself."""

    def forward(self, agents: Tensor, takes_part: Tensor, weight: Tensor) -> Tensor:
        raise NotImplementedError

    def fuse(self, own: Tensor, features: Callable[[Tensor], Tensor], takes_part: Tensor, weight: Tensor) -> Tensor:
        """One ego's fused map [1, c, h, w].

        Args:
            own: [c, h, w]; takes_part: [1 + k, h, w] and weight: [1 + k], as for `forward`.
            features: gives the agents' features on cells of the ego's grid, its own first, [p] row by row → [1 + k, p, c].
        """
        channels, height, width = own.shape
        agents = features(torch.arange(height * width)).view(-1, height, width, channels).permute(0, 3, 1, 2)
        out: Tensor = self(agents[None], takes_part[None], weight[None])
        return out

    def weigh(self, own: Tensor, peers: Tensor, weight: Tensor) -> Tensor:
        """The links' weights after the method's handshake; unchanged where it has none.

        Args:
            own: [n, c, h, w] and peers: [n, k, c, h, w], whole maps, each on its own grid.
            weight: [n, k], from the directives.
        """
        return weight

    def fold(self) -> None:
        """Fold batch norms into the layers before them, for inference; what has none does nothing."""

    @classmethod
    def link_bytes(cls, cells: int = 0, boxes: int = 0) -> LinkBytes:
        """What one peer puts on the air for one ego and frame, given the cells and boxes it has to send."""
        return features_of(cells)


class PerCell(Fusion):
    """A method that fuses each cell by itself: it computes only the cells where a peer takes part, under a budget few."""

    def forward(self, agents: Tensor, takes_part: Tensor, weight: Tensor) -> Tensor:
        n, many, channels, height, width = agents.shape
        cells = height * width
        part = takes_part.permute(1, 0, 2, 3).reshape(many, n * cells)
        at = part[1:].any(dim=0).nonzero().squeeze(1)
        if not len(at):
            return agents[:, 0]
        sample, cell = at // cells, at % cells
        row = sample * (many * cells) + cell + torch.arange(many, device=at.device)[:, None] * cells
        table = agents.permute(0, 1, 3, 4, 2).reshape(-1, channels)  # no copy where maps are channels-last
        features = table.index_select(0, row.flatten()).view(many, len(at), channels)
        mixed = self.mix(features, part.index_select(1, at), weight.T.index_select(1, sample))
        own = agents[:, 0].permute(0, 2, 3, 1).reshape(-1, channels)
        return own.index_copy(0, at, mixed).view(n, height, width, channels).permute(0, 3, 1, 2)

    def fuse(self, own: Tensor, features: Callable[[Tensor], Tensor], takes_part: Tensor, weight: Tensor) -> Tensor:
        part = takes_part.flatten(1)
        at = part[1:].any(dim=0).nonzero().squeeze(1)
        mixed = self.mix(features(at), part.index_select(1, at), weight[:, None].expand(-1, len(at)))
        rows = own.permute(1, 2, 0).reshape(-1, len(own))
        return rows.index_copy(0, at, mixed).view(1, *own.shape[1:], -1).permute(0, 3, 1, 2)

    def mix(self, features: Tensor, part: Tensor, weight: Tensor) -> Tensor:
        """[agents, p, c] with who takes part and link weights, [agents, p] each → [p, c]; the ego is the first agent."""
        raise NotImplementedError


def weighted_sum(share: Tensor, features: Tensor) -> Tensor:
    """Σ over agents of share [agents, p] · said [agents, p, c]; one agent at a time, which needs no copy of all."""
    out = share[0, :, None] * features[0]
    for one, row in zip(share[1:], features[1:], strict=True):
        out = torch.addcmul(out, one[:, None], row)
    return out


def takes_part(sent: Tensor, inside: Tensor, weight: Tensor, unsent: UnsentCells) -> Tensor:
    """Which agent takes part in which cell, [n, 1 + k, h, w] bool, from the cells that arrived of k peers.

    Args:
        sent: [n, k, h, w], True where the peer's cell arrived.
        inside: [n, k, h, w], True where the peer's grid covers the cell.
        weight: [n, k], each link's fusion weight; 0 leaves the peer out.
        unsent: "masked": a cell that was not sent is left out; "zero": it takes part as zeros, as far as the peer's
            grid reaches (the paper's instrument, and DiscoNet's as released).
    """
    peers = (inside if unsent == "zero" else sent) & (weight > 0)[:, :, None, None]
    ego = torch.ones_like(peers[:, :1]) if peers.shape[1] else peers.new_ones(len(peers), 1, *peers.shape[2:])
    return torch.cat([ego, peers], dim=1)
