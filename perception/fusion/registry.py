"""The fusion methods by name: a new one is its file and its line here."""

from __future__ import annotations

from perception.fusion.base import Fusion
from perception.fusion.disconet import DiscoNet
from perception.fusion.fcooper import FCooper
from perception.fusion.late import Late
from perception.fusion.none import Alone
from perception.fusion.v2vnet import V2VNet
from perception.fusion.where2comm import Where2comm

FUSIONS: dict[str, type[Fusion]] = {f.name: f for f in (Alone, Late, FCooper, V2VNet, DiscoNet, Where2comm)}
DEFAULT = DiscoNet.name
