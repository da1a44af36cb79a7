"""A drone that goes home follows the formation's way and descends to the ground; one that comes back flies level again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sortie.fleet.flight.motion import Trajectories
from sortie.scenarios import scratch


def descending(flown: Trajectories, drone: int, frame: int, descent_mps: float) -> Trajectories:
    """The flight in which a drone descends from a frame on; what was flown before stays bit for bit.

    Args:
        flown: the flight so far.
        descent_mps: rate of descent, down to the ground at height 0.
    """
    time_s, rest = flown.time_s, slice(frame, None)
    position, believed, velocity = (
        scratch.copied(getattr(flown, name)) for name in ("position_m", "est_position_m", "velocity_mps")
    )
    level_m = flown.position_m[rest, drone, 2]
    height_m = np.maximum(0.0, level_m[0] - descent_mps * (time_s[rest] - time_s[frame]))
    position[rest, drone, 2] = height_m
    believed[rest, drone, 2] += height_m - level_m  # keeps its error
    velocity[rest, drone, 2] = np.where(height_m > 0.0, -descent_mps, 0.0)
    return replace(flown, position_m=position, est_position_m=believed, velocity_mps=velocity)


def level_again(flown: Trajectories, level: Trajectories, drone: int, frame: int) -> Trajectories:
    """The flight in which a drone is at its height in the formation from a frame on; all else stays bit for bit.

    Args:
        flown: the flight so far.
        level: a flight in which nobody descends.
    """
    heights = {}
    for name in ("position_m", "est_position_m", "velocity_mps"):
        heights[name] = scratch.copied(getattr(flown, name))
        heights[name][frame:, drone, 2] = getattr(level, name)[frame:, drone, 2]
    return replace(flown, **heights)
