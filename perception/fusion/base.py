"""The interface of feature fusion: several drones' maps on one ego's grid in, one map out."""

from __future__ import annotations

from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

UnsentCells = Literal["masked", "zero"]


class Fusion(nn.Module):
    """One method of fusion.

    `forward(agents, takes_part, weight)` fuses n egos at once:

    - agents [n, 1 + k, c, h, w]: maps on the ego's grid, the ego's own first, zero where nothing was sent;
    - takes_part [n, 1 + k, h, w] bool: which agent has a say in which cell, the ego in all of them;
    - weight [n, 1 + k]: each link's fusion weight from its directive, 0 … 1, the ego's 1;

    and returns [n, c, h, w]. Where no peer takes part the ego's features come back as they are. k may be 0.
    """

    name: ClassVar[str]

    def forward(self, agents: Tensor, takes_part: Tensor, weight: Tensor) -> Tensor:
        raise NotImplementedError

    def fold(self) -> None:
        """Fold batch norms into the layers before them, for inference; what has none does nothing."""


def takes_part(sent: Tensor, inside: Tensor, weight: Tensor, unsent: UnsentCells) -> Tensor:
    """Who has a say where, [n, 1 + k, h, w] bool, from what arrived of k peers.

    Args:
        sent: [n, k, h, w], True where the peer's cell arrived.
        inside: [n, k, h, w], True where the peer's grid covers the cell.
        weight: [n, k], each link's fusion weight; 0 leaves the peer out.
        unsent: "masked": a cell that was not sent has no say; "zero": it takes part as zeros, as far as the peer's
            grid reaches (the paper's instrument, and DiscoNet's as released).
    """
    peers = (inside if unsent == "zero" else sent) & (weight > 0)[:, :, None, None]
    ego = torch.ones_like(peers[:, :1]) if peers.shape[1] else peers.new_ones(len(peers), 1, *peers.shape[2:])
    return torch.cat([ego, peers], dim=1)
