"""The Rerun recording as this room draws on it: two timelines, columns, and the colours that mean something."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from sortie.scenarios.link_state import is_tried

Floats = NDArray[np.float64]
Rgba = tuple[int, int, int, int]

SIM_TIME, FRAME = "sim_time", "frame"
"""Simulated time since take-off, and the frame that it falls into."""
SPAN_M = 5.0
"""Drones are drawn this wide, some eight times their size, so that they can be seen."""

DRONE_COLOURS: tuple[Rgba, ...] = (
    (86, 156, 255, 255), (255, 159, 64, 255), (199, 125, 255, 255), (64, 214, 200, 255), (255, 118, 168, 255),
    (222, 206, 92, 255), (150, 190, 230, 255), (226, 142, 110, 255), (170, 210, 120, 255), (190, 170, 160, 255),
)  # fmt: skip
FOUND, MISSED, FALSE = (
    np.array(shades, np.float64)
    for shades in (
        [(70, 220, 90), (40, 200, 220), (170, 120, 255)],
        [(255, 200, 40), (205, 150, 90), (240, 240, 250)],
        [(255, 60, 60), (255, 120, 30), (255, 60, 170)],
    )
)
"""By class: a car's, a truck's, a person's."""
PEOPLE: Rgba = (250, 230, 210, 255)
IDLE, FALLEN, BROKEN = (150, 155, 165, 90), (120, 120, 120, 255), (255, 40, 60, 255)
UNMEASURED = (185, 190, 200, 255)
WARNING = (255, 225, 90, 255)
MISSION, TARGET, JAMMER = (255, 80, 220, 255), (255, 40, 60, 255), (255, 140, 0, 255)
SENT: dict[str, Rgba] = {
    "features": (90, 200, 120, 255),
    "codes": (60, 170, 190, 255),
    "detections": (250, 180, 60, 255),
    "uncertain_boxes": (235, 120, 70, 255),
    "tracks": (120, 170, 255, 255),
    "raw": (230, 110, 230, 255),
    "handshake": (200, 200, 140, 255),
    "nothing": (95, 98, 105, 255),
}
PHASES: dict[str, Rgba] = {
    "transit": (120, 130, 150, 255),
    "search": (70, 120, 190, 255),
    "track": MISSION,
    "return": (140, 120, 100, 255),
}


def drone_colour(drone: int) -> Rgba:
    """The drone's colour, the same in the scene and in every plot."""
    return DRONE_COLOURS[drone % len(DRONE_COLOURS)]


def goodput_colours(mbps: Floats) -> NDArray[np.uint8]:
    """Colours [..., 4] of goodputs: red at 1 Mb/s and below, yellow at 10, green at 100 and above; grey if not measured lately."""
    level = np.clip(np.log10(np.maximum(mbps, 1e-3)) / 2.0, 0.0, 1.0)
    red, green = np.clip(2.0 - 2.0 * level, 0.0, 1.0), np.clip(2.0 * level, 0.0, 1.0)
    colour = np.stack([50 + 205 * red, 45 + 185 * green, np.full_like(red, 60), np.full_like(red, 255)], axis=-1)
    unmeasured = np.expand_dims(~is_tried(mbps), -1)
    return np.where(unmeasured, UNMEASURED, colour).astype(np.uint8)


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
            rr.TimeColumn(FRAME, sequence=np.floor(np.asarray(t_s) * self._rate_hz + 1e-6).astype(np.int64)),
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
