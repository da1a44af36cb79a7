"""What each drone senses of itself in each frame, computed from the motion.

It follows from the motion alone, so it is computed for many frames and all drones in one pass.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sortie.fleet.coverage import Poses, View, footprint_radius_m, views
from sortie.fleet.flight.frames import wrapped
from sortie.fleet.flight.manoeuvres import Motion
from sortie.fleet.flight.motion import Trajectories
from sortie.fleet.sensor_faults import Array, turned
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
    orientation_xyzw: tuple[float, float, float, float]
    """Its orientation as it publishes it: the true one, turned by what a fault of its heading adds."""


def believed(motion: Trajectories | Motion, errors: Mapping[int, Array], frames: slice) -> tuple[Array, Array]:
    """Where drones believe they are, [T, N, 3] ENU, and their heading, [T, N] rad: the motion's, and what faults add."""
    flown = motion[frames]
    position_m, yaw_rad = flown.est_position_m, flown.est_yaw_rad
    if errors:
        position_m, yaw_rad = np.array(position_m), np.array(yaw_rad)
        for drone, error in errors.items():
            position_m[:, drone] += error[frames, :3]
            yaw_rad[:, drone] = wrapped(yaw_rad[:, drone] + error[frames, 3])
    return position_m, yaw_rad


class FlightSenses:
    """What all drones sense; `at(frame)[drone]`. Sensors trigger with the frame."""

    def __init__(
        self,
        motion: Trajectories | Motion,
        frame_s: float,
        field: HeightField,
        cameras: Sequence[Cameras],
        errors: Mapping[int, Array] | None = None,
        blind: Container[int] = (),
    ) -> None:
        """Args:
        field: what hides the ground from the drones' cameras.
        cameras: each drone's.
        errors: by drone, what faults add to its believed pose (`sortie.fleet.sensor_faults`).
        blind: members of the fleet without cameras; their footprints have no radius.
        """
        self._errors, self._blind = errors or {}, blind
        self._motion, self._frame_s, self._field, self._cameras = motion, frame_s, field, cameras
        self._first = -_BLOCK
        self._block: list[tuple[Sensed, ...]] = []

    def at(self, frame: int) -> tuple[Sensed, ...]:
        """Every drone in this frame."""
        if not 0 <= frame - self._first < _BLOCK:
            self._fill(frame)
        return self._block[frame - self._first]

    def forget(self) -> None:
        """The motion has changed: work out the next frame that is read anew."""
        self._first = -_BLOCK

    def _fill(self, frame: int) -> None:
        self._first = frame // _BLOCK * _BLOCK
        frames = slice(self._first, self._first + _BLOCK)
        flown, (believed_m, believed_yaw) = self._motion[frames], believed(self._motion, self._errors, frames)
        poses = Poses(flown.position_m, flown.orientation_xyzw, flown.yaw_rad, believed_m, believed_yaw)
        seen = zip(*views(poses, self._field, self._cameras), strict=True)
        of_each = (self._of(i, frames, poses, flown.velocity_mps, view) for i, view in enumerate(seen))
        self._block = list(zip(*of_each, strict=True))

    def _of(self, drone: int, frames: slice, poses: Poses, velocity_mps: Array, views: Sequence[View]) -> list[Sensed]:
        """One drone in some frames."""
        cameras = self._cameras[drone]
        position, orientation, velocity, believed = (
            map(tuple, states[:, drone].tolist())
            for states in (poses.position_m, poses.orientation_xyzw, velocity_mps, poses.est_position_m)
        )
        yaw = poses.est_yaw_rad[:, drone].tolist()
        radius = footprint_radius_m(poses.est_position_m[:, drone, 2], cameras).tolist()
        if drone in self._blind:
            radius = [0.0] * len(radius)
        error = self._errors.get(drone)
        wrong_rad = [0.0] * len(yaw) if error is None else error[frames, 3].tolist()
        return [
            Sensed(
                Capture(drone, frame * self._frame_s, at, turn, est, heading, cameras=cameras),
                v,
                r,
                view,
                turned(turn, wrong) if wrong else turn,
            )
            for frame, (v, r, view, at, turn, est, heading, wrong) in enumerate(
                zip(velocity, radius, views, position, orientation, believed, yaw, wrong_rad, strict=True),
                start=frames.start,
            )
        ]
