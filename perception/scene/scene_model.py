"""The scene of a sortie: the town around the route and every car in it, at any moment."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from sortie.perception.classes import TRUCK, vehicle_classes
from sortie.perception.scene.height_field import HeightField
from sortie.perception.scene.town import Town
from sortie.perception.scene.traffic import (
    TARGET_COLOUR,
    TARGET_SIZE_M,
    Cars,
    TargetPath,
    join,
    lanes,
    parked,
)
from sortie.perception.scene.walkers import Walkers
from sortie.scenarios.schema import Person, Scene, Target

MARGIN_M = 200.0
"""Cars exist this far around the bounds: the ±102.4 m grid's corner and a drone's drift fit inside."""


class SceneModel:
    """What there is to see.

    Args:
        config: the scenario's `perception.scene`.
        target: the mission's target car, or None.
        more_targets: further ones. Ids of targets are 0, 1 …; parked cars follow, from 1 at least, then moving ones.
        bounds: (x_min, y_min, x_max, y_max) of the route, ENU metres; drones outside it by more than
            about 50 m begin to miss cars. The town itself has no bounds.
        people: who walks about; cameras see them, and they are no cars.

    Making one costs tens of milliseconds: blocks are drawn, nothing is rasterised (`town.tile` does that on demand).
    """

    def __init__(
        self,
        config: Scene,
        target: Target | None,
        bounds: tuple[float, float, float, float],
        more_targets: Sequence[Target] = (),
        people: Sequence[Person] = (),
    ) -> None:
        if not (bounds[0] <= bounds[2] and bounds[1] <= bounds[3]):
            raise ValueError(f"bounds are {bounds}, must be (x_min, y_min, x_max, y_max)")
        self.config = config
        self.made_of = config, target, bounds, tuple(more_targets), tuple(people)
        """Scenes that are made of the same are the same."""
        self.town = Town(config)
        self.rect = (bounds[0] - MARGIN_M, bounds[1] - MARGIN_M, bounds[2] + MARGIN_M, bounds[3] + MARGIN_M)
        self._parked_pose, self._parked_size, self._parked_colour, self._parked_spots = parked(self.town, self.rect)
        self._lanes = lanes(config, self.rect)
        self.targets = [TargetPath.of(t) for t in (target, *more_targets) if t is not None]
        n, m, first = len(self._parked_pose), len(self._lanes.s0_m), max(1, len(self.targets))
        self._parked_ids = np.arange(first, n + first)
        self._moving_ids = np.arange(n + first, n + m + first)
        self.walkers = Walkers(people)
        self._xy_at: tuple[float, np.ndarray] | None = None

    @cached_property
    def height_field(self) -> HeightField:
        """Roofs and crowns inside `rect`: what stands between a drone and the ground."""
        return HeightField(self.town, self.rect)

    @property
    def parked_cars(self) -> Cars:
        """The parked cars inside `rect`, in arrays that may be changed."""
        (x, y, yaw), size = self._parked_pose.T.copy(), self._parked_size.copy()
        ids, colour = self._parked_ids.copy(), self._parked_colour.copy()
        return Cars(ids, x, y, yaw, size[:, 0], size[:, 1], size[:, 2], colour)

    def moving_cars(self, t_s: float) -> Cars:
        """The targets and the moving cars inside `rect` at `t_s`."""
        x, y, inside = self._lanes.position_m(t_s)
        size, lane = self._lanes.size_m[inside], self._lanes
        yaw, colour = lane.yaw_rad[inside], lane.colour[inside]
        ids = self._moving_ids[inside]
        cars = Cars(ids, x[inside], y[inside], yaw, size[:, 0], size[:, 1], size[:, 2], colour)
        k = len(self.targets)
        if not k:
            return cars
        tx, ty, heading = np.array([path.pose(t_s) for path in self.targets]).T
        length, width, height = np.tile(TARGET_SIZE_M, (k, 1)).T
        colour = np.tile(np.array(TARGET_COLOUR, np.uint8), (k, 1))
        return join(Cars(np.arange(k), tx, ty, heading, length, width, height, colour), cars)

    def trucks(self, t_s: float) -> Cars:
        """The trucks among the moving cars."""
        cars = self.moving_cars(t_s)
        return cars.where(vehicle_classes(cars.length_m) == TRUCK)

    def moving_bodies(self, t_s: float) -> Cars:
        """All that moves in a camera's picture: cars, and people with ids of −1."""
        cars = self.moving_cars(t_s)
        return join(cars, self.walkers.bodies(t_s)) if self.walkers else cars

    def cars_at(self, t_s: float) -> Cars:
        """Every car inside `rect` at `t_s`, by id: the targets, the parked ones, the moving ones.

        A moving car keeps its id while it is inside; one that leaves may come back in elsewhere.
        """
        cars = join(self.parked_cars, self.moving_cars(t_s))
        return cars.where(np.argsort(cars.ids, kind="stable"))

    def cars_near(self, t_s: float, x_m: float, y_m: float, radius_m: float) -> int:
        """How many cars have their centre within `radius_m` of (x, y) at `t_s`; tens of µs, for the traffic path."""
        if self._xy_at is None or self._xy_at[0] != t_s:
            x, y, inside = self._lanes.position_m(t_s)
            parts = [self._parked_pose[:, :2], np.stack([x, y], axis=1)[inside]]
            parts += [np.array([path.pose(t_s)[:2]]) for path in self.targets]
            self._xy_at = (t_s, np.ascontiguousarray(np.concatenate(parts).T))
        xs, ys = self._xy_at[1]
        return int(np.count_nonzero((xs - x_m) ** 2 + (ys - y_m) ** 2 <= radius_m * radius_m))
