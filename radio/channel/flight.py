"""Where a fleet flies, as the channel reads it: some frames at once."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

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

    def __init__(self, positions_m: ArrayLike, up: ArrayLike | None = None) -> None:
        """Raises:
        ValueError: if a shape is wrong or a number is not finite.
        """
        self._positions_m = p = np.asarray(positions_m, dtype=float)
        self._up = u = None if up is None else np.asarray(up, dtype=float)
        if p.ndim != 3 or p.shape[1] < 1 or p.shape[2] != 3:
            raise ValueError(f"positions_m has shape {p.shape}, must be (frames, drones, 3)")
        if u is not None and u.shape != p.shape:
            raise ValueError(f"up has shape {u.shape}, must be {p.shape}, as positions_m")
        for name, values in (("positions_m", p), ("up", u)):
            if values is not None and not np.isfinite(values).all():
                raise ValueError(f"{name} holds a value that is not finite")
        self.frames, self.drones = p.shape[:2]

    def poses(self, frames: slice) -> tuple[FloatArray, FloatArray | None]:
        """As `Flight`."""
        return self._positions_m[frames], None if self._up is None else self._up[frames]


def flight_of(positions_m: ArrayLike | Flight, up: ArrayLike | None = None) -> Flight:
    """The flight that is given, or one by its positions [T, N, 3] and the airframes' z axes, ENU."""
    return positions_m if isinstance(positions_m, Flight) else KnownFlight(positions_m, up)
