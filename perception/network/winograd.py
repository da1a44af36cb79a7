"""3 × 3 convolution and ReLU with a quarter of the multiplications, for inference on a CPU.

Winograd's minimal filtering F(4 × 4, 3 × 3) (Lavin and Gray, *Fast Algorithms for Convolutional Neural Networks*, 2016): a
tile of 6 × 6 inputs and the filter are each turned into 36 numbers a channel, multiplied there, and turned back into 4 × 4
outputs. The turning is done by compiled loops; the products are 36 small matrix products, which oneDNN takes as one grouped
convolution with its weights packed ahead. Float32 throughout; the sums are other ones than a plain convolution's, and
agree with it to about 1e-6 of the largest.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sortie.perception.compiled import compiled, fma

TILE = 4
BAND = 4
"""Rows of tiles that are done at a time, so that what they become stays in a core's cache."""
_POINTS = 36
"""What a tile becomes, numbers a channel."""
_FILTER = np.array(
    [
        [1 / 4, 0, 0],
        [-1 / 6, -1 / 6, -1 / 6],
        [-1 / 6, 1 / 6, -1 / 6],
        [1 / 24, 1 / 12, 1 / 6],
        [1 / 24, -1 / 12, 1 / 6],
        [0, 0, 1],
    ]
)
_PACKS = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_convolution_pointwise")  # type: ignore[no-untyped-call]
"""Whether weights can be packed ahead: else a product takes two to three times as long."""
_ZERO, _TWO, _FOUR, _FIVE, _EIGHT = (np.float32(v) for v in (0.0, 2.0, 4.0, 5.0, 8.0))


def suits(conv: nn.Module) -> bool:
    """Whether a layer is a convolution that can be done so: 3 × 3, stride 1, as much padding as dilation both ways, zeros, one group."""
    return (
        isinstance(conv, nn.Conv2d)
        and conv.kernel_size == (3, 3)
        and conv.stride == (1, 1)
        and conv.padding == conv.dilation == conv.dilation[::-1]
        and conv.padding_mode == "zeros"
        and conv.groups == 1
        and conv.bias is not None
        and conv.weight.dtype == torch.float32
    )


class WinogradReLU(nn.Module):
    """A convolution that `suits`, and its ReLU: [n, c, h, w] → [n, o, h, w]; `residual` adds it to what it is made of.

    Where it does not help (an accelerator, autocast, a gradient to follow, sides that are no whole number of tiles) it
    is the plain convolution.
    """

    def __init__(self, conv: nn.Conv2d, residual: bool = False) -> None:
        super().__init__()
        self.conv, self._residual = conv, residual
        self._dilation = conv.dilation[0]
        filters = np.einsum("pa,oiab,qb->qpoi", _FILTER, conv.weight.detach().cpu().double().numpy(), _FILTER)
        self._filters = torch.from_numpy(filters.reshape(-1, conv.in_channels, 1, 1).astype(np.float32))
        self._packed: dict[tuple[int, ...], Tensor] = {}

    def forward(self, x: Tensor) -> Tensor:
        n, channels, rows, columns = x.shape
        elsewhere = x.device.type != "cpu" or x.dtype != torch.float32 or torch.is_autocast_enabled("cpu")
        if elsewhere or torch.is_grad_enabled() or rows % (TILE * self._dilation) or columns % (TILE * self._dilation):
            plain = F.relu(self.conv(x))
            return x + plain if self._residual else plain
        seen = x.permute(0, 2, 3, 1).contiguous().numpy()
        bias = self.conv.bias.detach().numpy()  # type: ignore[union-attr]
        out = torch.empty(n, rows, columns, bias.size)
        strips, wide = n * rows // TILE, columns // TILE
        for begin in range(0, strips, BAND):
            band = min(BAND, strips - begin)
            turned = torch.empty(1, band, wide, _POINTS * channels)
            _turn(seen, begin, self._dilation, (0,) * channels, turned.numpy().reshape(band, wide, 6, -1))
            products = self._multiply(turned.permute(0, 3, 1, 2)).permute(0, 2, 3, 1).contiguous().numpy()
            products = products.reshape(band, wide, 6, -1)
            _turn_back(
                products, bias, seen if self._residual else None, begin, self._dilation, (0,) * bias.size, out.numpy()
            )
        return out.permute(0, 3, 1, 2)

    def _multiply(self, turned: Tensor) -> Tensor:
        """Every group of channels [n, 36 · c, h, w] times its own filter: [n, 36 · o, h, w]."""
        if not _PACKS:
            return F.conv2d(turned, self._filters, groups=_POINTS)
        shape = turned.shape
        if shape not in self._packed:
            how: tuple[Any, ...] = ([0, 0], [1, 1], [1, 1], _POINTS, shape)
            self._packed[shape] = torch._C._nn.mkldnn_reorder_conv2d_weight(self._filters.to_mkldnn(), *how)
        plain: tuple[Any, ...] = (None, [0, 0], [1, 1], [1, 1], _POINTS, "none", [], "")
        out: Tensor = torch.ops.mkldnn._convolution_pointwise(turned, self._packed[shape], *plain)
        return out


@compiled
def _turn(x: Any, begin: Any, d: Any, lanes: Any, out: Any) -> None:
    """Tiles of `x` [n, h, w, c] as what they are multiplied as, into `out` [strips, w / 4, 6, 6 · c], from strip `begin` on.

    A strip is the tiles in a row; d is the dilation: every d-th row and column is a map of its own. Columns are turned
    first, once for all tiles of a strip. `lanes` has as many entries as there are channels, which so are known when this
    is compiled: twice as fast.
    """
    _, rows, columns, _ = x.shape
    channels, wide, per_map = len(lanes), 6 * len(lanes), rows // (4 * d)
    down = np.zeros((columns + 2 * d, 6, channels), np.float32)
    inner, across = down[d:], down.reshape(-1, wide)
    outside = np.zeros((columns, channels), np.float32)
    for k in range(out.shape[0]):
        i, strip = divmod(begin + k, rows // 4)
        top = strip // per_map + strip % per_map * 4 * d - d
        x0 = x[i, top] if top >= 0 else outside
        x1, x2, x3, x4 = x[i, top + d], x[i, top + 2 * d], x[i, top + 3 * d], x[i, top + 4 * d]
        x5 = x[i, top + 5 * d] if top + 5 * d < rows else outside
        for q in range(columns):
            for c in range(channels):
                a0, a1, a2, a3, a4, a5 = x0[q, c], x1[q, c], x2[q, c], x3[q, c], x4[q, c], x5[q, c]
                inner[q, 0, c] = fma(_FOUR, a0, fma(-_FIVE, a2, a4))
                even, odd = fma(-_FOUR, a2, a4), fma(-_FOUR, a1, a3)
                inner[q, 1, c], inner[q, 2, c] = even + odd, even - odd
                even, odd = a4 - a2, _TWO * (a3 - a1)
                inner[q, 3, c], inner[q, 4, c] = even + odd, even - odd
                inner[q, 5, c] = fma(_FOUR, a1, fma(-_FIVE, a3, a5))
        t = 0
        for left in range(d):
            for q in range(left, left + columns, 4 * d):
                b0, b1, b2 = across[q], across[q + d], across[q + 2 * d]
                b3, b4, b5 = across[q + 3 * d], across[q + 4 * d], across[q + 5 * d]
                tile = out[k, t]
                for c in range(wide):
                    a0, a1, a2, a3, a4, a5 = b0[c], b1[c], b2[c], b3[c], b4[c], b5[c]
                    tile[0, c] = fma(_FOUR, a0, fma(-_FIVE, a2, a4))
                    even, odd = fma(-_FOUR, a2, a4), fma(-_FOUR, a1, a3)
                    tile[1, c], tile[2, c] = even + odd, even - odd
                    even, odd = a4 - a2, _TWO * (a3 - a1)
                    tile[3, c], tile[4, c] = even + odd, even - odd
                    tile[5, c] = fma(_FOUR, a1, fma(-_FIVE, a3, a5))
                t += 1


@compiled
def _turn_back(products: Any, bias: Any, x: Any, begin: Any, d: Any, lanes: Any, out: Any) -> None:
    """The products [strips, w / 4, 6, 6 · o] as outputs [n, h, w, o], with bias and ReLU, on top of `x`, strips as `_turn` has them."""
    _, rows, columns, _ = out.shape
    channels, wide, per_map = len(lanes), 6 * len(lanes), rows // (4 * d)
    half, nothing = np.empty((4, 6, channels), np.float32), np.zeros(channels, np.float32)
    across = half.reshape(4, wide)
    for k in range(products.shape[0]):
        i, strip = divmod(begin + k, rows // 4)
        top = strip // per_map + strip % per_map * 4 * d
        y0, y1, y2, y3 = out[i, top], out[i, top + d], out[i, top + 2 * d], out[i, top + 3 * d]
        t = 0
        for start in range(d):
            for left in range(start, columns, 4 * d):
                tile = products[k, t]
                for c in range(wide):
                    a0, a1, a2, a3, a4, a5 = tile[0, c], tile[1, c], tile[2, c], tile[3, c], tile[4, c], tile[5, c]
                    near, less, far, apart = a1 + a2, a1 - a2, a3 + a4, a3 - a4
                    across[0, c], across[1, c] = a0 + near + far, fma(_TWO, apart, less)
                    across[2, c], across[3, c] = fma(_FOUR, far, near), fma(_EIGHT, apart, less) + a5
                for p in range(4):
                    line, q = half[p], left + p * d
                    z0, z1, z2, z3 = y0[q], y1[q], y2[q], y3[q]
                    if x is not None:
                        x0, x1, x2, x3 = x[i, top, q], x[i, top + d, q], x[i, top + 2 * d, q], x[i, top + 3 * d, q]
                    else:
                        x0, x1, x2, x3 = nothing, nothing, nothing, nothing
                    for c in range(channels):
                        a0, a1, a2, a3, a4, a5 = line[0, c], line[1, c], line[2, c], line[3, c], line[4, c], line[5, c]
                        near, less, far, apart, b = a1 + a2, a1 - a2, a3 + a4, a3 - a4, bias[c]
                        z0[c] = x0[c] + max(a0 + near + far + b, _ZERO)
                        z1[c] = x1[c] + max(fma(_TWO, apart, less) + b, _ZERO)
                        z2[c] = x2[c] + max(fma(_FOUR, far, near) + b, _ZERO)
                        z3[c] = x3[c] + max(fma(_EIGHT, apart, less) + a5 + b, _ZERO)
                t += 1
