"""The fusion methods by name: a new one is its file and its line here."""

from __future__ import annotations

from sortie.perception.fusion.base import Fusion
from sortie.perception.fusion.disconet import DiscoNet
from sortie.perception.fusion.fcooper import FCooper
from sortie.perception.fusion.late import Late
from sortie.perception.fusion.none import Alone
from sortie.perception.fusion.v2vnet import V2VNet
from sortie.perception.fusion.where2comm import Where2comm

FUSIONS: dict[str, type[Fusion]] = {f.name: f for f in (Alone, Late, FCooper, V2VNet, DiscoNet, Where2comm)}
DEFAULT = DiscoNet.name
