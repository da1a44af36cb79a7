"""Random numbers by counter: a number for a link and a frame, without those of any other link or frame before it.

A stream of numbers has to be drawn in order, also for links that nobody needs; where a fleet is large, most links
are out of earshot. So there each link has a 64 bit key, made of keys from its drones' streams, and the number of
a frame is SplitMix64's finaliser of key and frame (Steele, Lea & Flood, OOPSLA 2014).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import chndtr, ndtri

from scenarios.streams import stream

FloatArray = NDArray[np.float64]
Keys = NDArray[np.uint64]

_LEVELS = 1 << 16


def mix(z: Keys) -> Keys:
    """SplitMix64's finaliser, of a counter times the golden ratio."""
    z = z * np.uint64(0x9E3779B97F4A7C15)
    z ^= z >> np.uint64(30)
    z *= np.uint64(0xBF58476D1CE4E5B9)
    z ^= z >> np.uint64(27)
    z *= np.uint64(0x94D049BB133111EB)
    z ^= z >> np.uint64(31)
    return z


def drone_keys(seed: int, replication: int, n: int) -> Keys:
    """[N]: one key a drone, of its own stream."""
    return np.array([stream(seed, replication, i, "link key").bit_generator.random_raw() for i in range(n)], np.uint64)


def link_keys(drones: Keys, sender: NDArray[np.int64], receiver: NDArray[np.int64], purpose: int) -> Keys:
    """[L]: one key a directed link and purpose (a small number)."""
    return mix(drones[sender] + np.uint64(purpose)) ^ mix(drones[receiver] ^ np.uint64(0x5851F42D4C957F2D))


def numbers(keys: Keys, first_frame: int, frames: int) -> Keys:
    """[frames, L]: 64 random bits a link and frame."""
    counters = mix(np.arange(first_frame, first_frame + frames, dtype=np.uint64))
    return mix(keys[None, :] + counters[:, None])


def uniforms(bits: Keys) -> FloatArray:
    """Numbers in [0, 1) from the lower 48 bits, so that the upper 16 may serve another purpose."""
    return np.asarray((bits & np.uint64((1 << 48) - 1)) * 2.0**-48)


def levels(bits: Keys) -> NDArray[np.int64]:
    """0 … 65,535 from the upper 16 bits: indices into the tables below."""
    return np.asarray((bits >> np.uint64(48)).astype(np.int64))


@lru_cache(maxsize=1)
def normal_table() -> FloatArray:
    """[65,536]: the standard normal distribution in steps of equal probability, ± 4.3 at most."""
    return np.asarray(ndtri((np.arange(_LEVELS) + 0.5) / _LEVELS))


@lru_cache(maxsize=32)
def fade_table_db(k_db: float) -> FloatArray:
    """[65,536]: the Rician power gain of mean 1, dB, in steps of equal probability."""
    k = 10.0 ** (k_db / 10.0)
    grid_db = np.arange(-60.0, 16.0, 0.01)
    cdf = chndtr(10.0 ** (grid_db / 10.0) * 2.0 * (k + 1.0), 2, 2.0 * k)  # non-central χ², two degrees of freedom
    rising = np.concatenate([[True], np.diff(cdf) > 0.0])
    return np.asarray(np.interp((np.arange(_LEVELS) + 0.5) / _LEVELS, cdf[rising], grid_db[rising]))
