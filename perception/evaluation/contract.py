"""What the evaluator asks of frames and of a model, so that a recording of any other model can take our network's place. Free of torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from sortie.perception.evaluation.condition import CellsBy, Unsent
from sortie.perception.geometry import Geometry

Floats = NDArray[np.float64]


class FleetFrames(Protocol):
    """n fleet-frames of d drones: where they were, what was there. `sortie.perception.benchmark.dataset.Frames` is one."""

    @property
    def true_pose(self) -> Floats:
        """[n, d, 3] x, y, yaw, ENU."""

    @property
    def est_pose(self) -> Floats:
        """[n, d, 3] as the drones believed."""

    @property
    def cars(self) -> Floats:
        """[n, m, 5] x, y, length, width, yaw of every car there was, NaN-padded."""

    @property
    def scene(self) -> NDArray[np.int64]:
        """[n] which scene a frame is from."""


class Exchange(NamedTuple):
    """What one ego is given in one frame."""

    ego: int
    peers: tuple[int, ...]
    """Those that are present, whether any cell of theirs was sent or not."""
    sent: NDArray[np.bool_]
    """[peers, 64, 64] on each sender's own grid."""
    unsent: Unsent = "zero"


class FrameView(Protocol):
    """One fleet-frame as a model sees it."""

    def rank(self, by: CellsBy) -> NDArray[np.floating]:
        """[d, 64, 64]: what ranks each drone's cells on its own grid, higher first."""

    def detect(self, exchanges: Sequence[Exchange], floor: float) -> list[Floats]:
        """Each ego's boxes [m, 6] with scores ≥ `floor`: x forward, y left of its estimated pose, length, width, yaw, score.

        Before suppression. The same exchange gives the same boxes whatever else is asked for (to rounding).
        """


class Instrument(Protocol):
    """A model with its weights."""

    @property
    def fingerprint(self) -> str:
        """A hash of everything that the boxes depend on beside the frames and the exchange."""

    @property
    def geometry(self) -> Geometry:
        """Its grids; cars inside the ego's square of that size are what there is to find."""

    def look(self, frames: FleetFrames, frame: int) -> FrameView:
        """What it makes of one fleet-frame; all that conditions share is computed once."""
