"""A thermal camera that finds people: a declared sensor model, not a measured one.

The camera looks straight down, on a gimbal. It can find a person within its cone whom no roof and no crown hides. It then
finds the person with the probability

    p(d) = near_probability / (1 + exp((d − half_range_m) / range_width_m)),    d: distance from the camera, m.

Each frame may also have a false alarm at a random place in the cone. Draws are keyed by seed, replication, drone, frame and
person, so nothing that drones send changes them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sortie.perception.scene.height_field import HeightField
from sortie.perception.scene.traffic import TargetPath
from sortie.perception.types import Capture
from sortie.scenarios.schema import Person, Thermal
from sortie.scenarios.streams import stream

Floats = NDArray[np.float64]

NOBODY = -1
"""The person of a false alarm."""


class Sighting(NamedTuple):
    """A warm spot that the camera takes for a person."""

    t_s: float
    x_m: float
    """Where the drone places it, ENU: with the camera's error and that of the drone's own position."""
    y_m: float
    score: float
    """The probability at which a person at that distance is found."""
    person: int
    """Which person it is, for the record; the drone does not know. NOBODY for a false alarm."""


class Walkers:
    """The people of a scene as a function of time."""

    def __init__(self, people: Sequence[Person]) -> None:
        self._paths = [(TargetPath.of(person), person.begin_s) for person in people]

    def __len__(self) -> int:
        return len(self._paths)

    def at(self, t_s: float) -> Floats:
        """[n, 2] where each of them is at `t_s`, ENU."""
        return np.array([path.pose(t_s - begin_s)[:2] for path, begin_s in self._paths]).reshape(-1, 2)


def found_probability(distance_m: Floats | float, camera: Thermal) -> Floats:
    """The probability of finding an unhidden person at a distance from the camera, any shape."""
    return np.asarray(
        camera.near_probability / (1.0 + np.exp((np.asarray(distance_m) - camera.half_range_m) / camera.range_width_m))
    )


def in_cone(xy_m: Floats, position_m: Sequence[float] | Floats, camera: Thermal) -> NDArray[np.bool_]:
    """Whether places [n, 2] on the ground lie in the camera's cone; `position_m` is the drone's, [3] or [n, 3]."""
    at = np.asarray(position_m, float)
    away_m = np.hypot(xy_m[:, 0] - at[..., 0], xy_m[:, 1] - at[..., 1])
    return np.asarray(away_m <= at[..., 2] * math.tan(math.radians(camera.field_of_view_deg / 2)))


def look(
    camera: Thermal,
    people_m: Floats,
    field: HeightField,
    capture: Capture,
    frame: int,
    frame_s: float,
    key: tuple[int, int],
) -> list[Sighting]:
    """What a drone's thermal camera reports in a frame.

    Args:
        camera: its parameters.
        people_m: [n, 2] where people are, ENU.
        field: what hides them.
        capture: the drone's true and estimated pose.
        frame: the number of the frame, for the draws.
        frame_s: how long a frame lasts.
        key: seed and replication.
    """
    position, drone = np.array(capture.position_m), capture.drone
    off = np.subtract(capture.est_position_m[:2], position[:2])  # the drone places spots relative to itself
    seen = in_cone(people_m, position, camera)
    if seen.any():
        at = np.flatnonzero(seen)
        eye = np.broadcast_to(position, (len(at), 3))
        seen[at] = field.seen(people_m[at, 0], people_m[at, 1], eye) & field.open(people_m[at, 0], people_m[at, 1])
    out = []
    for person in np.flatnonzero(seen).tolist():
        draws = stream(*key, (drone, frame, person), "thermal")
        p = float(found_probability(math.dist((*people_m[person], 0.0), position), camera))
        if draws.random() < p:
            x_m, y_m = people_m[person] + off + camera.position_error_m * draws.standard_normal(2)
            out.append(Sighting(capture.t_s, float(x_m), float(y_m), p, person))
    draws = stream(*key, (drone, frame), "thermal.false_alarm")
    if draws.random() < 1.0 - math.exp(-camera.false_alarms_per_min * frame_s / 60.0):
        reach_m = position[2] * math.tan(math.radians(camera.field_of_view_deg / 2)) * math.sqrt(draws.random())
        turn = 2 * math.pi * draws.random()
        away = reach_m * np.array([math.cos(turn), math.sin(turn)])
        p = float(found_probability(math.hypot(reach_m, position[2]), camera))
        x_m, y_m = position[:2] + away + off
        out.append(Sighting(capture.t_s, float(x_m), float(y_m), p, NOBODY))
    return out
