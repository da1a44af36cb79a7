"""DiscoNet's fusion under an intervention on its softmax, for the dose–response study.

A sortie flies it as any fusion of a user's own:

    perception:
      fusion: research/flip/fusion.py:DosedDiscoNet
      fusion_params: {temperature: 1.0e+9, silent_weight: 0.35}
"""

from __future__ import annotations

import math
from pathlib import Path

from torch import Tensor

from sortie.perception.errors import InputError
from sortie.perception.network.checkpoint import load_weights
from sortie.perception.network.detector import named_weights
from sortie.perception.network.fusion.base import Fusion
from sortie.perception.network.fusion.disconet import DiscoNet, softmax


class DosedDiscoNet(DiscoNet):
    """Trained edge weights, with a softmax that is changed.

    Args:
        trained: the fusion that is dosed; None takes that of `weights`.
        temperature: the logits are divided by it; infinite gives equal weights, as does 1e9, which a scenario can say.
        silent_weight: added to a peer's logit in cells of which nothing was sent and that count as zeros.
        weights: a network's file, as `perception.weights` names it.

    Raises:
        InputError: a parameter out of its range, or a network of another fusion.
    """

    def __init__(
        self,
        trained: Fusion | None = None,
        *,
        temperature: float = 1.0,
        silent_weight: float = 0.0,
        weights: str = "fine.safetensors",
    ) -> None:
        if not (isinstance(temperature, float | int) and temperature > 0.0):
            raise InputError(f"temperature is {temperature!r}, must be a number above 0")
        if not (isinstance(silent_weight, float | int) and math.isfinite(silent_weight)):
            raise InputError(f"silent_weight is {silent_weight!r}, must be a finite number")
        if trained is None:
            trained = load_weights(named_weights(Path(weights))).fusion
        if not isinstance(trained, DiscoNet):
            raise InputError(f"fusion is {trained.name}, must be disconet")
        super().__init__(trained.edge.channels)
        self.edge, self.temperature, self.silent_weight = trained.edge, temperature, silent_weight
        self.train(trained.training)

    def weights(self, features: Tensor, part: Tensor, weight: Tensor) -> Tensor:
        return self.dosed(self.edge(features), silent_in(features), part, weight)

    def dosed(self, logit: Tensor, silent: Tensor, part: Tensor, weight: Tensor) -> Tensor:
        """Each agent's softmax weight from the edge network's logits, all [agents, p]; `silent` as `silent_in` gives it."""
        if self.temperature != 1.0:
            logit = logit / self.temperature
        if self.silent_weight:
            logit = logit + self.silent_weight * silent
        return softmax(logit, part, weight)


def silent_in(features: Tensor) -> Tensor:
    """In which cells an agent counts as zeros, bool [agents, p] from [agents, p, channels]; never the ego, the first."""
    silent = ~features.any(dim=-1)
    silent[0] = False
    return silent
