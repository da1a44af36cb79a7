"""The fusion methods by name: a new one is its file and its line here."""

from __future__ import annotations

from sortie.perception.network.fusion.base import Fusion
from sortie.perception.network.fusion.disconet import DiscoNet
from sortie.perception.network.fusion.fcooper import FCooper
from sortie.perception.network.fusion.late import Late
from sortie.perception.network.fusion.none import Alone
from sortie.perception.network.fusion.v2vnet import V2VNet
from sortie.perception.network.fusion.when2com import When2com
from sortie.perception.network.fusion.where2comm import Where2comm

FUSIONS: dict[str, type[Fusion]] = {f.name: f for f in (Alone, Late, FCooper, V2VNet, DiscoNet, When2com, Where2comm)}
DEFAULT = DiscoNet.name
