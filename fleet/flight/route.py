"""The formation's reference point: a smooth flight along a polyline of waypoints.

At constant speed a polyline's velocity is a staircase in time. Each of its jumps (a corner, the stop at the
end) is spread over a time with a quadratic B-spline as the weight, which makes the path a smoothing of the
polyline: position is C³, exact on straight legs, and inside every corner. All of it is in closed form.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

MAX_YAW_RATE_RADPS = 0.5
"""The formation never turns faster than this in one corner; about 30° a second."""
MAX_RING_SPEED_MPS = 5.0
"""Nor so fast that a drone one spacing away from the centre sweeps round faster than this."""
PEAK = 2.25
"""Peak of the quadratic B-spline of unit width and unit area: of the slope of a unit step spread over a unit of time."""


@dataclass(frozen=True, slots=True)
class FramePath:
    """The formation's frame over time: T instants, ENU ground plane, metres, radians."""

    position_m: Array  # [T, 2]
    velocity_mps: Array  # [T, 2]
    acceleration_mps2: Array  # [T, 2]
    yaw_rad: Array  # [T], unwrapped
    yaw_rate_radps: Array  # [T]
    yaw_acceleration_radps2: Array  # [T]


def spread(since_s: Array, width_s: Array | float) -> tuple[Array, Array, Array]:
    """A unit step at 0, spread over `width_s`: its integral (s), itself (0 … 1), its derivative (1/s).

    Args:
        since_s: times relative to the middle of the step, any shape.
        width_s: > 0, broadcastable.
    """
    knot_s = np.asarray(width_s) / 3
    r = np.clip(since_s / knot_s + 1.5, 0.0, 3.0)
    r1, r2 = np.maximum(r - 1, 0.0), np.maximum(r - 2, 0.0)
    ramp = knot_s * (r**4 - 3 * r1**4 + 3 * r2**4) / 24 + np.maximum(since_s - 1.5 * knot_s, 0.0)
    step = (r**3 - 3 * r1**3 + 3 * r2**3) / 6
    slope = (r**2 - 3 * r1**2 + 3 * r2**2) / (2 * knot_s)
    return ramp, step, slope


def frame_path(
    waypoints_m: Sequence[tuple[float, float]], speed_mps: float, turn_time_s: float, spacing_m: float, time_s: Array
) -> FramePath:
    """Fly the route.

    The flight begins at the first waypoint, already at speed, and comes to rest at the last one. Position rounds
    a corner over `turn_time_s`. Heading turns from leg to leg about the corner's time, the short way (a reversal
    turns left), over `turn_time_s` or as much longer as MAX_YAW_RATE_RADPS and MAX_RING_SPEED_MPS ask; it does
    not follow from the velocity, which has no direction in a reversal or a hover. The bounds depend on the
    spacing and not on the number of drones, so that adding a drone changes nobody's path; they hold for one
    corner, and turns that overlap in time add up.

    Args:
        waypoints_m: ENU (x, y); equal neighbours are merged, one point hovers facing east.
        speed_mps: > 0.
        turn_time_s: > 0.
        spacing_m: of the formation, > 0.
        time_s: [T], s since the begin.
    """
    points = np.asarray(waypoints_m, dtype=float)
    legs = np.diff(points, axis=0)
    length_m = np.hypot(legs[:, 0], legs[:, 1])
    legs, length_m = legs[length_m > 0], length_m[length_m > 0]
    if len(legs) == 0:
        still, zero = np.zeros((len(time_s), 2)), np.zeros(len(time_s))
        return FramePath(still + points[0], still, still, zero, zero, zero)

    velocity = legs / length_m[:, None] * speed_mps
    jumps = np.diff(velocity, axis=0, append=np.zeros((1, 2)))
    jump_s = np.cumsum(length_m) / speed_mps
    ramp, step, slope = spread(time_s[:, None] - jump_s, turn_time_s)

    course = np.arctan2(legs[:, 1], legs[:, 0])
    turn, width_s = turns(course, turn_time_s, spacing_m)
    since_s = time_s[:, None] - jump_s[:-1]
    _, turned, turning = spread(since_s, width_s)
    return FramePath(
        position_m=points[0] + time_s[:, None] * velocity[0] + _sums(ramp, jumps),
        velocity_mps=velocity[0] + _sums(step, jumps),
        acceleration_mps2=_sums(slope, jumps),
        yaw_rad=course[0] + _sums(turned, turn),
        yaw_rate_radps=_sums(turning, turn),
        yaw_acceleration_radps2=_sums(bend(since_s, width_s), turn),
    )


def turns(course_rad: Array, turn_time_s: float, spacing_m: float) -> tuple[Array, Array]:
    """Between headings flown in turn: by how much the formation turns, within (−π, π], and over what time (s)."""
    turn = np.diff(course_rad)
    turn = turn - 2 * np.pi * np.ceil((turn - np.pi) / (2 * np.pi))
    yaw_rate = min(MAX_YAW_RATE_RADPS, MAX_RING_SPEED_MPS / spacing_m)
    return turn, np.maximum(turn_time_s, PEAK * np.abs(turn) / yaw_rate)


def turned(vectors: Array, yaw_rad: Array) -> Array:
    """Vectors [..., 2] on the ground that are given in frames with these yaws [...], in ENU."""
    cos, sin, x, y = np.cos(yaw_rad), np.sin(yaw_rad), vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def across(vectors: Array) -> Array:
    """Vectors [..., 2] turned left by a right angle."""
    return np.stack([-vectors[..., 1], vectors[..., 0]], axis=-1)


def bend(since_s: Array, width_s: Array | float) -> Array:
    """Second derivative of the spread step, 1/s²; arguments as for `spread`."""
    knot_s = np.asarray(width_s) / 3
    r = np.clip(since_s / knot_s + 1.5, 0.0, 3.0)
    bent: Array = (r - 3 * np.maximum(r - 1, 0.0) + 3 * np.maximum(r - 2, 0.0)) / knot_s**2
    return bent


def _sums(parts: Array, of: Array) -> Array:
    """`parts` @ `of`, added up in the same order on every machine; a matrix library's order is its own."""
    return np.asarray(np.einsum("tw,w...->t...", parts, of))
