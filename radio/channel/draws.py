"""The random numbers of shadowing, by stream for small fleets and by counter for large ones; the table of fades.

**By stream**: one stream a drone; the stream of drone h draws for its links to the drones of *lower* id, so that each pair
has numbers of its own and one more drone changes none of the others', with N streams and not N².

**By counter**: a number for a link and a frame, without those of any other link or frame before it.
A stream of numbers has to be drawn in order, also for links that nobody needs; where a fleet is large, most links
are out of earshot. So there each link has a 64 bit key, made of keys from its drones' streams, and the number of
a frame is SplitMix64's finaliser of key and frame (Steele, Lea & Flood, OOPSLA 2014).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import chndtr, ndtri

from sortie.radio.channel.shadowing import gauss_markov, keep
from sortie.radio.settings import AirSettings
from sortie.scenarios.streams import stream

Keys = NDArray[np.uint64]

FloatArray = NDArray[np.float64]

_LEVELS = 1 << 16


class StreamShadowing:
    """Shadowing of every pair of n drones, block after block."""

    def __init__(self, settings: AirSettings, seed: int, replication: int, n: int, frame_s: float) -> None:
        self._sigma_db, self._n = settings.shadowing_sigma_db, n
        self._keep = keep(frame_s, settings.shadowing_time_s)
        self._streams = [stream(seed, replication, h, "shadowing") for h in range(1, n)] if self._sigma_db else []
        self._last_db: FloatArray | None = None

    def block(self, frames: int) -> FloatArray:
        """Of the next frames, dB; [frames, n, n], symmetric. All blocks but the last must be of one length."""
        if not self._sigma_db:
            return np.zeros((frames, self._n, self._n))
        normals = np.zeros((frames, self._n, self._n))
        for h, rng in enumerate(self._streams, 1):
            normals[:, h, :h] = drawn = rng.standard_normal((frames, h))
            normals[:, :h, h] = drawn
        shadow_db = gauss_markov(normals, self._sigma_db, self._keep, self._last_db)
        self._last_db = shadow_db[-1]
        return shadow_db


def mix(z: Keys) -> Keys:
    """SplitMix64's finaliser, of a counter times the golden ratio."""
    z = z * np.uint64(0x9E3779B97F4A7C15)
    shifted = z >> np.uint64(30)
    z ^= shifted
    z *= np.uint64(0xBF58476D1CE4E5B9)
    z ^= np.right_shift(z, np.uint64(27), out=shifted)
    z *= np.uint64(0x94D049BB133111EB)
    z ^= np.right_shift(z, np.uint64(31), out=shifted)
    return z


def drone_keys(seed: int, replication: int, n: int) -> Keys:
    """[N]: one key a drone, of its own stream."""
    return np.array([stream(seed, replication, i, "link key").bit_generator.random_raw() for i in range(n)], np.uint64)


def link_keys(drones: Keys, sender: NDArray[np.int64], receiver: NDArray[np.int64]) -> Keys:
    """[L]: one key a directed link."""
    return mix(drones)[sender] ^ mix(drones ^ np.uint64(0x5851F42D4C957F2D))[receiver]


@lru_cache(maxsize=1)
def normal_table() -> NDArray[np.float32]:
    """[65,536]: the standard normal distribution in steps of equal probability, ± 4.3 at most."""
    return np.asarray(ndtri((np.arange(_LEVELS) + 0.5) / _LEVELS), np.float32)


@lru_cache(maxsize=32)
def fade_table_db(k_db: float) -> NDArray[np.float32]:
    """[65,536]: the Rician power gain of mean 1, dB, in steps of equal probability."""
    k = 10.0 ** (k_db / 10.0)
    grid_db = np.arange(-60.0, 16.0, 0.01)
    cdf = chndtr(10.0 ** (grid_db / 10.0) * 2.0 * (k + 1.0), 2, 2.0 * k)  # non-central χ², two degrees of freedom
    rising = np.concatenate([[True], np.diff(cdf) > 0.0])
    middles = (np.arange(_LEVELS) + 0.5) / _LEVELS
    return np.asarray(np.interp(middles, cdf[rising], grid_db[rising]), np.float32)


@lru_cache(maxsize=32)
def fade_table(k_db: float) -> NDArray[np.float32]:
    """The same as a factor of the mean power."""
    table: NDArray[np.float32] = (10.0 ** (np.asarray(fade_table_db(k_db), float) / 10.0)).astype(np.float32)
    table.flags.writeable = False  # all fleets share it
    return table
