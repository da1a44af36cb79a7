"""The fusion methods by name."""

from __future__ import annotations

from perception.fusion.base import Fusion
from perception.fusion.disconet import DiscoNet

FUSIONS: dict[str, type[Fusion]] = {f.name: f for f in (DiscoNet,)}
