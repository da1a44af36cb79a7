"""The surrogate's draws: for each drone, moment and car, whatever was sent. Free of torch.

One number a drone and one a car come from streams; what is drawn for a drone, a millisecond and a car is those numbers
mixed. A stream of its own for every look would cost more than the rest of the surrogate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from sortie.perception.surrogate.features import Looks
from sortie.perception.surrogate.hashing import GAMMA, Words, mixed, uniform
from sortie.perception.types import Capture
from sortie.scenarios.streams import stream

BANDS, ALARMS = 8, 24
"""The most bands of scores, and the most false alarms of one that a moment can have."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """Of looks l and captures c: `look` [l] uniform, `rank` [l] normal, `find` [l, 2] uniform, `residual` [l] uniform,
    `alarm_at` [c, 8, 24] arrivals of processes of rate 1, `alarm_which` [c, 8, 24] uniform, `moment` [c] numbers to draw more by; `thrown`
    [l, 4], of the car whoever looks: uniform, and to which side (−1, 1) along it, across it and in heading boxes of it lie off,
    where it is one of those whose boxes all do."""

    look: NDArray[np.float32]
    rank: NDArray[np.float32]
    find: NDArray[np.float32]
    residual: NDArray[np.float32]
    alarm_at: NDArray[np.float32]
    alarm_which: NDArray[np.float32]
    moment: Words
    thrown: NDArray[np.float32]


class Luck:
    """Draws of one sortie over a town; `alike` as in `Parameters`: part of the cars have a luck of their own, whoever looks and
    whenever. It is the town's: another sortie over it finds the same cars hard."""

    def __init__(self, seed: int, replication: int, town: int, cars: int, alike: NDArray[np.float32]) -> None:
        self._key, self._drones = (seed, replication), dict[int, int]()
        self._car: Words = stream(town, 0, (), "surrogate.car").integers(2**64, size=cars, dtype=np.uint64)
        own = [uniform(self._car, k + 3) < part for k, part in enumerate(alike[:3])]
        sides = [np.where(uniform(self._car, k) < 0.5, -1.0, 1.0) for k in (7, 8, 9)]
        self._thrown = np.stack([uniform(self._car, 6), *sides], axis=1).astype(np.float32)
        self._fate = np.where(own, [uniform(self._car, k) for k in range(3)], np.nan)

    def of(self, captures: Sequence[Capture], looks: Looks) -> Drawn:
        """Everything that the captures' looks need."""
        moment = mixed(np.array([self._drone(c.drone) ^ max(round(c.t_s * 1e3), 0) for c in captures], np.uint64))
        one = mixed(moment[looks.capture] ^ self._car[looks.car])
        fate = self._fate[:, looks.car]
        look, found, placed = np.where(np.isnan(fate), [uniform(one, k) for k in range(3)], fate)
        ranked, scored = ndtri(uniform(one, 3)), uniform(one, 4)
        alarm = moment[:, None] + np.arange(1, 2 * BANDS * ALARMS + 1, dtype=np.uint64) * np.uint64(GAMMA)
        drawn = uniform(alarm, 8).reshape(len(captures), 2, BANDS, ALARMS)
        arrivals = np.cumsum(-np.log(drawn[:, 0]), axis=-1)
        singles = (look, ranked, np.stack([found, scored], axis=1), placed, arrivals, drawn[:, 1])
        a, b, c, d, e, f = (np.asarray(v, np.float32) for v in singles)
        return Drawn(a, b, c, d, e, f, moment, self._thrown[looks.car])

    def _drone(self, drone: int) -> int:
        """The drone's number."""
        found = self._drones.get(drone)
        if found is None:
            rng = stream(*self._key, drone, "surrogate.look")
            found = self._drones[drone] = int(rng.integers(2**64, dtype=np.uint64))
        return found
