"""The mission discs of a record: which disc a drone had at a time."""

from __future__ import annotations

from functools import cache

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import ArrayLike, NDArray

from sortie.scenarios.schema import Mission

_COLUMNS = ("region_x_m", "region_y_m", "region_radius_m")


class Regions:
    """Looks discs up by time and drone.

    Args:
        missions: the record's table `mission`, or a part of it.
        mission: the scenario's section; it says which group a drone belongs to.
    """

    def __init__(self, missions: pa.Table, mission: Mission) -> None:
        self._group_of = cache(mission.group_of)
        self._of = {}
        for group in pc.unique(missions["group"]).to_pylist():
            rows = missions.filter(pc.equal(missions["group"], group))
            discs = np.column_stack([rows[c].to_numpy() for c in _COLUMNS])
            self._of[group] = rows["t_s"].to_numpy(), discs

    def at(self, t_s: ArrayLike, drones: ArrayLike) -> NDArray[np.float64]:
        """The discs of drones [n] at times [n]: x, y, radius [n, 3], NaN where there is none."""
        t_s, drones = np.atleast_1d(np.asarray(t_s, float)), np.atleast_1d(np.asarray(drones, np.int64))
        group = np.array([self._group_of(drone) for drone in drones.tolist()], np.int64)
        out = np.full((len(t_s), 3), np.nan)
        for number, (begins_s, discs) in self._of.items():
            here = group == number
            out[here] = discs[np.searchsorted(begins_s, t_s[here], side="right") - 1]
        return out
