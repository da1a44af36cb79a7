"""What looks like a car to more drones than one: false alarms that stand in the world. Free of torch.

The town has things in it, thrown evenly; each drone that has one in its square takes it for a car with the same chance,
at every look anew. How many there are follows from how many false alarms a drone has.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sortie.perception.geometry import FULL, in_square
from sortie.perception.scene.town import Floats
from sortie.perception.surrogate.features import CaptureColumns
from sortie.perception.surrogate.hashing import GAMMA, Words, mixed, uniform
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
    """What stands about a fleet: `xy_m` [n, 2] and `yaw_rad` [n], ENU; `word` [n], a number of its own; `rarity` [n]: it is
    there where more than so many are expected in a square; `there` [c, n] whether it lies in the capture's square."""

    xy_m: Floats
    yaw_rad: Floats
    word: Words
    rarity: Floats
    there: NDArray[np.bool_]


class Mirages:
    """The things of one town."""

    def __init__(self, town: int) -> None:
        self._key = stream(town, 0, (), "surrogate.mirage").integers(2**64, dtype=np.uint64)

    def about(self, fleet: CaptureColumns, most: float) -> Things:
        """Those in any capture's square, where at most so many are expected in one."""
        own = np.unique(np.floor(fleet.position_m[:, :2] / TILE_M).astype(np.int64), axis=0)
        around = np.array(list(itertools.product(_AROUND, _AROUND)))
        tiles = np.unique((own[:, None] + around).reshape(-1, 2), axis=0)
        words = mixed(mixed(tiles[:, 0].astype(np.uint64) ^ self._key) ^ tiles[:, 1].astype(np.uint64))
        word = words[:, None] + np.arange(1, THINGS + 1, dtype=np.uint64) * np.uint64(GAMMA)
        rarity = np.cumsum(-np.log(uniform(word, 0)), axis=1) / _A_TILE
        tile, thing = np.nonzero(rarity < most)
        word, rarity = word[tile, thing], rarity[tile, thing]
        xy = (tiles[tile] + np.stack([uniform(word, 1), uniform(word, 2)], axis=1)) * TILE_M
        poses = np.column_stack([fleet.position_m[:, :2], fleet.yaw_rad])
        return Things(xy, 2 * np.pi * uniform(word, 3), word, rarity, in_square(xy, poses).T)


def in_common(seen: Sequence[int], others: int) -> tuple[float, float]:
    """The part of false alarms that are of things that all can see, and the chance to see one, such that as many others see
    them as did on average, and as many pairs of others.

    Args:
        seen: of each false alarm, how many of the `others` who could have had it as well had it.
    """
    n = np.asarray(seen, dtype=np.float64)
    if not n.sum():
        return 0.0, 1.0
    pairs = float((n * (n - 1)).mean() / ((others - 1) * n.mean()))
    chance = min(1.0, max(pairs, float(n.mean()) / others))
    return float(n.mean()) / (others * chance), chance
