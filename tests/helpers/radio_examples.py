"""Where drones are, to test the radio with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

CROSS_M = np.array([[0, 0, 60], [20, 0, 60], [-20, 0, 60], [0, 20, 60], [0, -20, 60], [40, 0, 60]], float)
"""[6, 3] ENU: five in a cross of 20 m, and one further out."""


def still(positions_m: NDArray[np.float64], frames: int = 20_000) -> NDArray[np.float64]:
    """A flight [frames, N, 3] in which nobody moves."""
    return np.broadcast_to(positions_m, (frames, *positions_m.shape))
