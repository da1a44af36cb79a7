"""The scene that a recorded sortie flew over."""

from __future__ import annotations

import numpy as np

from sortie.perception.scene.scene_model import SceneModel
from sortie.sim.results.record import SortieRecord
from sortie.sim.results.spool import batches


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
