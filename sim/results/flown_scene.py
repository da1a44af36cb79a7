"""The scene that a recorded sortie flew over, and what of it the playback and bags draw."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.scene.traffic import Cars
from sortie.scenarios.schema import Fleet, Jammer
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.spool import batches

CARS_WITHIN_M = 160.0
"""Moving cars are drawn up to this far from the middle of the drones."""
BOX_HEIGHT_M = 1.8
"""Detections have no height of their own."""
CIRCLE = np.array([(np.cos(a), np.sin(a)) for a in np.linspace(0, 2 * np.pi, 49)])
"""Of radius 1, closed, [49, 2]."""


def scene_of(record: SortieRecord) -> SceneModel:
    """The scene that the sortie flew over, made anew from its scenario and where it flew."""
    scenario = record.scenario
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for batch in batches(record.tables, "states", ["x_m", "y_m"]):
        xy = np.column_stack([column.to_numpy() for column in batch.columns])
        low, high = np.minimum(low, xy.min(axis=0)), np.maximum(high, xy.max(axis=0))
    bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    return SceneModel(
        scenario.perception.scene,
        scenario.mission.target,
        bounds,
        scenario.mission.more_targets,
        scenario.perception.people,
    )


def vehicles(fleet: Fleet) -> list[int]:
    """The drones that are no ground stations; drone 0 where all are."""
    return [i for i in range(fleet.drones) if fleet.station(i) is None] or [0]


def houses(scene: SceneModel) -> NDArray[np.float64]:
    """The buildings that lie wholly within the scene, [K, 6]: x and y of the low and of the high corner, top, tone."""
    every = np.concatenate([block.buildings for block in scene.town.blocks(*scene.rect)])
    return every[inside(every[:, :2], scene.rect) & inside(every[:, 2:4], scene.rect)]


def inside(xy_m: NDArray[np.float64], rect: tuple[float, float, float, float]) -> NDArray[np.bool_]:
    """Which points [K, 2] lie within a rectangle of x and y low, x and y high."""
    x0, y0, x1, y1 = rect
    return np.asarray((xy_m[:, 0] >= x0) & (xy_m[:, 0] <= x1) & (xy_m[:, 1] >= y0) & (xy_m[:, 1] <= y1))


def cars_near(scene: SceneModel, t_s: float, x_m: float, y_m: float) -> Cars:
    """The moving cars within `CARS_WITHIN_M` of a place."""
    cars = scene.moving_cars(t_s)
    return cars.where((cars.x_m - x_m) ** 2 + (cars.y_m - y_m) ** 2 <= CARS_WITHIN_M**2)


def jamming(jams: Iterable[Jammer], t_s: float) -> list[Jammer]:
    """The jammers that are on."""
    return [jam for jam in jams if jam.at_s <= t_s < (np.inf if jam.until_s is None else jam.until_s)]
