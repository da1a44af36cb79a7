"""The flight that comes of granted moves and steering: true and believed states from a frame on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
    new = _copied(flown)
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
        orientation = _orientation(flown, base, drone, frame, velocity, acceleration, base.frame_yaw_rad[rest])
        velocity[:, 2] = flown.velocity_mps[rest, drone, 2]  # it may descend
        _put(new, base, drone, rest, velocity, acceleration, orientation)
    return replace(flown, **new)


def steered(
    flown: Trajectories, base: Trajectories, shifts_m: Mapping[int, tuple[Array, Array, Array]], frame: int
) -> Trajectories:
    """The flight, from a frame on, of drones that are steered away from where they hover: earlier frames stay bit for bit.

    Args:
        flown: the flight up to `frame`.
        base: the flight in which they hover, heading east.
        shifts_m: by drone, the shift of its place from that frame on and its two derivatives, [F, 3] each, ENU.
    """
    new, rest = _copied(flown), slice(frame, None)
    for drone, (shift, speed, push) in shifts_m.items():
        new["position_m"][rest, drone] = base.position_m[rest, drone] + shift
        new["est_position_m"][rest, drone] = base.est_position_m[rest, drone] + shift
        velocity, acceleration = base.velocity_mps[rest, drone] + speed, base.acceleration_mps2[rest, drone] + push
        east = np.zeros(len(velocity))
        orientation = _orientation(flown, base, drone, frame, velocity, acceleration, east)
        _put(new, base, drone, rest, velocity, acceleration, orientation)
    return replace(flown, **new)


def _copied(flown: Trajectories) -> dict[str, Array]:
    """Copies of what moves change."""
    names = (
        "position_m",
        "velocity_mps",
        "acceleration_mps2",
        "orientation_xyzw",
        "body_rates_radps",
        "yaw_rad",
        "est_position_m",
        "est_yaw_rad",
    )
    return {name: scratch.copied(getattr(flown, name)) for name in names}


def _orientation(
    flown: Trajectories, base: Trajectories, drone: int, frame: int, velocity: Array, acceleration: Array, yaw: Array
) -> Array:
    """The attitude that a motion asks for in the drone's own wind, without a jump of sign from what was flown."""
    rest = slice(frame, None)
    thrust = acceleration + DRAG_PER_S * (velocity - base.wind_mps[rest, drone])
    thrust[:, 2] += GRAVITY_MPS2
    orientation = attitude(thrust, yaw)
    orientation *= _signs(np.concatenate([flown.orientation_xyzw[max(frame - 1, 0), drone][None], orientation]))
    return orientation


def _put(
    new: Mapping[str, Array],
    base: Trajectories,
    drone: int,
    rest: slice,
    velocity: Array,
    acceleration: Array,
    orientation: Array,
) -> None:
    """Write a drone's motion down; what it believes of its heading keeps its error."""
    yaw = yaw_rad(orientation)
    believed = yaw + base.est_yaw_rad[rest, drone] - base.yaw_rad[rest, drone]
    new["velocity_mps"][rest, drone], new["acceleration_mps2"][rest, drone] = velocity, acceleration
    new["orientation_xyzw"][rest, drone], new["yaw_rad"][rest, drone] = orientation, yaw
    new["est_yaw_rad"][rest, drone] = np.mod(believed + np.pi, 2 * np.pi) - np.pi
    step_s = float(base.time_s[1] - base.time_s[0]) if len(base.time_s) > 1 else 1.0
    new["body_rates_radps"][rest, drone] = body_rates(orientation[:, None], step_s)[:, 0]


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
