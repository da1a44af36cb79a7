"""Compiled loops over the cells of coverage grids (`sortie.fleet.coverage`). Cameras are reckoned in single precision."""

from __future__ import annotations

import numpy as np

from sortie.scenarios.compiled import compiled, part

# constants of the file itself: kept machine code does not see that another file has changed
_CELLS, _WELL = 16, 2
_F = np.float32
_ONE, _LEAST, _FAR, _ROOT = _F(1.0), _F(0.1), _F(np.inf), _F(np.sqrt(2.0))
_ROOT_64 = np.sqrt(2.0)


@part
def _depth_m(x, y, z, half_h, half_v, ahead, down):
    """How far a point lies in front of the camera that shows it largest, along its axis; infinite where none shows it.

    The point is in the body frame; which directions a picture shows is `sortie.perception.geometry.camera_margins`.
    """
    along, across, depth = abs(x), abs(y), max(-z, _LEAST)
    nearest = -z if _ONE - max(across / _F(half_h), along / _F(half_v)) / depth > 0.0 else _FAR
    most, least = max(along, across), min(along, across)
    axis = _F(ahead) * most - _F(down) * z
    forward = max(axis / _ROOT_64, 0.1)
    u = least / (forward * half_h)
    v = abs(-_F(down) * most - _F(ahead) * z) / (_ROOT_64 * forward * half_v)
    return min(nearest, axis / _ROOT) if 1.0 - max(u, v) > 0.0 else nearest


@compiled
def camera_states(x_m, y_m, height_m, body, middles_m, half_h, half_v, ahead, down, near_m2, well_m2, states):
    """How well cameras see the cells around them where nothing stands in between, into `states` [K, 16, 16].

    Args:
        x_m, y_m, height_m: [K] float32, from the grid's middle to the drone, and above the ground.
        body: [K, 3, 3] float32, the attitude.
        middles_m: [16] float32, of the cells along either axis.
        half_h, half_v, ahead, down: the lens.
        near_m2, well_m2: float32. A cell is in range by the first; it is seen well where depth³ ÷ height is at most the second.
    """
    for k in range(len(states)):
        up, turn = height_m[k], body[k]
        for row in range(_CELLS):
            north = middles_m[row] - y_m[k]
            for column in range(_CELLS):
                east = middles_m[column] - x_m[k]
                states[k, row, column] = 0
                if east * east + north * north <= near_m2:
                    x = turn[0, 0] * east + turn[1, 0] * north - turn[2, 0] * up
                    y = turn[0, 1] * east + turn[1, 1] * north - turn[2, 1] * up
                    z = turn[0, 2] * east + turn[1, 2] * north - turn[2, 2] * up
                    depth = _depth_m(x, y, z, half_h, half_v, ahead, down)
                    if depth < _FAR:
                        states[k, row, column] = 1 + (depth * depth * depth <= well_m2 * up)


@compiled
def count(grids, could):
    """Cells of packed grids [K, 64] that are seen well and could not be so by the states of `could` [K, 16, 16], and cells
    that are seen: [K, 2]."""
    found = np.zeros((len(grids), 2), np.int64)
    for k in range(len(grids)):
        for cell in range(_CELLS * _CELLS):
            state = (grids[k, cell >> 2] >> np.uint8(2 * (cell & 3))) & np.uint8(3)
            found[k, 0] += state >= _WELL and could[k, cell // _CELLS, cell % _CELLS] < _WELL
            found[k, 1] += state > 0
    return found
