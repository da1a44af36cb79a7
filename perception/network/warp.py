"""A peer's map on the ego's grid, by both drones' estimated poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sortie.perception.compiled import compiled
from sortie.perception.geometry import CELLS


class Support(NamedTuple):
    """Where each cell of an ego's grid of n × n cells lies on a peer's: the four cells around it and their bilinear weights."""

    cells: Tensor
    """[k, n, n, 4] long, row-major index on the peer's grid."""
    weights: Tensor
    """[k, n, n, 4], 0 for a cell beyond the peer's grid."""
    inside: Tensor
    """[k, n, n] bool: the peer's grid covers it."""
    offset: Tensor
    """[k, n, n, 2]: how far it lies from the centre of the peer's nearest cell, in cells, along rows and columns."""
    turn: Tensor
    """[k]: the peer's heading minus the ego's, radians."""


def support(ego_pose: Tensor, peer_pose: Tensor, cell_m: float, n: int = CELLS) -> Support:
    """The cells of k peers under the ego's grid, by estimated poses [3] or [k, 3] and [k, 3] (x, y, yaw in ENU).

    Args: `cell_m` and `n`, a cell's side and how many there are along a side of the grids.

    Raises:
        ValueError: a pose that is not finite, on a CPU.
    """
    delta = ego_pose - peer_pose
    c, s = torch.cos(peer_pose[:, 2]), torch.sin(peer_pose[:, 2])
    tx, ty = c * delta[:, 0] + s * delta[:, 1], c * delta[:, 1] - s * delta[:, 0]
    cd, sd = torch.cos(delta[:, 2]), torch.sin(delta[:, 2])
    middle = (n - 1) / 2
    place = cd, sd, tx / cell_m + middle, ty / cell_m + middle
    if peer_pose.device.type != "cpu":
        return Support(*_laid(place, n), -delta[:, 2])
    if not all(bool(v.isfinite().all()) for v in place):
        raise ValueError(f"poses are {ego_pose.tolist()} and {peer_pose.tolist()}, must be finite")
    k = len(peer_pose)
    cells, weights = torch.empty(k, n, n, 4, dtype=torch.long), torch.empty(k, n, n, 4)
    inside, offset = torch.empty(k, n, n, dtype=torch.bool), torch.empty(k, n, n, 2)
    _lay(*(v.numpy() for v in (*place, cells, weights, inside, offset)))
    return Support(cells, weights, inside, offset, -delta[:, 2])


def _laid(place: Sequence[Tensor], n: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`_lay` by tensors, for accelerators."""
    # a point (x, y) of the ego's grid lies at R(Δψ)(x, y) + t in the peer's; in cells, from the centre of cell (0, 0)
    cd, sd, tx, ty = (v[:, None, None] for v in place)
    axis = torch.arange(n, device=cd.device) - (n - 1) / 2
    x, y = (plane[None] for plane in torch.meshgrid(axis, axis, indexing="ij"))
    row, column = cd * x - sd * y + tx, sd * x + cd * y + ty
    half = n - 0.5
    inside = (row >= -0.5) & (row <= half) & (column >= -0.5) & (column <= half)
    down, across = _beside(row, n), _beside(column, n)
    cells = [i * n + j for i, _ in down for j, _ in across]
    weights = [part * share for _, part in down for _, share in across]
    offset = torch.stack([row - row.round(), column - column.round()], dim=-1)
    return torch.stack(cells, dim=-1), torch.stack(weights, dim=-1), inside, offset


def _beside(at: Tensor, n: int) -> list[tuple[Tensor, Tensor]]:
    """The two cells about each place on an axis, kept on the grid, and what each counts: 0 off the grid."""
    low = at.floor()
    out = []
    for cell in (low, low + 1):
        on = cell.clamp(0, n - 1)
        out.append((on.long(), (1 - (at - cell).abs()) * (cell == on)))
    return out


def arriving(under: Support, sent: Tensor) -> tuple[Tensor, Tensor]:
    """What of a support was sent, [k, n²] bool: the weights renormalised [k, n, n, 4], and where anything arrived.

    A cell counts as sent where at least half of its support was.
    """
    if sent.device.type != "cpu":
        return _arrived(under, sent)
    weights, arrived = torch.empty_like(under.weights), torch.empty_like(under.inside)
    _arrive(*(v.numpy() for v in (under.cells, under.weights, under.inside, sent, weights, arrived)))
    return weights, arrived


def _arrived(under: Support, sent: Tensor) -> tuple[Tensor, Tensor]:
    """`_arrive` by tensors, for accelerators."""
    weights = under.weights * sent.gather(1, under.cells.flatten(1)).view(under.cells.shape)
    share = weights.sum(dim=-1, keepdim=True)
    arrived = (share[..., 0] >= 0.5) & under.inside
    return weights / share.clamp_min(0.5) * arrived[..., None], arrived


def rows(table: Tensor, cells: Tensor, weights: Tensor) -> Tensor:
    """A peer's features [p, c] on chosen cells of the ego's grid.

    Args:
        table: [cells of the peer's grid, c].
        cells, weights: [p, 4] as in `Support`.
    """
    # a weighted sum of four rows of the table, per cell: what embedding_bag is fast at
    out: Tensor = F.embedding_bag(cells, table, mode="sum", per_sample_weights=weights)
    return out


def warp(
    features: Tensor, sent: Tensor, ego_pose: Tensor, peer_pose: Tensor, cell_m: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Peers' maps resampled on the ego's grid by estimated poses.

    Args:
        features: [k, c, n, n]; sent: [k, 1, n, n] bool.
        ego_pose: [3] or [k, 3] and peer_pose: [k, 3], x, y, yaw in ENU.
        cell_m: side of a cell.

    Returns:
        features [k, c, n, n] (zero where not sent), sent [k, 1, n, n] bool, inside [k, 1, n, n] bool. A cell
        counts as sent where at least half of its bilinear support was; its value is the mean of what was sent.
    """
    under = support(ego_pose, peer_pose, cell_m, features.shape[-1])
    weights, arrived = arriving(under, sent.flatten(1))
    return moved(features, under, weights), arrived[:, None], under.inside[:, None]


def moved(features: Tensor, under: Support, weights: Tensor) -> Tensor:
    """Peers' maps [k, c, n, n] on the ego's grid, by the weights of what arrived."""
    k, channels, n, _ = features.shape
    taps = under.cells + torch.arange(k, device=features.device)[:, None, None, None] * n**2
    out = rows(features.permute(0, 2, 3, 1).reshape(k * n**2, channels), taps.view(-1, 4), weights.view(-1, 4))
    return out.view(k, n, n, channels).permute(0, 3, 1, 2)


_HALF, _ONE, _NONE = np.float32(0.5), np.float32(1.0), np.float32(0.0)


@compiled
def _lay(cd: Any, sd: Any, tx: Any, ty: Any, cells: Any, weights: Any, inside: Any, offset: Any) -> None:
    """Fill a `Support` of k peers: turns and shifts [k], shifts in cells from the centre of cell (0, 0); rounded as tensors are."""
    n = cells.shape[1]
    middle, last, half = np.float32((n - 1) / 2), np.float32(n - 1), np.float32(n - 0.5)
    at, on, part = np.empty(2, np.float32), np.empty((2, 2), np.int64), np.empty((2, 2), np.float32)
    for k in range(len(cd)):
        for i in range(n):
            x = np.float32(i) - middle
            for j in range(n):
                y = np.float32(j) - middle
                at[0], at[1] = cd[k] * x - sd[k] * y + tx[k], sd[k] * x + cd[k] * y + ty[k]
                for axis in range(2):
                    low = np.floor(at[axis])
                    for side in range(2):
                        cell = low + np.float32(side)
                        kept = min(max(cell, _NONE), last)
                        on[axis, side] = np.int64(kept)
                        part[axis, side] = _ONE - abs(at[axis] - cell) if cell == kept else _NONE
                    offset[k, i, j, axis] = at[axis] - np.rint(at[axis])
                inside[k, i, j] = -_HALF <= at[0] <= half and -_HALF <= at[1] <= half
                for corner in range(4):
                    down, across = corner // 2, corner % 2
                    cells[k, i, j, corner] = on[0, down] * n + on[1, across]
                    weights[k, i, j, corner] = part[0, down] * part[1, across]


@compiled
def _arrive(cells: Any, weights: Any, inside: Any, sent: Any, out: Any, arrived: Any) -> None:
    """Fill what `arriving` returns."""
    for k in range(cells.shape[0]):
        for i in range(cells.shape[1]):
            for j in range(cells.shape[2]):
                share = _NONE
                for corner in range(4):
                    out[k, i, j, corner] = weights[k, i, j, corner] if sent[k, cells[k, i, j, corner]] else _NONE
                    share += out[k, i, j, corner]
                arrived[k, i, j] = share >= _HALF and inside[k, i, j]
                for corner in range(4):
                    out[k, i, j, corner] = out[k, i, j, corner] / share if arrived[k, i, j] else _NONE
