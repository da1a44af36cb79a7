"""What each drone senses of itself in each frame, computed from a flown `Trajectories`.

It follows from the motion alone, so it is computed for many frames and all drones in one pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from sortie.fleet.coverage import Poses, View, footprint_radius_m, views
from sortie.fleet.flight.motion import Trajectories
from sortie.perception.geometry import Cameras
from sortie.perception.scene.height_field import HeightField
from sortie.perception.types import Capture

_BLOCK = 32
"""Frames worked out at once: a long flight need not be held as Python objects, and a new way loses few of them."""

Vector = tuple[float, float, float]


class Sensed(NamedTuple):
    """One drone in one frame, as it knows itself."""

    capture: Capture
    velocity_mps: Vector
    footprint_radius_m: float
    view: View
    """What its cameras see, if it looks."""


class FlightSenses:
    """What all drones sense; `at(frame)[drone]`. Sensors trigger with the frame."""

    def __init__(self, motion: Trajectories, frame_s: float, field: HeightField, cameras: Sequence[Cameras]) -> None:
        """Args: `field`: what hides the ground from the drones' cameras; `cameras`: each drone's."""
        self._motion, self._frame_s, self._field, self._cameras = motion, frame_s, field, cameras
        self._first = -_BLOCK
        self._block: list[tuple[Sensed, ...]] = []

    def at(self, frame: int) -> tuple[Sensed, ...]:
        """Every drone in this frame."""
        if not 0 <= frame - self._first < _BLOCK:
            self._fill(frame)
        return self._block[frame - self._first]

    def _fill(self, frame: int) -> None:
        self._first = frame // _BLOCK * _BLOCK
        frames = slice(self._first, self._first + _BLOCK)
        m = self._motion
        states = m.position_m, m.orientation_xyzw, m.yaw_rad, m.est_position_m, m.est_yaw_rad
        seen = zip(*views(Poses(*(v[frames] for v in states)), self._field, self._cameras), strict=True)
        self._block = list(zip(*(self._of(drone, frames, view) for drone, view in enumerate(seen)), strict=True))

    def _of(self, drone: int, frames: slice, views: Sequence[View]) -> list[Sensed]:
        """One drone in some frames."""
        m, cameras = self._motion, self._cameras[drone]
        position, orientation, velocity, believed = (
            map(tuple, states[frames, drone].tolist())
            for states in (m.position_m, m.orientation_xyzw, m.velocity_mps, m.est_position_m)
        )
        yaw = m.est_yaw_rad[frames, drone].tolist()
        radius = footprint_radius_m(m.est_position_m[frames, drone, 2], cameras).tolist()
        return [
            Sensed(Capture(drone, frame * self._frame_s, at, turn, est, heading, cameras=cameras), v, r, view)
            for frame, v, r, view, at, turn, est, heading in zip(
                range(frames.start, frames.start + len(yaw)), velocity, radius, views, position, orientation, believed,
                yaw, strict=True,
            )
        ]  # fmt: skip
