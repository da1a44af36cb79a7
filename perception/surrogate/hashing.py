"""Random numbers by hashing keys, many at once: equal keys give equal draws. Free of torch.

splitmix64 (Steele, Lea and Flood, *Fast Splittable Pseudorandom Number Generators*, 2014).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Hashes = NDArray[np.uint64]
GAMMA = 0x9E3779B97F4A7C15


def mixed(x: Hashes) -> Hashes:
    """Each number scrambled, one to one: splitmix64's finaliser."""
    x = x + np.uint64(GAMMA)
    x ^= x >> np.uint64(30)
    x *= np.uint64(0xBF58476D1CE4E5B9)
    x ^= x >> np.uint64(27)
    x *= np.uint64(0x94D049BB133111EB)
    x ^= x >> np.uint64(31)
    return x


def keyed(key: np.uint64, rows: NDArray[np.int64]) -> Hashes:
    """A number for each row [n, k] of integers: other rows, or another key, give other numbers."""
    out = np.full(len(rows), key)
    for column in rows.T:
        out = mixed(out ^ column.astype(np.uint64))
    return out


def uniform(x: Hashes, purpose: int) -> NDArray[np.float64]:
    """Numbers in (0, 1); each purpose gives different ones."""
    return np.asarray(
        ((mixed(x + np.uint64((purpose + 1) * 0xD1B54A32D192ED03 % 2**64)) >> np.uint64(12)) + 0.5) * 2.0**-52,
        np.float64,
    )
