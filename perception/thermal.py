"""A thermal camera that finds people: a declared sensor model, not a measured one.

The camera looks straight down, on a gimbal. It can find a person within its cone whom no roof, crown or truck hides. It then
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

from sortie.perception.classes import PERSON, PERSON_SIZE_M
from sortie.perception.scene.behind_trucks import behind
from sortie.perception.scene.height_field import CAR_TOP_M, HeightField
from sortie.perception.scene.traffic import Cars
from sortie.perception.types import Boxes, Capture
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Thermal
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


def found_probability(distance_m: Floats | float, camera: Thermal) -> Floats:
    """The probability of finding an unhidden person at a distance from the camera, any shape."""
    with np.errstate(over="ignore"):  # far beyond the range of a sharp camera the probability is 0
        beyond = np.exp((np.asarray(distance_m) - camera.half_range_m) / camera.range_width_m)
    return np.asarray(camera.near_probability / (1.0 + beyond))


def in_cone(xy_m: Floats, position_m: Sequence[float] | Floats, camera: Thermal) -> NDArray[np.bool_]:
    """Whether places [n, 2] on the ground lie in the camera's cone; `position_m` is the drone's, [3] or [n, 3]."""
    at = np.asarray(position_m, float)
    away_m = np.hypot(xy_m[:, 0] - at[..., 0], xy_m[:, 1] - at[..., 1])
    return np.asarray(away_m <= at[..., 2] * math.tan(math.radians(camera.field_of_view_deg / 2)))


def looked_at(camera: Thermal, capture: Capture) -> Disc:
    """The ground in the camera's cone, where the drone believes itself to be."""
    x_m, y_m, z_m = capture.est_position_m
    return Disc(x_m, y_m, max(z_m, 0.0) * math.tan(math.radians(camera.field_of_view_deg / 2)))


def people_boxes(xy_m: Floats, score: Floats, person: NDArray[np.integer] | None = None) -> Boxes:
    """People at places [n, 2] as boxes; `person` says who they are, where that is known."""
    n = len(xy_m)
    size, which = np.tile(PERSON_SIZE_M[:2], (n, 1)), None if person is None else person.astype(np.int32)
    kind = np.full(n, PERSON, np.int8)
    return Boxes(xy_m.reshape(-1, 2), size, np.zeros(n), score, which, kind).single()  # type: ignore[arg-type]


def boxes_of(sightings: Sequence[Sighting]) -> Boxes:
    """What the camera reports as boxes, best first. They do not say who is who."""
    boxes = people_boxes(
        np.array([(s.x_m, s.y_m) for s in sightings]).reshape(-1, 2), np.array([s.score for s in sightings])
    )
    return boxes.take(np.argsort(-boxes.score, kind="stable"))


def look(
    camera: Thermal,
    people_m: Floats,
    field: HeightField,
    capture: Capture,
    frame: int,
    frame_s: float,
    key: tuple[int, int],
    trucks: Cars | None = None,
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
        trucks: what else hides them; None for nothing.
    """
    position, drone = np.array(capture.position_m), capture.drone
    off = np.subtract(capture.est_position_m[:2], position[:2])  # the drone places spots relative to itself
    seen = in_cone(people_m, position, camera)
    if seen.any():
        at = np.flatnonzero(seen)
        eye = np.broadcast_to(position, (len(at), 3))
        seen[at] = field.seen(people_m[at, 0], people_m[at, 1], eye) & field.open(people_m[at, 0], people_m[at, 1])
        if trucks is not None and len(trucks):
            seen[at] &= ~behind(trucks, people_m[at], eye, CAR_TOP_M)
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
