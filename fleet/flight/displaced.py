"""The flight that comes of granted moves (`fleet.viewpoints`): true and believed states from a frame on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from sortie.fleet.flight.frames import yaw_rad
from sortie.fleet.flight.motion import DRAG_PER_S, GRAVITY_MPS2, Trajectories, attitude, body_rates
from sortie.fleet.flight.viewpoints import Course, Plan, shifts
from sortie.scenarios import scratch

Array = npt.NDArray[np.float64]


def displaced(
    flown: Trajectories, base: Trajectories, course: Course, plans: Sequence[Plan], frame: int
) -> Trajectories:
    """The flight, from a frame on, with every drone's moves: what was flown before stays bit for bit.

    Place, velocity and acceleration follow from the rotating frame; attitude from the thrust that they ask for in the
    drone's own wind, as without moves; what a drone believes keeps its errors.

    Args:
        flown: the flight up to `frame`.
        base: the flight without any moves.
    """
    names = (
        "position_m", "velocity_mps", "acceleration_mps2", "orientation_xyzw", "body_rates_radps", "yaw_rad",
        "est_position_m", "est_yaw_rad",
    )  # fmt: skip
    new: dict[str, Array] = {name: scratch.copied(getattr(flown, name)) for name in names}
    rest = slice(frame, None)
    path = course.path
    cos, sin = np.cos(path.yaw_rad[rest])[:, None], np.sin(path.yaw_rad[rest])[:, None]
    rate, rate_change = path.yaw_rate_radps[rest, None], path.yaw_acceleration_radps2[rest, None]
    for drone in [i for i, plan in enumerate(plans) if plan]:
        shift, speed, push = (_turned(v, cos, sin) for v in shifts(plans[drone], course.time_s[rest]))
        new["position_m"][rest, drone, :2] = base.position_m[rest, drone, :2] + shift
        new["est_position_m"][rest, drone, :2] = base.est_position_m[rest, drone, :2] + shift
        velocity = base.velocity_mps[rest, drone].copy()
        velocity[:, :2] += speed + rate * _across(shift)
        acceleration = base.acceleration_mps2[rest, drone].copy()
        acceleration[:, :2] += push + 2 * rate * _across(speed) + rate_change * _across(shift) - rate**2 * shift
        thrust = acceleration + DRAG_PER_S * (velocity - base.wind_mps[rest, drone])
        thrust[:, 2] += GRAVITY_MPS2
        orientation = attitude(thrust, base.frame_yaw_rad[rest])
        orientation *= _signs(np.concatenate([flown.orientation_xyzw[max(frame - 1, 0), drone][None], orientation]))
        yaw = yaw_rad(orientation)
        believed = yaw + base.est_yaw_rad[rest, drone] - base.yaw_rad[rest, drone]
        velocity[:, 2] = flown.velocity_mps[rest, drone, 2]  # it may descend
        new["velocity_mps"][rest, drone], new["acceleration_mps2"][rest, drone] = velocity, acceleration
        new["orientation_xyzw"][rest, drone], new["yaw_rad"][rest, drone] = orientation, yaw
        new["est_yaw_rad"][rest, drone] = np.mod(believed + np.pi, 2 * np.pi) - np.pi
        step_s = float(course.time_s[1] - course.time_s[0])
        new["body_rates_radps"][rest, drone] = body_rates(orientation[:, None], step_s)[:, 0]
    return replace(flown, **new)


def _turned(values: Array, cos: Array, sin: Array) -> Array:
    """[T, 2] of the formation's frame, in ENU."""
    x, y = values[:, :1], values[:, 1:]
    return np.concatenate([cos * x - sin * y, sin * x + cos * y], axis=-1)


def _across(values: Array) -> Array:
    """Turned left by a right angle."""
    return np.stack([-values[:, 1], values[:, 0]], axis=-1)


def _signs(quaternions: Array) -> Array:
    """Factors [T, 1] for all but the first of [T + 1, 4] that keep each on the side of the one before."""
    flips = np.sign((quaternions[1:] * quaternions[:-1]).sum(axis=-1))
    flips[flips == 0] = 1.0
    return np.asarray(np.cumprod(flips))[:, None]
