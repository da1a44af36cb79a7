"""Where a fleet flies, as the channel reads it: some frames at once."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sortie.scenarios import scratch

FloatArray = NDArray[np.float64]


@runtime_checkable
class Flight(Protocol):
    """A fleet's flight, of which some frames may be worked out only when they are read."""

    frames: int
    drones: int

    def poses(self, frames: slice) -> tuple[FloatArray, FloatArray | None]:
        """Positions [F, N, 3], ENU, and the unit vectors along the airframes' z axes; None is level flight."""


class KnownFlight:
    """A flight of which all positions are known."""

    def __init__(self, positions_m: ArrayLike, up: ArrayLike | None) -> None:
        """Raises:
        ValueError: if a shape is wrong or a number is not finite.
        """
        self._positions_m = p = np.asarray(positions_m, dtype=float)
        if p.ndim != 3 or p.shape[1] < 1 or p.shape[2] != 3:
            raise ValueError(f"positions_m has shape {p.shape}, must be (frames, drones, 3)")
        if not _is_finite(p):
            raise ValueError("positions_m holds a value that is not finite")
        self._up = u = None if up is None else np.asarray(up, dtype=float)
        if u is not None and u.shape != p.shape:
            raise ValueError(f"up has shape {u.shape}, must be {p.shape}, as positions_m")
        if u is not None and not _is_finite(u):
            raise ValueError("up holds a value that is not finite")
        self.frames, self.drones = p.shape[:2]

    def poses(self, frames: slice) -> tuple[FloatArray, FloatArray | None]:
        """As `Flight`."""
        return self._positions_m[frames], None if self._up is None else self._up[frames]


def flight_of(positions_m: ArrayLike | Flight, up: ArrayLike | None = None) -> Flight:
    """A flight by its positions [T, N, 3], ENU, and by the airframes' z axes; or the flight that is given.

    Raises:
        ValueError: as `KnownFlight`.
    """
    return positions_m if isinstance(positions_m, Flight) else KnownFlight(positions_m, up)


def _is_finite(values: FloatArray) -> bool:
    """Whether [frames, ...] all are; block by block, since a long flight lies on disk."""
    for rows in scratch.blocks(len(values), values[0].nbytes if len(values) else 0):
        if not np.isfinite(values[rows]).all():
            return False
        scratch.release()
    return True
