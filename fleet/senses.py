"""What each drone senses of itself in each frame, computed from a flown `Trajectories`.

It follows from the motion alone, so it is computed for many frames and all drones in one pass.
"""

from __future__ import annotations

from typing import NamedTuple

from sortie.fleet.coverage import footprint_radius_m, survey
from sortie.fleet.flight.motion import Trajectories
from sortie.perception.types import Capture

COVERAGE_PERIOD_S = 1.0
"""The coverage grid is renewed this often: at 5 m/s a drone crosses a 12.8 m cell in 2.6 s."""
_BLOCK = 256
"""Frames worked out at once: a long flight of a large fleet need not be held as Python objects."""

Vector = tuple[float, float, float]


class Sensed(NamedTuple):
    """One drone in one frame, as it knows itself."""

    capture: Capture
    velocity_mps: Vector
    footprint_radius_m: float
    coverage_grid: bytes
    novel: bool
    """Whether the grid shows a cell well for the first time."""


class FlightSenses:
    """What all drones sense; `at(frame)[drone]`. Sensors trigger with the frame."""

    def __init__(self, motion: Trajectories, frame_s: float) -> None:
        self._motion, self._frame_s = motion, frame_s
        self._first = -_BLOCK
        self._block: list[tuple[Sensed, ...]] = []
        self._frames_a_look = max(1, round(COVERAGE_PERIOD_S / frame_s))
        x_m, y_m, z_m = motion.est_position_m[:: self._frames_a_look].transpose(2, 1, 0)  # [N, looks]
        self._looks = [survey(*track) for track in zip(x_m, y_m, footprint_radius_m(z_m), strict=True)]

    def at(self, frame: int) -> tuple[Sensed, ...]:
        """Every drone in this frame."""
        if not 0 <= frame - self._first < _BLOCK:
            self._fill(frame)
        return self._block[frame - self._first]

    def _fill(self, frame: int) -> None:
        self._first = frame // _BLOCK * _BLOCK
        frames = slice(self._first, self._first + _BLOCK)
        m = self._motion
        self._block = list(zip(*(self._of(drone, frames) for drone in range(m.position_m.shape[1])), strict=True))

    def _of(self, drone: int, frames: slice) -> list[Sensed]:
        """One drone in some frames."""
        m, looks, each = self._motion, self._looks[drone], self._frames_a_look
        position, orientation, velocity, believed = (
            map(tuple, states[frames, drone].tolist())
            for states in (m.position_m, m.orientation_xyzw, m.velocity_mps, m.est_position_m)
        )
        yaw = m.est_yaw_rad[frames, drone].tolist()
        radius = footprint_radius_m(m.est_position_m[frames, drone, 2]).tolist()
        return [
            Sensed(Capture(drone, frame * self._frame_s, *pose), v, r, *looks[frame // each])
            for frame, v, r, *pose in zip(
                range(frames.start, frames.start + len(yaw)), velocity, radius, position, orientation, believed, yaw,
                strict=True,
            )
        ]  # fmt: skip
