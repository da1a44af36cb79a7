"""What a drone's sensors get wrong beyond their usual errors: faults that scenario events name, and sensors of one's own.

They change what a drone believes of its pose. That enters its descriptors and places its features and boxes in the world.
Scoring goes by what is true.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sortie.scenarios import scratch
from sortie.scenarios.frames import frame_from
from sortie.scenarios.plugins.reference import checked_array, resolve
from sortie.scenarios.schema import PoseFault, Scenario
from sortie.scenarios.streams import stream

Array = NDArray[np.float64]
COLUMNS = 4
"""x, y, z in metres (ENU), and heading in radians, counter-clockwise."""


class OwnSensor(Protocol):
    """A sensor of one's own, `fleet.sensor`. Keyword-only arguments are its parameters."""

    def __call__(self, times_s: Array, positions_m: Array, rng: np.random.Generator) -> Any:
        """The error of one drone's believed pose, added to the usual errors.

        Args:
            times_s: [T], the begin of each frame of the flight.
            positions_m: [T, 3], ENU, the drone's true positions as planned.
            rng: for all its random numbers; each drone has its own.

        Returns:
            [T, 4]: x, y, z in metres and heading in radians, counter-clockwise.
        """


def sensor_errors(scenario: Scenario, positions_m: Array, seed: int, replication: int) -> Mapping[int, Array]:
    """By drone: the error of its believed pose in each frame, [T, 4]; drones without one are left out.

    Args:
        scenario: its events and its `fleet.sensor`.
        positions_m: [T, N, 3], ENU, true.
        seed, replication: as in `sortie.scenarios.streams.stream`.

    Raises:
        PluginError: a sensor of one's own that is not there, fails, or returns something else.
    """
    frames, drones = positions_m.shape[:2]
    times_s = np.arange(frames, dtype=np.float64) * np.float64(scenario.frame_s)
    flying = [drone for drone in range(drones) if scenario.fleet.station(drone) is None]  # a station knows its place
    errors: dict[int, Array] = {}
    if scenario.fleet.sensor is not None:
        model = resolve("sensor", scenario.fleet.sensor, scenario.fleet.sensor_params)
        for drone in flying:
            rng = stream(seed, replication, drone, "own sensor")
            errors[drone] = own_errors(model, times_s, positions_m[:, drone], rng)
    for index, event in enumerate(scenario.events):
        if isinstance(event, PoseFault):
            begin = frame_from(event.at_s, scenario.frame_s)
            end = frames if event.until_s is None else min(frames, frame_from(event.until_s, scenario.frame_s))
            since_s = times_s[begin:end] - event.at_s
            for drone in flying if event.who is None else [event.who]:
                found = event.pose_error(
                    since_s, scenario.frame_s, stream(seed, replication, (drone, index), "sensor fault")
                )
                if found is not None:
                    error = errors.setdefault(drone, np.zeros((frames, COLUMNS)))
                    error[begin:end] += found
    return errors


def own_errors(model: OwnSensor, times_s: Array, positions_m: Array, rng: np.random.Generator) -> Array:
    """What a sensor of one's own returns for one drone, checked."""
    given = checked_array("sensor", model, (len(times_s), COLUMNS), times_s, positions_m, rng)
    return scratch.copied(given)


def turned(orientation_xyzw: Sequence[float], heading_rad: float) -> tuple[float, float, float, float]:
    """An orientation, turned by so much about the vertical.

    Example:
        >>> [round(v, 3) for v in turned((0.0, 0.0, 0.0, 1.0), np.pi / 2)]
        [0.0, 0.0, 0.707, 0.707]
    """
    x, y, z, w = orientation_xyzw
    s, c = float(np.sin(heading_rad / 2)), float(np.cos(heading_rad / 2))
    return c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z
