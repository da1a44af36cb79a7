"""F-Cooper's fusion (Chen et al., SEC 2019), written from its description: the maximum over the agents present."""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sortie.perception.network.fusion.base import PerCell


class FCooper(PerCell):
    """Element by element, the largest of all agents' values; it has no parameters.

    A link's weight w takes the peer's value that part of the way up: the ego's x becomes x + w · (peer − x) where the
    peer's is larger, so w = 1 is the maximum and w → 0 the ego alone, for features below 0 too.
    """

    name = "fcooper"
    about = "element-wise maximum over the agents present (F-Cooper)"

    def mix(self, features: Tensor, part: Tensor, weight: Tensor) -> Tensor:
        share = (weight * part)[1:, :, None]
        rise = (share * F.relu(features[1:] - features[0])).amax(dim=0)
        return features[0] + rise
