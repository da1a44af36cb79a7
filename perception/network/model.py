"""The detector's network: encode one drone's bird's-eye image, fuse what came from others, find cars.

Grids are those of `geometry.py`: image 256² or 512², features 80 × 64 × 64, head 128². Features are rounded to float16
where they leave the encoder, shared or not, as that is what the radio carries.

A coarse network fuses maps as they are exchanged, in cells of 3.2 m. A fine one first spreads each exchanged cell over
the head's four, by a learned layer, and fuses those of 1.6 m: no byte more is sent.

An image of 512² has one layer more, which halves it at once. All that follows has the same shapes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sortie.perception.errors import InputError
from sortie.perception.geometry import CELLS, CHANNELS, HEAD_PX, IMAGE_PX, Geometry
from sortie.perception.network.bev import ground_points
from sortie.perception.network.fusion.base import Fusion
from sortie.perception.network.fusion.registry import FUSIONS

FINE_CHANNELS = 40
"""Numbers in each of the four cells that an exchanged one is spread over."""
FINE_FUSIONS = ("disconet", "fcooper", "none", "late")
"""Those that fuse maps of any number of channels."""
COLOUR_MEAN, COLOUR_GAIN = 0.42, 4.0
"""What brings colours, 0 … 1, about 0 and to a spread of about 1; the weights were learned so."""


@dataclass(frozen=True, slots=True)
class ModelConfig:
    """What a network is built as; it travels in the weights file's metadata."""

    half_extent_m: float = 102.4
    fusion: str = "disconet"
    """A name of `fusion.registry.FUSIONS`, or what names one of one's own."""
    grid: Literal["coarse", "fine"] = "coarse"
    """Where maps are fused: in the cells that are exchanged, or in the head's. A fine network's head also tells how well
    each box fits."""
    image_px: int = IMAGE_PX
    """Pixels along a side of the image: 256 of 0.8 m, learned from pictures of 160 × 90, or 512 of 0.4 m, from 320 × 180."""

    @property
    def geometry(self) -> Geometry:
        """The grids that the network works on."""
        return Geometry(self.half_extent_m, self.image_px)

    @property
    def fused_cells(self) -> int:
        """Cells along a side of the maps that are fused."""
        return HEAD_PX if self.grid == "fine" else CELLS

    @property
    def fused_cell_m(self) -> float:
        """Side of a cell of the maps that are fused."""
        return 2 * self.half_extent_m / self.fused_cells

    @property
    def fused_channels(self) -> int:
        """Numbers in a cell of the maps that are fused."""
        return FINE_CHANNELS if self.grid == "fine" else CHANNELS


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


def upsampling(c_in: int, c_out: int) -> nn.Sequential:
    """Transposed convolution that doubles the resolution, batch norm, ReLU."""
    return nn.Sequential(
        nn.ConvTranspose2d(c_in, c_out, 2, 2, bias=False), nn.BatchNorm2d(c_out), nn.ReLU(inplace=True)
    )


class Stem(nn.Sequential):
    """Bird's-eye image uint8 [n, 4, px, px] → half its side, by a layer that sees colours, what was seen, and where.

    That is [n, 24, 128, 128], or [n, 16, 256, 256] of a sharp image.
    """

    place: Tensor
    """[1, 3, px, px]: x forward, y left and range of each pixel, in half extents."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__(*(conv(7, 24, 5, 2) if config.image_px == IMAGE_PX else conv(7, 16, 3, 2)))
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
    """Bird's-eye image uint8 [n, 4, px, px] → features [n, 80, 64, 64], float32 that is exact in float16."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.stem = Stem(config)
        sharp = [] if config.image_px == IMAGE_PX else [conv(16, 24, 5, 2)]
        self.down = nn.Sequential(*sharp, conv(24, 40), conv(40, CHANNELS, 3, 2))
        self.body = nn.Sequential(Residual(*conv(CHANNELS, CHANNELS, dilation=2)), Residual(*conv(CHANNELS, CHANNELS)))

    def forward(self, image: Tensor) -> Tensor:
        x = self.body(self.down(self.stem(image)))
        rounded: Tensor = x + (x.half().float() - x).detach() if torch.is_grad_enabled() else x.half().float()
        return rounded  # straight through backward


class Head(nn.Module):
    """Fused features → [n, 7, 128, 128]: heat logit, offset (x, y) in cells, log size (length, width), sin 2ψ, cos 2ψ."""

    def __init__(self) -> None:
        super().__init__()
        self.trunk: nn.Module = ShallowTrunk()
        self.up = upsampling(CHANNELS, 40)
        self.fine = Residual(*conv(40, 40))
        self.out = nn.Conv2d(40, 7, 1)
        with torch.no_grad():
            self.out.bias.zero_()  # type: ignore[union-attr]
            self.out.bias[0] = -4.0  # type: ignore[index]

    def forward(self, fused: Tensor) -> Tensor:
        out: Tensor = self.out(self.fine(self.up(self.trunk(fused))))
        return out


class FineHead(nn.Module):
    """Fused features [n, 40, 128, 128] → [n, 8, 128, 128]: as `Head`, then the logit of how well the box fits (its IoU)."""

    def __init__(self) -> None:
        super().__init__()
        self.down = conv(FINE_CHANNELS, CHANNELS, stride=2)
        self.wide = Residual(*conv(CHANNELS, CHANNELS))
        self.up = upsampling(CHANNELS, FINE_CHANNELS)
        self.fine = Residual(*conv(FINE_CHANNELS, FINE_CHANNELS))
        self.out = nn.Conv2d(FINE_CHANNELS, 8, 1)
        with torch.no_grad():
            self.out.bias.zero_()  # type: ignore[union-attr]
            self.out.bias[0] = -4.0  # type: ignore[index]

    def forward(self, fused: Tensor) -> Tensor:
        out: Tensor = self.out(self.fine(self.up(self.wide(self.down(fused))) + fused))
        return out


class Align(nn.Module):
    """Corrects what a peer says in cells of the ego's grid for where between its own cells they lie, and how it is turned.

    Interpolation blurs what lies between cells, and a car's heading is told in the peer's frame. It begins as the identity.
    """

    def __init__(self, channels: int = FINE_CHANNELS, inner: int = 16) -> None:
        super().__init__()
        self.said = nn.Linear(channels, inner)
        self.offset = nn.Linear(2, inner, bias=False)
        self.turn = nn.Linear(2, inner, bias=False)
        self.out = nn.Linear(inner, channels)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, said: Tensor, offset: Tensor, turn: Tensor, out: Tensor | None = None) -> Tensor:
        """[k, p, c] → the same; cells of zeros, where nothing was sent, stay zeros.

        Args:
            offset: [k, p, 2], how far the cell's centre lies from that of the peer's cell below it, −0.5 … 0.5 cells.
            turn: [k], the peer's heading minus the ego's, radians.
            out: [k, p, c], where the result goes; None makes one.
        """
        x = self.said(said)
        x += self.offset(offset)
        x += self.turn(torch.stack([turn.sin(), turn.cos()], dim=-1))[:, None]
        corrected: Tensor = self.out(F.relu(x, inplace=True))
        corrected += said
        some = (said.sum(dim=-1, keepdim=True) > 0.0).to(
            said.dtype
        )  # all are at least 0; `any` takes longer, as do bools
        return torch.mul(corrected, some, out=out)


class ShallowTrunk(nn.Module):
    """One residual layer at 64 × 64."""

    def __init__(self) -> None:
        super().__init__()
        self.join = Residual(*conv(CHANNELS, CHANNELS))

    def forward(self, fused: Tensor) -> Tensor:
        return self.join(fused)  # type: ignore[no-any-return]


class CarNet(nn.Module):
    """Encoder, fusion and head; about 0.27 M parameters as shipped.

    Args:
        config: what it is built as.
        fusion: a fusion in place of the built-in one that `config` names.

    Raises:
        InputError: a fusion that is not there, naming those that are.
    """

    def __init__(self, config: ModelConfig = ModelConfig(), fusion: Fusion | None = None) -> None:
        super().__init__()
        if fusion is None and config.fusion not in FUSIONS:
            raise InputError(f"fusion is {config.fusion!r}, must be one of {', '.join(FUSIONS)}")
        if config.grid == "fine" and fusion is None and config.fusion not in FINE_FUSIONS:
            raise InputError(f"fusion is {config.fusion!r} of a fine network, must be one of {', '.join(FINE_FUSIONS)}")
        self.config = config
        self.encoder = Encoder(config)
        self.fusion = _fusion(config) if fusion is None else fusion
        fine = config.grid == "fine"
        self.spread: nn.Module = upsampling(CHANNELS, FINE_CHANNELS) if fine else nn.Identity()
        """Features [n, 80, 64, 64] as they are fused: [n, `fused_channels`, `fused_cells`, `fused_cells`]."""
        self.align = Align() if fine else None
        self.head: nn.Module = FineHead() if fine else Head()
        nn.Module.to(self, memory_format=torch.channels_last)  # type: ignore[call-overload]  # a third faster on a CPU

    def sent(self, cells: Tensor) -> Tensor:
        """Which exchanged cells were sent, bool [k, 4096], in the cells of the maps that are fused."""
        times = self.config.fused_cells // CELLS
        if times == 1:
            return cells
        wide = cells.view(-1, CELLS, CELLS).repeat_interleave(times, dim=1).repeat_interleave(times, dim=2)
        return wide.flatten(1)

    def aligned(self, said: Tensor, offset: Tensor, turn: Tensor, out: Tensor | None = None) -> Tensor:
        """What peers say [k, p, c] as `Align` corrects it; a coarse network leaves it. Into `out`, where that is given."""
        if self.align is None:
            return said if out is None else out.copy_(said)
        corrected: Tensor = self.align(said, offset, turn, out)
        return corrected


def _fusion(config: ModelConfig) -> Fusion:
    fusion: Any = FUSIONS[config.fusion]
    made: Fusion = fusion(config.fused_channels) if config.fusion == "disconet" else fusion()
    return made
