"""The lift: five views to one bird's-eye image on the ground, by inverse perspective mapping.

The grid is the image grid of `geometry.py`. The lift assumes that everything lies on the ground, which the lift is told to be `est_position_m[2]` below:
what stands up leans outwards and hides what is behind it. That is what a second viewpoint resolves.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)

from perception.geometry import FULL, IMAGE_PX, Geometry
from perception.render import CAMERAS, HALF_H, HALF_V, HEIGHT_PX, tilt
from perception.town import Bytes
from perception.types import Capture

_ROOT2 = float(np.sqrt(2.0))


def ground_points(geometry: Geometry) -> torch.Tensor:
    """Centres of the grid's pixels, [256, 256, 2] (x forward, y left), metres."""
    axis = (torch.arange(IMAGE_PX) + 0.5) * geometry.image_m - geometry.half_extent_m
    return torch.stack(torch.meshgrid(axis, axis, indexing="ij"), dim=-1)


@lru_cache(maxsize=4)
def _planes(geometry: Geometry) -> tuple[torch.Tensor, torch.Tensor]:
    x, y = ground_points(geometry).unbind(-1)
    return x.contiguous(), y.contiguous()


def lift(views: Bytes, captures: Sequence[Capture], geometry: Geometry = FULL) -> torch.Tensor:
    """Camera views uint8 [n, 5, 90, 160, 3] to bird's-eye images uint8 [n, 4, 256, 256]: R, G, B, and 255 where any camera saw the ground."""
    n = len(captures)
    if n == 0:
        return torch.empty(0, 4, IMAGE_PX, IMAGE_PX, dtype=torch.uint8)
    atlas = torch.from_numpy(np.ascontiguousarray(views)).permute(0, 4, 1, 2, 3)
    atlas = atlas.reshape(n, 3, len(CAMERAS) * HEIGHT_PX, -1).float()
    grids, seen = zip(*(_sampling(c, geometry) for c in captures), strict=True)
    rgb = F.grid_sample(atlas, torch.stack(grids), mode="bilinear", padding_mode="border", align_corners=False)
    valid = torch.stack(seen)[:, None]
    return torch.cat([rgb * valid, valid * 255.0], dim=1).round_().to(torch.uint8)


def _sampling(capture: Capture, geometry: Geometry) -> tuple[torch.Tensor, torch.Tensor]:
    """For each pixel of the grid, where to look in the column of five views ([256, 256, 2], −1 … 1), and whether it is in one."""
    level_to_body = torch.from_numpy(tilt(capture.orientation_xyzw).T.astype(np.float32))
    down = -max(capture.est_position_m[2], 1.0)
    ground_x, ground_y = _planes(geometry)
    x, y, z = (torch.add(ground_x * r[0], ground_y, alpha=r[1]).add_(down * r[2]) for r in level_to_body.tolist())
    depth = (-z).clamp_(min=0.1)
    # straight down first: right is −y, image-down is −x
    u, v = -y / (depth * HALF_H), -x / (depth * HALF_V)
    nadir = (u.abs() < 1) & (v.abs() < 1) & (z < 0)
    # else the camera of the quadrant: a forward and b right of it, pitched 45° down
    lengthwise = x.abs() >= y.abs()
    ahead = torch.where(lengthwise, x.abs(), y.abs())
    right = torch.where(lengthwise, -y * x.sign(), x * y.sign())
    camera = torch.where(lengthwise, torch.where(x >= 0, 0.0, 3.0), torch.where(y >= 0, 1.0, 2.0))
    forward = (ahead - z) / _ROOT2
    u = torch.where(nadir, u, right / (forward * HALF_H))
    v = torch.where(nadir, v, (-ahead - z) / (_ROOT2 * forward * HALF_V))
    camera = torch.where(nadir, 4.0, camera)
    seen = (u.abs() < 1) & (v.abs() < 1) & (nadir | (forward > 1.0))
    inset = 1.0 - 1.0 / HEIGHT_PX  # keep bilinear taps inside the camera's own rows
    row = (camera + 0.5 + 0.5 * v.clamp(-inset, inset)) * (2.0 / len(CAMERAS)) - 1.0
    return torch.stack([u.clamp(-1, 1), row], dim=-1), seen.float()
