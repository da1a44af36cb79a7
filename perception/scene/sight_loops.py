"""Compiled loops over rays that rise from the ground (`sortie.perception.scene.height_field`), in single precision."""

from __future__ import annotations

import numpy as np

from sortie.scenarios.compiled import compiled, part

# constants of the file itself: kept machine code does not see that another file has changed
_RES_M, _STEP_M = 0.8, 1.0
_F = np.float32
_HALF = _F(0.5)


@part
def _is_clear(tops_m, columns, px, py, slope_x, slope_y, from_m, steps):
    """Whether a ray upwards from a height meets no roof and no crown."""
    px, py = px - _HALF * slope_x, py - _HALF * slope_y
    for k in range(steps):
        px, py = px + slope_x, py + slope_y
        pixel = min(max(np.int64(py) * columns + np.int64(px), 0), len(tops_m) - 1)
        if not tops_m[pixel] < _F(from_m + (k + 0.5) * _STEP_M):
            return False
    return True


@compiled
def march(tops_m, columns, px, py, slope_x, slope_y, from_m, steps):
    """Whether rays upwards from a height are clear, [n].

    Args:
        tops_m, columns: heights of the raster, flat, and its columns.
        px, py: [n] float32, where rays begin, in pixels.
        slope_x, slope_y: [n] float32, pixels for each step upwards.
        from_m: the height.
        steps: how many a ray takes until it is above all.
    """
    clear = np.empty(len(px), np.bool_)
    for k in range(len(px)):
        clear[k] = _is_clear(tops_m, columns, px[k], py[k], slope_x[k], slope_y[k], from_m, steps)
    return clear


@compiled
def hide(
    states, at, eye_m, east_m, north_m, cosine, sine, reach_m2, tops_m, roofed, columns, x0_m, y0_m, from_m, steps
):
    """Set those cells of `states` [frames, drones, 16, 16] to 0 of which less than half of the open ground is in sight.

    Args:
        at: [frames, drones], the place of each in the next arrays. Frames that follow one another may share one.
        eye_m: [K, 3], where the drone is.
        east_m, north_m: [K, several times C], from where it believes to be to the lines of sight's ends.
        cosine, sine: [K], by which what it believes is turned into what is.
        reach_m2: lines that are longer do not count.
        tops_m, roofed, columns, x0_m, y0_m: the raster of the scene, flat, its columns and its south-west corner.
        from_m: height of the lines' ends.
        steps: how many a line takes until it is above all.
    """
    cells = states.shape[-1]
    samples = east_m.shape[1] // cells
    known = np.zeros(cells * cells, np.int8)  # 1 in sight, -1 hidden, 0 not known yet
    for drone in range(states.shape[1]):
        for frame in range(len(states)):
            k = at[frame, drone]
            if frame == 0 or k != at[frame - 1, drone]:
                known[:] = 0
            x_m, y_m, c, s = eye_m[k, 0], eye_m[k, 1], cosine[k], sine[k]
            fall_m = max(eye_m[k, 2] - from_m, 1.0)
            for cell in range(cells * cells):
                row, column = cell // cells, cell % cells
                if states[frame, drone, row, column] == 0:
                    continue
                if known[cell] == 0:
                    there = seen = 0
                    for i in range(samples * row, samples * (row + 1)):
                        for j in range(samples * column, samples * (column + 1)):
                            east, north = east_m[k, j], north_m[k, i]
                            x, y = x_m + c * east - s * north, y_m + s * east + c * north
                            px, py = (x - x0_m) / _RES_M, (y - y0_m) / _RES_M
                            pixel = min(max(np.int64(py) * columns + np.int64(px), 0), len(roofed) - 1)
                            if east * east + north * north <= reach_m2 and not roofed[pixel]:
                                slope_x, slope_y = (x_m - x) / fall_m, (y_m - y) / fall_m
                                there += 1
                                seen += _is_clear(
                                    tops_m,
                                    columns,
                                    _F(px),
                                    _F(py),
                                    _F(slope_x * (_STEP_M / _RES_M)),
                                    _F(slope_y * (_STEP_M / _RES_M)),
                                    from_m,
                                    steps,
                                )
                    known[cell] = 1 if there > 0 and 2 * seen >= there else -1
                if known[cell] < 0:
                    states[frame, drone, row, column] = 0
