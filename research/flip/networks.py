"""Networks of the study that flights do not have: features exchanged before the last ReLU (`signed`), and a deep decoder.

They are built from a flight's network by replacing one part of it. Their weights files name the parts, and only `load`
reads them. A network of neither kind is a plain `CarNet`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from sortie.perception.errors import InputError
from sortie.perception.geometry import CHANNELS
from sortie.perception.network.checkpoint import EARLIER, checked, filled, read_model
from sortie.perception.network.fusion.base import Fusion
from sortie.perception.network.model import CarNet, Head, ModelConfig, Residual, conv, upsampling

Exchange = Literal["rectified", "signed"]
Decoder = Literal["shallow", "deep"]


@dataclass(frozen=True, slots=True)
class StudyConfig(ModelConfig):
    """What a network of the study is built as."""

    exchange: Exchange = "rectified"
    """Whether features are ≥ 0 where they are exchanged, or go there before the last non-linearity."""
    decoder: Decoder = "shallow"
    """The head's trunk: at the exchange's resolution, or strided down to 16 × 16 and back with skips. A fine network has no choice."""


class DeepTrunk(nn.Module):
    """Strided down to 16 × 16 and back up with skips, batch norm on every layer, as DiscoNet's decoder is built."""

    def __init__(self) -> None:
        super().__init__()
        self.down_32 = nn.Sequential(conv(CHANNELS, 96, stride=2), conv(96, 96))
        self.down_16 = nn.Sequential(conv(96, 128, stride=2), conv(128, 128))
        self.up_32 = upsampling(128, 96)
        self.join_32 = conv(192, 96)
        self.up_64 = upsampling(96, CHANNELS)
        self.join_64 = conv(2 * CHANNELS, CHANNELS)

    def forward(self, fused: Tensor) -> Tensor:
        half = self.down_32(fused)
        x = self.up_32(self.down_16(half))
        x = self.up_64(self.join_32(torch.cat([x, half], dim=1)))
        out: Tensor = self.join_64(torch.cat([x, fused], dim=1))
        return out


class StudyNet(CarNet):
    """A `CarNet` with the parts that its configuration names."""

    def __init__(self, config: StudyConfig, fusion: Fusion | None = None) -> None:
        super().__init__(config, fusion)
        if config.exchange == "signed":  # without its ReLU what the last layer adds may be negative, and so may the sum
            self.encoder.body[1] = Residual(*list(self.encoder.body[1].children())[:2])
        if config.decoder == "deep" and isinstance(self.head, Head):
            self.head.trunk = DeepTrunk().to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def config_of(fields: dict[str, Any]) -> ModelConfig:
    """The configuration with these fields: a flight's where `exchange` and `decoder` are usual or left out."""
    odd = any(fields.get(name, usual) != usual for name, usual in EARLIER.items())
    return StudyConfig(**fields) if odd else ModelConfig(**{k: v for k, v in fields.items() if k not in EARLIER})


def network(config: ModelConfig, fusion: Fusion | None = None) -> CarNet:
    """An untrained network."""
    return StudyNet(config, fusion) if isinstance(config, StudyConfig) else CarNet(config, fusion)


def read_config(path: Path) -> ModelConfig:
    """The configuration of the network in a weights file.

    Raises:
        InputError: no such file, or one that is not of this project, or a field or value that no network has.
    """
    given = read_model(path)
    parts = {name: given.pop(name, usual) for name, usual in EARLIER.items()}
    for name, allowed in (("exchange", ("rectified", "signed")), ("decoder", ("shallow", "deep"))):
        if parts[name] not in allowed:
            raise InputError(f"{path}: model.{name} is {parts[name]!r}, must be {' or '.join(allowed)}")
    return config_of({**asdict(checked(path, given)), **parts})


def load(path: Path, fusion: Fusion | None = None) -> CarNet:
    """The network in a weights file, of the study or of flights; arguments and errors as for `checkpoint.load_weights`."""
    return filled(network(read_config(path), fusion), path, fusion)
