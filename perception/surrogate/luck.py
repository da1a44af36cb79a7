"""The surrogate's draws: for each drone, moment and car, whatever was sent. Free of torch.

One number a drone and one a car come from streams; what is drawn for a drone, a millisecond and a car is those numbers
mixed (splitmix64: Steele, Lea and Flood, *Fast Splittable Pseudorandom Number Generators*, 2014). A stream of its own for
every look would cost more than the rest of the surrogate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from perception.surrogate.features import Looks
from perception.types import Capture
from scenarios.streams import stream

Words = NDArray[np.uint64]
BANDS, ALARMS = 8, 24
"""The most bands of scores, and the most false alarms of one that a moment can have."""
_GAMMA = 0x9E3779B97F4A7C15


@dataclass(frozen=True, slots=True)
class Drawn:
    """Of looks l and captures c: `look` [l] uniform, `rank` [l] normal, `find` [l, 2] uniform and normal, `residual` [l] uniform,
    `alarm_at` [c, 8, 24] arrivals of processes of rate 1, `alarm_which` [c, 8, 24] uniform."""

    look: NDArray[np.float32]
    rank: NDArray[np.float32]
    find: NDArray[np.float32]
    residual: NDArray[np.float32]
    alarm_at: NDArray[np.float32]
    alarm_which: NDArray[np.float32]


class Luck:
    """Draws of one sortie; `alike` [3] is the part of the cars whose luck is their own, whoever looks: see `Parameters`."""

    def __init__(self, seed: int, replication: int, cars: int, alike: NDArray[np.float32]) -> None:
        self._key, self._drones = (seed, replication), dict[int, int]()
        rng = stream(seed, replication, (), "surrogate.car")
        self._car: Words = rng.integers(2**64, size=cars, dtype=np.uint64)
        own = [uniform(self._car, k + 3) < part for k, part in enumerate(alike)]
        self._fate = np.where(own, [uniform(self._car, k) for k in range(3)], np.nan)

    def of(self, captures: Sequence[Capture], looks: Looks) -> Drawn:
        """Everything that the captures' looks need."""
        moment = mixed(np.array([self._drone(c.drone) ^ max(round(c.t_s * 1e3), 0) for c in captures], np.uint64))
        one = mixed(moment[looks.capture] ^ self._car[looks.car])
        fate = self._fate[:, looks.car]
        look, found, placed = np.where(np.isnan(fate), [uniform(one, k) for k in range(3)], fate)
        ranked, scored = (ndtri(uniform(one, k)) for k in (3, 4))
        alarm = moment[:, None] + np.arange(1, 2 * BANDS * ALARMS + 1, dtype=np.uint64) * np.uint64(_GAMMA)
        drawn = uniform(alarm, 8).reshape(len(captures), 2, BANDS, ALARMS)
        arrivals = np.cumsum(-np.log(drawn[:, 0]), axis=-1)
        singles = (look, ranked, np.stack([found, scored], axis=1), placed, arrivals, drawn[:, 1])
        return Drawn(*(np.asarray(v, np.float32) for v in singles))

    def _drone(self, drone: int) -> int:
        """The drone's number."""
        found = self._drones.get(drone)
        if found is None:
            rng = stream(*self._key, drone, "surrogate.look")
            found = self._drones[drone] = int(rng.integers(2**64, dtype=np.uint64))
        return found


def mixed(x: Words) -> Words:
    """Each word scrambled, one to one: splitmix64's finaliser."""
    x = x + np.uint64(_GAMMA)
    x ^= x >> np.uint64(30)
    x *= np.uint64(0xBF58476D1CE4E5B9)
    x ^= x >> np.uint64(27)
    x *= np.uint64(0x94D049BB133111EB)
    x ^= x >> np.uint64(31)
    return x


def uniform(x: Words, purpose: int) -> NDArray[np.float64]:
    """Numbers in (0, 1), others for every purpose."""
    return np.asarray(
        ((mixed(x + np.uint64((purpose + 1) * 0xD1B54A32D192ED03 % 2**64)) >> np.uint64(12)) + 0.5) * 2.0**-52,
        np.float64,
    )
