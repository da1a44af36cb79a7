"""V2VNet's fusion (Wang et al., ECCV 2020), written from its description: rounds of messages and a gated update.

In each round every peer's map beside the ego's gives a message, messages are averaged, and a convolutional GRU moves
the ego's map by the average. The peers' maps are those of the first round in every round: one transmission.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sortie.perception.geometry import CHANNELS
from sortie.perception.network.fusion.base import Fusion

ROUNDS = 2
MESSAGE = 40
"""Channels of a message, half those of a map."""


class V2VNet(Fusion):
    """Two rounds; messages are averaged by the links' weights over who takes part in a cell.

    The cell then goes from the ego's features to the fused ones by the largest of those weights: with weights of one
    it is the method as described, and as all weights go to 0 the ego is left alone.
    """

    name = "v2vnet"
    about = f"{ROUNDS} rounds of convolved messages into a convolutional GRU (V2VNet, without its delay network)"
    reach_cells = 3 * ROUNDS
    """A round reads one cell further by the message and two by the GRU."""

    def __init__(self) -> None:
        super().__init__()
        # a convolution of two maps side by side is the sum of one for each
        self.from_peer = nn.Conv2d(CHANNELS, MESSAGE, 3, padding=1, bias=False)
        self.from_ego = nn.Conv2d(CHANNELS, MESSAGE, 3, padding=1)
        self.gates = nn.Conv2d(CHANNELS + MESSAGE, 2 * CHANNELS, 3, padding=1)
        self.candidate = nn.Conv2d(CHANNELS + MESSAGE, CHANNELS, 3, padding=1)
        self.last = nn.Conv2d(CHANNELS, CHANNELS, 1)
        with torch.no_grad():  # begin near the ego's own map, so that the head keeps its sense
            self.gates.bias[:CHANNELS] = -2.0  # type: ignore[index]
            self.last.weight.copy_(torch.eye(CHANNELS)[:, :, None, None])
            self.last.bias.zero_()  # type: ignore[union-attr]

    def forward(self, agents: Tensor, takes_part: Tensor, weight: Tensor) -> Tensor:
        own, (n, many) = agents[:, 0], agents.shape[:2]
        if many == 1 or not bool(takes_part[:, 1:].any()):
            return own
        share = (weight[:, 1:, None, None] * takes_part[:, 1:])[:, :, None]
        trust = share.amax(dim=1)
        share = share / share.sum(dim=1, keepdim=True).clamp_min(1e-12)
        from_peers = self.from_peer(agents[:, 1:].flatten(0, 1)).unflatten(0, (n, many - 1))
        state = own
        for _ in range(ROUNDS):
            message = (share * F.relu(from_peers + self.from_ego(state)[:, None])).sum(dim=1)
            update, reset = self.gates(torch.cat([state, message], dim=1)).sigmoid().chunk(2, dim=1)
            proposed = self.candidate(torch.cat([reset * state, message], dim=1))
            state = state + update * (proposed - state)
        # the candidate of the GRU is linear, as features are not in −1 … 1
        anyone = takes_part[:, 1:].any(dim=1, keepdim=True)
        return torch.where(anyone, own + trust * (self.last(state) - own), own)
