"""A peer's map on the ego's grid, by both drones' estimated poses."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from perception.geometry import CELLS


def warp(
    features: Tensor, sent: Tensor, ego_pose: Tensor, peer_pose: Tensor, cell_m: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Peers' maps resampled on the ego's grid by estimated poses.

    Args:
        features: [k, c, 64, 64]; sent: [k, 1, 64, 64] bool.
        ego_pose: [3] or [k, 3] and peer_pose: [k, 3], x, y, yaw in ENU.
        cell_m: side of a cell.

    Returns:
        features [k, c, 64, 64] (zero where not sent), sent [k, 1, 64, 64] bool, inside [k, 1, 64, 64] bool. A cell
        counts as sent where at least half of its bilinear support was; its value is the mean of what was sent.
    """
    k, channels = features.shape[:2]
    delta = ego_pose - peer_pose
    c, s = torch.cos(peer_pose[:, 2]), torch.sin(peer_pose[:, 2])
    tx, ty = c * delta[:, 0] + s * delta[:, 1], c * delta[:, 1] - s * delta[:, 0]
    cd, sd = torch.cos(delta[:, 2]), torch.sin(delta[:, 2])
    # a point (x, y) of the ego's grid lies at R(Δψ)(x, y) + t in the peer's; in cells, from the centre of cell (0, 0)
    middle = (CELLS - 1) / 2
    axis = torch.arange(CELLS, device=features.device) - middle
    x, y = (plane[None] for plane in torch.meshgrid(axis, axis, indexing="ij"))
    cd, sd, tx, ty = (v[:, None, None] for v in (cd, sd, tx / cell_m + middle, ty / cell_m + middle))
    row, column = cd * x - sd * y + tx, sd * x + cd * y + ty
    half = CELLS - 0.5
    inside = (row >= -0.5) & (row <= half) & (column >= -0.5) & (column <= half)
    taps, weights = [], []
    base = torch.arange(k, device=features.device)[:, None, None] * CELLS**2
    mask = sent.flatten()
    for i in (row.floor(), row.floor() + 1):
        for j in (column.floor(), column.floor() + 1):
            there = (i >= 0) & (i < CELLS) & (j >= 0) & (j < CELLS)
            cell = (i.clamp(0, CELLS - 1) * CELLS + j.clamp(0, CELLS - 1)).long() + base
            taps.append(cell)
            weights.append((1 - (row - i).abs()) * (1 - (column - j).abs()) * (there & mask[cell]))
    support = torch.stack(weights, dim=-1)
    share = support.sum(dim=-1, keepdim=True)
    arrived = (share[..., 0] >= 0.5) & inside
    support = support / share.clamp_min(0.5) * arrived[..., None]
    # a weighted sum of four rows of the peer's table of cells, per cell: what embedding_bag is fast at
    table = features.permute(0, 2, 3, 1).reshape(k * CELLS**2, channels)
    moved = F.embedding_bag(
        torch.stack(taps, dim=-1).view(-1, 4), table, mode="sum", per_sample_weights=support.view(-1, 4)
    )
    moved = moved.view(k, CELLS, CELLS, channels).permute(0, 3, 1, 2)
    return moved, arrived[:, None], inside[:, None]
