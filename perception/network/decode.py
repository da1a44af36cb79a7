"""The head's output and the boxes that it means."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sortie.perception.budget import MOST_BOXES
from sortie.perception.geometry import FULL, HEAD_PX, Geometry
from sortie.perception.joining import NMS_IOU, Pose
from sortie.perception.metrics.ap import suppress
from sortie.perception.types import Boxes

REFERENCE_SIZE_M = (4.5, 1.85)
"""Length and width for which the size head says 0."""


def decode(out: Tensor, threshold: float, geometry: Geometry = FULL, limit: int = MOST_BOXES) -> Tensor:
    """One head output [7 or 8, 128, 128] → boxes [m, 6] in the ego's frame: x forward, y left, length, width, yaw, score.

    Peaks are local maxima of the heat map over 3 × 3 cells, at or above `threshold`, at most `limit`, best first. With
    an eighth plane, how well each box fits, the map is the geometric mean of heat and fit (IoU-aware scores: Wu, Li and
    Wang, *Image and Vision Computing* 97, 2020, with α = 0.5).
    """
    heat = out[0].sigmoid()
    if len(out) > 7:
        heat = (heat * out[7].sigmoid()).sqrt()
    hot = (heat >= threshold).flatten().nonzero().squeeze(1)
    # the neighbours of those alone: a maximum over the whole map takes twice as long as all the rest
    padded, wide = F.pad(heat, (1, 1, 1, 1), value=-1.0).flatten(), HEAD_PX + 2
    around = torch.tensor([i * wide + j for i in range(3) for j in range(3)], device=out.device)
    corner = hot // HEAD_PX * wide + hot % HEAD_PX
    flat = hot[heat.flatten()[hot] >= padded[corner[:, None] + around].amax(dim=1)]
    score = heat.flatten()[flat]
    order = score.argsort(descending=True, stable=True)[:limit]
    flat, score = flat[order], score[order]
    values = out[1:].flatten(1)[:, flat]
    row, column = flat // HEAD_PX, flat % HEAD_PX
    x = (row + 0.5 + values[0]) * geometry.head_m - geometry.half_extent_m
    y = (column + 0.5 + values[1]) * geometry.head_m - geometry.half_extent_m
    size = [REFERENCE_SIZE_M[i] * values[2 + i].clamp(-1, 1).exp() for i in (0, 1)]
    yaw = 0.5 * torch.atan2(values[4], values[5])
    return torch.stack([x, y, *size, yaw, score], dim=1)


def placed_boxes(out: Tensor, pose: Pose, threshold: float, geometry: Geometry = FULL) -> Boxes:
    """The boxes of one head output in the world by its drone's pose, suppressed, best first; as `decode`."""
    return suppress(Boxes.placed(decode(out, threshold, geometry).numpy(), pose), NMS_IOU)
