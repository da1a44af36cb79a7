"""The lift: five views to one bird's-eye image on the ground, by inverse perspective mapping.

The grid is the image grid of `geometry.py`. The lift assumes that everything lies on the ground, `est_position_m[2]` below the drone.
So whatever stands up leans outwards and hides what is behind it; a second viewpoint resolves that.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import torch

from sortie.perception.compiled import compiled, fma
from sortie.perception.geometry import FULL, Cameras, Geometry
from sortie.perception.scene.render import CAMERAS, tilt
from sortie.perception.scene.town import Bytes, FloatMap
from sortie.perception.types import Capture

_F = np.float32
_ZERO, _HALF, _ONE = _F(0.0), _F(0.5), _F(1.0)
_FRONT, _LEFT, _RIGHT, _BACK, _NADIR = _F(0.0), _F(1.0), _F(2.0), _F(3.0), _F(4.0)
_ROOT2, _NEAREST = _F(np.sqrt(2.0)), _F(0.1)


@lru_cache(maxsize=16)
def _lens(cameras: Cameras) -> FloatMap:
    """Tangents of half the fields of view; how far rows are looked for, so that bilinear taps stay in the camera's own; what a
    camera takes of the column of views (−1 … 1); and the pitch."""
    half_h, half_v, ahead, down = cameras.lens
    return np.array([half_h, half_v, 1.0 - 1.0 / cameras.height_px, 2.0 / len(CAMERAS), ahead, down], np.float32)


def ground_points(geometry: Geometry) -> torch.Tensor:
    """Centres of the grid's pixels, [px, px, 2] (x forward, y left), metres."""
    axis = (torch.arange(geometry.image_px) + 0.5) * geometry.image_m - geometry.half_extent_m
    return torch.stack(torch.meshgrid(axis, axis, indexing="ij"), dim=-1)


@lru_cache(maxsize=4)
def _planes(geometry: Geometry) -> tuple[FloatMap, FloatMap]:
    x, y = ground_points(geometry).unbind(-1)
    return x.contiguous().numpy(), y.contiguous().numpy()


def lift(views: Iterable[Bytes], captures: Sequence[Capture], geometry: Geometry = FULL) -> torch.Tensor:
    """Camera views, each uint8 [5, height, width, 3], to bird's-eye images uint8 [n, 4, px, px]: R, G, B, and 255 where any camera saw the ground."""
    out = np.empty((len(captures), 4, geometry.image_px, geometry.image_px), np.uint8)
    ground = _planes(geometry)
    for seen, capture, image in zip(views, captures, out, strict=True):
        level_to_body = tilt(capture.orientation_xyzw).T.astype(np.float32)
        down = (level_to_body[:, 2].astype(float) * -max(capture.est_position_m[2], 1.0)).astype(np.float32)
        column = seen.reshape(-1, capture.cameras.width_px, 3)
        _unproject(column, level_to_body, down, _lens(capture.cameras), *ground, image)
    return torch.from_numpy(out)


@compiled
def _unproject(views: Any, turn: Any, down: Any, lens: Any, ground_x: Any, ground_y: Any, out: Any) -> None:
    """Look for each ground point of the grid ([px, px] each) in the column of views, uint8 [5 · height, width, 3]; into `out` [4, px, px]."""
    rows, columns, _ = views.shape
    half_h, half_v, inset, view, flat, steep = lens
    for i in range(ground_x.shape[0]):
        for j in range(ground_x.shape[1]):
            gx, gy = ground_x[i, j], ground_y[i, j]
            x = fma(turn[0, 1], gy, gx * turn[0, 0]) + down[0]
            y = fma(turn[1, 1], gy, gx * turn[1, 0]) + down[1]
            z = fma(turn[2, 1], gy, gx * turn[2, 0]) + down[2]
            # straight down first: right is −y, image-down is −x
            depth = max(-z, _NEAREST)
            u, v, camera = -y / (depth * half_h), -x / (depth * half_v), _NADIR
            seen = abs(u) < _ONE and abs(v) < _ONE and z < _ZERO
            if not seen:  # the camera of the quadrant: a forward and b right of it, pitched down
                if abs(x) >= abs(y):
                    ahead, right, camera = abs(x), (-y if x > _ZERO else y), (_FRONT if x >= _ZERO else _BACK)
                else:
                    ahead, right, camera = abs(y), (x if y > _ZERO else -x), (_LEFT if y >= _ZERO else _RIGHT)
                forward = (flat * ahead - steep * z) / _ROOT2
                u, v = right / (forward * half_h), (-steep * ahead - flat * z) / (_ROOT2 * forward * half_v)
                seen = abs(u) < _ONE and abs(v) < _ONE and forward > _ONE
            if not seen:
                out[:, i, j] = 0
                continue
            v = min(max(v, -inset), inset)
            row = (camera + _HALF + _HALF * v) * view - _ONE
            p = min(max(fma(u + _ONE, _F(0.5 * columns), -_HALF), _ZERO), _F(columns - 1))
            q = min(max(fma(row + _ONE, _F(0.5 * rows), -_HALF), _ZERO), _F(rows - 1))
            left, top = np.int32(p), np.int32(q)
            after, below = min(left + 1, columns - 1), min(top + 1, rows - 1)
            w, n = p - _F(left), q - _F(top)
            e, s = _ONE - w, _ONE - n
            for k in range(3):
                level = fma(_F(views[top, after, k]), w * s, _F(views[top, left, k]) * (e * s))
                level = fma(_F(views[below, left, k]), e * n, level)
                level = fma(_F(views[below, after, k]), w * n, level)
                out[k, i, j] = np.uint8(np.rint(level))
            out[3, i, j] = 255
