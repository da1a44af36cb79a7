"""A peer's map on the ego's grid, by both drones' estimated poses."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

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
    """
    delta = ego_pose - peer_pose
    c, s = torch.cos(peer_pose[:, 2]), torch.sin(peer_pose[:, 2])
    tx, ty = c * delta[:, 0] + s * delta[:, 1], c * delta[:, 1] - s * delta[:, 0]
    cd, sd = torch.cos(delta[:, 2]), torch.sin(delta[:, 2])
    # a point (x, y) of the ego's grid lies at R(Δψ)(x, y) + t in the peer's; in cells, from the centre of cell (0, 0)
    middle = (n - 1) / 2
    axis = torch.arange(n, device=peer_pose.device) - middle
    x, y = (plane[None] for plane in torch.meshgrid(axis, axis, indexing="ij"))
    cd, sd, tx, ty = (v[:, None, None] for v in (cd, sd, tx / cell_m + middle, ty / cell_m + middle))
    row, column = cd * x - sd * y + tx, sd * x + cd * y + ty
    half = n - 0.5
    inside = (row >= -0.5) & (row <= half) & (column >= -0.5) & (column <= half)
    down, across = _beside(row, n), _beside(column, n)
    cells = [i * n + j for i, _ in down for j, _ in across]
    weights = [part * share for _, part in down for _, share in across]
    offset = torch.stack([row - row.round(), column - column.round()], dim=-1)
    return Support(torch.stack(cells, dim=-1), torch.stack(weights, dim=-1), inside, offset, -delta[:, 2])


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
    k = len(sent)
    weights = under.weights * sent.gather(1, under.cells.view(k, -1)).view(under.cells.shape)
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
