"""No fusion: a drone alone, whatever it is sent."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from sortie.perception.network.fusion.base import Fusion, Shares
from sortie.perception.network.fusion.traffic import LinkBytes


class Alone(Fusion):
    """The ego's features as they are; it has no parameters."""

    name = "none"
    about = "a drone alone: nothing is sent, nothing is fused"
    shares: ClassVar[Shares] = "nothing"

    def forward(self, agents: Tensor, takes_part: Tensor, weight: Tensor) -> Tensor:
        return agents[:, 0]

    @classmethod
    def link_bytes(cls, cells: int = 0, boxes: int = 0) -> LinkBytes:
        return LinkBytes()
