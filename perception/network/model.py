"""The detector's network: encode one drone's bird's-eye image, fuse what came from others, find cars.

Grids are those of `geometry.py`: image 256², features 80 × 64 × 64, head 128². Features are rounded to float16
where they leave the encoder, shared or not, as that is what the radio carries.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from sortie.perception.geometry import CHANNELS, Geometry
from sortie.perception.network.bev import ground_points
from sortie.perception.network.fusion.base import Fusion
from sortie.perception.network.fusion.registry import FUSIONS

COLOUR_MEAN, COLOUR_GAIN = 0.42, 4.0
"""What brings colours, 0 … 1, about 0 and to a spread of about 1; the weights were learned so."""


@dataclass(frozen=True, slots=True)
class ModelConfig:
    """What a network is built as; it travels in the weights file's metadata."""

    half_extent_m: float = 102.4
    fusion: str = "disconet"
    """A name of `fusion.registry.FUSIONS`, or what names one of one's own."""
    exchange: Literal["rectified", "signed"] = "rectified"
    """Whether features are ≥ 0 where they are exchanged, or go there before the last non-linearity."""
    decoder: Literal["shallow", "deep"] = "shallow"
    """The head's trunk: at the exchange's resolution, or strided down to 16 × 16 and back with skips."""

    @property
    def geometry(self) -> Geometry:
        """The grids that the network works on."""
        return Geometry(self.half_extent_m)


def conv(c_in: int, c_out: int, kernel: int = 3, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """Convolution, batch norm, ReLU."""
    pad = dilation * (kernel // 2)
    return nn.Sequential(
        nn.Conv2d(c_in, c_out, kernel, stride, pad, dilation, bias=False), nn.BatchNorm2d(c_out), nn.ReLU(inplace=True)
    )


class Residual(nn.Sequential):
    """What its layers make of a map, added to the map."""

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = x + super().forward(x)  # type: ignore[no-untyped-call]
        return out


def _up(c_in: int, c_out: int) -> nn.Sequential:
    return nn.Sequential(
        nn.ConvTranspose2d(c_in, c_out, 2, 2, bias=False), nn.BatchNorm2d(c_out), nn.ReLU(inplace=True)
    )


class Stem(nn.Sequential):
    """Bird's-eye image uint8 [n, 4, 256, 256] → [n, 24, 128, 128]: its first layer sees colours, what was seen, and where."""

    place: Tensor
    """[1, 3, 256, 256]: x forward, y left and range of each pixel, in half extents."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__(*conv(7, 24, 5, 2))
        ground = ground_points(config.geometry).permute(2, 0, 1) / config.half_extent_m
        self.register_buffer("place", torch.cat([ground, ground.norm(dim=0, keepdim=True)])[None], persistent=False)

    def forward(self, image: Tensor) -> Tensor:
        where = self.place.expand(len(image), -1, -1, -1)
        out: Tensor = super().forward(torch.cat([colours(image), where], dim=1))  # type: ignore[no-untyped-call]
        return out


def colours(image: Tensor) -> Tensor:
    """uint8 [n, 4, h, w] as float32: R, G and B about 0, 0 where nothing was seen, and 1 where something was."""
    seen = image[:, 3:].float() / 255.0
    return torch.cat([(image[:, :3].float() / 255.0 - COLOUR_MEAN) * COLOUR_GAIN * seen, seen], dim=1)


class Encoder(nn.Module):
    """Bird's-eye image uint8 [n, 4, 256, 256] → features [n, 80, 64, 64], float32 that is exact in float16."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.stem = Stem(config)
        self.down = nn.Sequential(conv(24, 40), conv(40, CHANNELS, 3, 2))
        # signed: without its ReLU what is added may be negative, and so may the sum
        last = list(conv(CHANNELS, CHANNELS))[: 2 if config.exchange == "signed" else 3]
        self.body = nn.Sequential(Residual(*conv(CHANNELS, CHANNELS, dilation=2)), Residual(*last))

    def forward(self, image: Tensor) -> Tensor:
        x = self.body(self.down(self.stem(image)))
        rounded: Tensor = x + (x.half().float() - x).detach() if torch.is_grad_enabled() else x.half().float()
        return rounded  # straight through backward


class Head(nn.Module):
    """Fused features → [n, 7, 128, 128]: heat logit, offset (x, y) in cells, log size (length, width), sin 2ψ, cos 2ψ."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.trunk = DeepTrunk() if config.decoder == "deep" else ShallowTrunk()
        self.up = _up(CHANNELS, 40)
        self.fine = Residual(*conv(40, 40))
        self.out = nn.Conv2d(40, 7, 1)
        with torch.no_grad():
            self.out.bias.zero_()  # type: ignore[union-attr]
            self.out.bias[0] = -4.0  # type: ignore[index]

    def forward(self, fused: Tensor) -> Tensor:
        out: Tensor = self.out(self.fine(self.up(self.trunk(fused))))
        return out


class ShallowTrunk(nn.Module):
    """One residual layer at 64 × 64."""

    def __init__(self) -> None:
        super().__init__()
        self.join = Residual(*conv(CHANNELS, CHANNELS))

    def forward(self, fused: Tensor) -> Tensor:
        return self.join(fused)  # type: ignore[no-any-return]


class DeepTrunk(nn.Module):
    """Strided down to 16 × 16 and back up with skips, batch norm on every layer, as DiscoNet's decoder is built."""

    def __init__(self) -> None:
        super().__init__()
        self.down_32 = nn.Sequential(conv(CHANNELS, 96, stride=2), conv(96, 96))
        self.down_16 = nn.Sequential(conv(96, 128, stride=2), conv(128, 128))
        self.up_32 = _up(128, 96)
        self.join_32 = conv(192, 96)
        self.up_64 = _up(96, CHANNELS)
        self.join_64 = conv(2 * CHANNELS, CHANNELS)

    def forward(self, fused: Tensor) -> Tensor:
        half = self.down_32(fused)
        x = self.up_32(self.down_16(half))
        x = self.up_64(self.join_32(torch.cat([x, half], dim=1)))
        out: Tensor = self.join_64(torch.cat([x, fused], dim=1))
        return out


class CarNet(nn.Module):
    """Encoder, fusion and head; about 0.27 M parameters as shipped.

    Args:
        config: what it is built as.
        fusion: a fusion in place of the built-in one that `config` names.

    Raises:
        ValueError: a fusion that is not there, naming those that are.
    """

    def __init__(self, config: ModelConfig = ModelConfig(), fusion: Fusion | None = None) -> None:
        super().__init__()
        if fusion is None and config.fusion not in FUSIONS:
            raise ValueError(f"fusion is {config.fusion!r}, must be one of {', '.join(FUSIONS)}")
        self.config = config
        self.encoder = Encoder(config)
        self.fusion = FUSIONS[config.fusion]() if fusion is None else fusion
        self.head = Head(config)
        nn.Module.to(self, memory_format=torch.channels_last)  # type: ignore[call-overload]  # a third faster on a CPU
