"""The surrogate's random draws for each drone, moment and car. They do not depend on what was sent. Free of torch.

Each drone has one number from a random stream. Each car has a number that follows from the town's seed and from which car of
the town it is. The draw for a drone, a millisecond and a car is a hash of those numbers. A stream for every look would cost
more than the rest of the surrogate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from sortie.perception.surrogate.features import Looks
from sortie.perception.surrogate.hashing import GAMMA, Hashes, keyed, mixed, uniform
from sortie.perception.types import Capture
from sortie.scenarios.streams import stream

BANDS, ALARMS = 8, 24
"""The most bands of scores, and the most false alarms of one that a moment can have."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """The draws for l looks and c captures."""

    look: NDArray[np.float32]
    """[l] uniform."""
    rank: NDArray[np.float32]
    """[l] standard normal."""
    find: NDArray[np.float32]
    """[l, 2] uniform."""
    residual: NDArray[np.float32]
    """[l] uniform."""
    alarm_at: NDArray[np.float32]
    """[c, 8, 24] arrivals of Poisson processes of rate 1."""
    alarm_which: NDArray[np.float32]
    """[c, 8, 24] uniform."""
    moment: Hashes
    """[c] numbers from which further draws are made."""
    offset_draw: NDArray[np.float32]
    """[l, 4] one for each car, the same for all drones: uniform, then the side (−1 or 1) to which its boxes lie off along it,
    across it and in heading, for cars that all drones put off to the same side."""


class DrawSource:
    """The draws of one sortie over a town.

    A share of the cars (`Parameters.alike`) has one draw for all drones and moments. It belongs to the town: another sortie
    over it finds the same cars hard, whatever area it covers. `identity` [cars, 4] is `Traffic.identity`.
    """

    def __init__(
        self, seed: int, replication: int, town: int, identity: NDArray[np.int64], alike: NDArray[np.float32]
    ) -> None:
        self._key, self._drones = (seed, replication), dict[int, int]()
        self._car = keyed(stream(town, 0, (), "surrogate.car").integers(2**64, dtype=np.uint64), identity)
        own = [uniform(self._car, k + 3) < part for k, part in enumerate(alike[:3])]
        sides = [np.where(uniform(self._car, k) < 0.5, -1.0, 1.0) for k in (7, 8, 9)]
        self._offset_draw = np.stack([uniform(self._car, 6), *sides], axis=1).astype(np.float32)
        self._car_draws = np.where(own, [uniform(self._car, k) for k in range(3)], np.nan)

    def of(self, captures: Sequence[Capture], looks: Looks) -> Drawn:
        """All draws for the captures' looks."""
        moment = mixed(np.array([self._drone(c.drone) ^ max(round(c.t_s * 1e3), 0) for c in captures], np.uint64))
        one = mixed(moment[looks.capture] ^ self._car[looks.car])
        own = self._car_draws[:, looks.car]
        look, detected, placed = np.where(np.isnan(own), [uniform(one, k) for k in range(3)], own)
        ranked, scored = ndtri(uniform(one, 3)), uniform(one, 4)
        alarm = moment[:, None] + np.arange(1, 2 * BANDS * ALARMS + 1, dtype=np.uint64) * np.uint64(GAMMA)
        drawn = uniform(alarm, 8).reshape(len(captures), 2, BANDS, ALARMS)
        arrivals = np.cumsum(-np.log(drawn[:, 0]), axis=-1)
        singles = (look, ranked, np.stack([detected, scored], axis=1), placed, arrivals, drawn[:, 1])
        a, b, c, d, e, f = (np.asarray(v, np.float32) for v in singles)
        return Drawn(a, b, c, d, e, f, moment, self._offset_draw[looks.car])

    def _drone(self, drone: int) -> int:
        """The drone's number."""
        number = self._drones.get(drone)
        if number is None:
            rng = stream(*self._key, drone, "surrogate.look")
            number = self._drones[drone] = int(rng.integers(2**64, dtype=np.uint64))
        return number
