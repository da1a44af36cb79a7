"""A drone that goes home: it follows the formation's way and descends to the ground."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from sortie.fleet.flight.motion import Trajectories


def descending(flown: Trajectories, drone: int, frame: int, descent_mps: float) -> Trajectories:
    """The flight in which a drone descends from a frame on; what was flown before stays bit for bit.

    Args:
        flown: the flight so far.
        descent_mps: rate of descent, down to the ground at height 0.
    """
    time_s, rest = flown.time_s, slice(frame, None)
    lower_m = descent_mps * (time_s[rest] - time_s[frame])
    position, believed, velocity = (
        getattr(flown, name).copy() for name in ("position_m", "est_position_m", "velocity_mps")
    )
    for place in (position, believed):
        place[rest, drone, 2] = np.maximum(0.0, place[rest, drone, 2] - lower_m)
    velocity[rest, drone, 2] = np.where(position[rest, drone, 2] > 0.0, velocity[rest, drone, 2] - descent_mps, 0.0)
    after = replace(flown, position_m=position, est_position_m=believed, velocity_mps=velocity)
    for each in fields(after):
        getattr(after, each.name).setflags(write=False)
    return after
