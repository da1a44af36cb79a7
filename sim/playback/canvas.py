"""The Rerun recording as this room draws on it: two timelines, columns, and the colours that mean something."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from sortie.scenarios.frames import frames_at
from sortie.sim.results.palette import Floats, Rgba

SIM_TIME, FRAME = "sim_time", "frame"
"""Simulated time since take-off, and the frame that it falls into."""
SPAN_M = 5.0
"""Drones are drawn this wide, some eight times their size, so that they can be seen."""


def packed(rgba: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Colours [n, 4] as 0xRRGGBBAA [n], which columns partition without guessing."""
    r, g, b, a = (rgba[:, k].astype(np.uint32) for k in range(4))
    return np.asarray(r << 24 | g << 16 | b << 8 | a, np.uint32)


def about_z(yaw_rad: Floats) -> Floats:
    """Quaternions x, y, z, w [n, 4] of turns about the vertical."""
    zero = np.zeros(len(yaw_rad))
    return np.column_stack([zero, zero, np.sin(yaw_rad / 2), np.cos(yaw_rad / 2)])


class Canvas:
    """Writes to one recording, on both timelines; strict, so that a wrong shape is an error and not a warning.

    With a `root` all entities are below it, so that several sorties fit into one recording.
    """

    def __init__(self, recording: rr.RecordingStream, rate_hz: float, root: str = "") -> None:
        self._recording, self._rate_hz, self._root = recording, rate_hz, root

    def _at(self, path: str) -> str:
        return f"{self._root}/{path}" if self._root else path

    def columns(self, path: str, t_s: Floats, *columns: Iterable[rr.ComponentColumn]) -> None:
        """Send rows at the times `t_s` [n]; nothing where n is 0."""
        if len(t_s) == 0:
            return
        indexes = [
            rr.TimeColumn(SIM_TIME, duration=np.round(np.asarray(t_s) * 1e9).astype("timedelta64[ns]")),
            rr.TimeColumn(FRAME, sequence=frames_at(t_s, 1.0 / self._rate_hz)),
        ]
        self._recording.send_columns(self._at(path), indexes, [c for group in columns for c in group], strict=True)

    def scalars(self, path: str, t_s: Floats, values: Floats) -> None:
        """Send one plot's points."""
        self.columns(path, t_s, rr.Scalars.columns(scalars=values))

    def static(self, path: str, *archetypes: Any) -> None:
        """Log what holds at all times."""
        self._recording.log(self._at(path), *archetypes, static=True, strict=True)


def line(name: str, colour: Rgba, *, width: float = 1.8, steps: bool = False) -> rr.SeriesLines:
    """A plot line's looks; `steps` holds each value until the next."""
    mode = rr.components.InterpolationMode.StepAfter if steps else None
    return rr.SeriesLines(colors=[colour], widths=[width], names=[name], interpolation_mode=mode)
