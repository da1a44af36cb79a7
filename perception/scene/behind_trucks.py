"""What trucks hide: they are the only vehicles that are higher than a person and that drones look over at an angle."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sortie.perception.scene.traffic import Cars

Floats = NDArray[np.float64]
_LEAST = 1e-9


def behind(trucks: Cars, xy_m: Floats, eye_m: Floats, from_m: float) -> NDArray[np.bool_]:
    """Whether a truck stands between points and those who look at them, [n].

    A truck is a box. Its own length of ground is not behind it, so that it does not hide itself.

    Args:
        xy_m: [n, 2] the points, ENU.
        eye_m: [n, 3] from where each is looked at.
        from_m: the height of the points.
    """
    rise_m = np.maximum(trucks.height_m - from_m, 0.0)
    slope = (eye_m[:, :2] - xy_m) / np.maximum(eye_m[:, 2:] - from_m, 1.0)
    cos, sin = np.cos(trucks.yaw_rad), np.sin(trucks.yaw_rad)
    x, y = xy_m[:, 0, None] - trucks.x_m, xy_m[:, 1, None] - trucks.y_m
    dx, dy = slope[:, 0, None] * rise_m, slope[:, 1, None] * rise_m
    # the ray as long as it is lower than the truck, in the truck's frame: p + t d, 0 ≤ t ≤ 1
    enter, leave = np.zeros_like(x), np.ones_like(x)
    within = np.ones(x.shape, bool)
    for p, d, half in (
        (cos * x + sin * y, cos * dx + sin * dy, trucks.length_m / 2),
        (cos * y - sin * x, cos * dy - sin * dx, trucks.width_m / 2),
    ):
        d = np.where(np.abs(d) < _LEAST, _LEAST, d)
        a, b = (-half - p) / d, (half - p) / d
        enter, leave = np.maximum(enter, np.minimum(a, b)), np.minimum(leave, np.maximum(a, b))
        within &= np.abs(p) <= half
    return np.asarray(((enter < leave) & ~within).any(axis=1))
