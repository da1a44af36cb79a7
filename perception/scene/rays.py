"""The inner loop of the cameras, compiled: one ray after another down to the height field, and the colour that it meets.

A ray descends from the tallest thing in the window: slices of `SLICE_M` are skipped where a coarse maximum map says that
nothing is in reach, eight metres at once where a still coarser one says so, and walked in fine steps where something is
(0.5 m of height, 0.25 m below 2 m). Arithmetic is float32, rounded as written: the same arguments give the same image on every machine.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sortie.perception.compiled import compiled, fma

COARSE, FAR, FAR_REACH = 8, 32, 2
"""Pixels a side of the blocks of the two maximum maps, the coarser in how many blocks around it."""
SLICE_M = 2.0
REACH = 3.0
"""Rays flatter than 1:3 see haze: they meet the ground beyond the grid's corner."""
HAZE = (168, 178, 190)
_FAR_SLICES = 4
_F = np.float32
_ZERO, _ONE, _LEAST_DOWN, _WALL_M = _F(0.0), _F(1.0), _F(0.05), _F(0.8)
_REACH, _SLICE, _TO_COARSE, _TO_FAR = _F(REACH), _F(SLICE_M), _F(1 / COARSE), _F(1 / FAR)
_SIDE_X, _SIDE_Y = _F(0.55), _F(0.75)


@compiled
def _cell(x: Any, y: Any, scale: Any, rows: Any, columns: Any) -> Any:
    """The flat index of the block over which a ray is; the raster's edge goes on for ever."""
    column = np.int32(min(max(x * scale, _ZERO), _F(columns - 1)))
    return np.uint32(np.int32(min(max(y * scale, _ZERO), _F(rows - 1))) * np.int32(columns) + column)


@compiled
def see(
    rays: Any,
    turn: Any,
    eye: Any,
    res_m: Any,
    top_m: Any,
    heights: Any,
    coarses: Any,
    fars: Any,
    colours: Any,
    gain: Any,
    noise: Any,
    out: Any,
) -> None:
    """The colours that rays meet, into `out` uint8 [rays, 3].

    Args:
        rays: float32 [rays, 3], the body's frame; turn: float32 [3, 3], of which column j makes the world's axis j.
        eye: (x, y) in pixels of the raster and z in metres, float32; top_m: from which height on to look for things.
        res_m: side of a pixel, float32.
        heights, coarses, fars: float32 maps [rows, columns], and by blocks of 8 and 32 pixels; colours: uint8 [rows, columns, 3].
        gain: of the camera, float32; noise: uint8 [rays, 3], 0 … 15, of which 8 is none.
    """
    rows, columns = heights.shape
    height, coarse, far, colour = heights.ravel(), coarses.ravel(), fars.ravel(), colours.reshape(-1, 3)
    eye_x, eye_y, eye_z = eye
    slices = int(np.ceil(top_m / SLICE_M))
    hazy = np.array([_exposed(_F(HAZE[0]), gain), _exposed(_F(HAZE[1]), gain), _exposed(_F(HAZE[2]), gain)])
    for i in range(len(rays)):
        a, b, c = rays[i]
        dx = a * turn[0, 0] + b * turn[1, 0] + c * turn[2, 0]
        dy = a * turn[0, 1] + b * turn[1, 1] + c * turn[2, 1]
        dz = a * turn[0, 2] + b * turn[1, 2] + c * turn[2, 2]
        reach = max(-dz * _REACH, _ZERO)
        if dx * dx + dy * dy > reach * reach:
            for k in range(3):
                out[i, k] = _noisy(hazy[k], noise[i, k])
            continue
        down = max(-dz, _LEAST_DOWN) * res_m
        bx, by = dx / down, dy / down  # pixels sideways per metre of descent
        ax, ay = bx * eye_z + eye_x, by * eye_z + eye_y
        at, hit_m = _cell(ax, ay, _ONE, rows, columns), _ZERO
        step = slices - 1
        while step >= 0:
            low = _F(step) * _SLICE
            if step % _FAR_SLICES == _FAR_SLICES - 1 and step > _FAR_SLICES:
                middle = low - _SLICE
                over = _cell(fma(-middle, bx, ax), fma(-middle, by, ay), _TO_FAR, fars.shape[0], fars.shape[1])
                if far[over] <= low - _F(_FAR_SLICES - 1) * _SLICE:
                    step -= _FAR_SLICES
                    continue
            middle = low + _ONE
            over = _cell(fma(-middle, bx, ax), fma(-middle, by, ay), _TO_COARSE, coarses.shape[0], coarses.shape[1])
            if coarse[over] > low:
                fine, parts = (_F(0.25), 8) if step == 0 else (_F(0.5), 4)
                for k in range(parts - 1, -1, -1):
                    z = low + _F(k) * fine
                    if z <= _ZERO:
                        break
                    over = _cell(fma(-z, bx, ax), fma(-z, by, ay), _ONE, rows, columns)
                    if height[over] >= z:
                        at, hit_m = over, z
                        break
                if hit_m > _ZERO:
                    break
            step -= 1
        light = _ONE
        if height[at] - hit_m > _WALL_M:
            light = _SIDE_X if abs(bx) > abs(by) else _SIDE_Y
        for k in range(3):
            out[i, k] = _noisy(_exposed(_F(np.int32(_F(colour[at, k]) * light)), gain), noise[i, k])


@compiled
def _exposed(level: Any, gain: Any) -> Any:
    return np.int32(level * gain)


@compiled
def _noisy(level: Any, noise: Any) -> Any:
    return np.uint8(min(max(level + np.int32(noise) - np.int32(8), np.int32(0)), np.int32(255)))
