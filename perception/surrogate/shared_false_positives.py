"""False positives that several drones share, because they are of things that stand in the world. Free of torch.

Such things are spread evenly over the town. Each drone that has one in its square takes it for a car with the same chance,
drawn anew at every look. Their number follows from the number of false positives of a drone.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sortie.perception.geometry import FULL, in_square
from sortie.perception.scene.town import Floats
from sortie.perception.surrogate.features import CaptureColumns
from sortie.perception.surrogate.hashing import GAMMA, Hashes, keyed, uniform
from sortie.scenarios.streams import stream

TILE_M = 25.6
THINGS = 6
"""The most in a tile."""
_AROUND = range(-6, 7)
"""Tiles about a drone's own that its square, however turned, can reach."""
_A_TILE = (TILE_M / (2 * FULL.half_extent_m)) ** 2
"""A tile's part of a square."""


@dataclass(frozen=True, slots=True)
class Things:
    """The things near a fleet.

    `xy_m` [n, 2] and `yaw_rad` [n], ENU. `key` [n]: a number that its draws follow from. `rarity` [n]: it exists where more
    than so many are expected in a square. `there` [c, n]: whether it lies in the capture's square.
    """

    xy_m: Floats
    yaw_rad: Floats
    key: Hashes
    rarity: Floats
    there: NDArray[np.bool_]


class SharedFalsePositives:
    """The things of one town that drones may take for cars."""

    def __init__(self, town: int) -> None:
        self._key = stream(town, 0, (), "surrogate.mirage").integers(2**64, dtype=np.uint64)

    def about(self, fleet: CaptureColumns, most: float) -> Things:
        """The things in any capture's square, where at most `most` are expected in one."""
        own = np.unique(np.floor(fleet.position_m[:, :2] / TILE_M).astype(np.int64), axis=0)
        around = np.array(list(itertools.product(_AROUND, _AROUND)))
        tiles = np.unique((own[:, None] + around).reshape(-1, 2), axis=0)
        key = keyed(self._key, tiles)[:, None] + np.arange(1, THINGS + 1, dtype=np.uint64) * np.uint64(GAMMA)
        rarity = np.cumsum(-np.log(uniform(key, 0)), axis=1) / _A_TILE
        tile, thing = np.nonzero(rarity < most)
        key, rarity = key[tile, thing], rarity[tile, thing]
        xy = (tiles[tile] + np.stack([uniform(key, 1), uniform(key, 2)], axis=1)) * TILE_M
        poses = np.column_stack([fleet.position_m[:, :2], fleet.yaw_rad])
        return Things(xy, 2 * np.pi * uniform(key, 3), key, rarity, in_square(xy, poses).T)
