"""The interfaces of frames and of a model that the evaluation needs; a recording of another model meets them too. Free of torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from sortie.perception.evaluation.condition import CellsBy, Unsent
from sortie.perception.geometry import Geometry

Floats = NDArray[np.float64]


class FleetFrames(Protocol):
    """n fleet-frames of d drones: their poses and the cars. `research.benchmark.dataset.Frames` is one."""

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
    """What one ego receives in one frame."""

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

        Before suppression. The same exchange gives the same boxes whatever else is computed (to rounding).
        """


class Instrument(Protocol):
    """A model with its weights."""

    @property
    def fingerprint(self) -> str:
        """A hash of everything that the boxes depend on beside the frames and the exchange."""

    @property
    def geometry(self) -> Geometry:
        """Its grids; the cars inside the ego's square of that size are the ground truth."""

    def look(self, frames: FleetFrames, frame: int) -> FrameView:
        """Look at one fleet-frame; whatever conditions share is computed once."""
