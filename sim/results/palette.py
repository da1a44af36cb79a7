"""What colours mean, in the playback and in bags for 3-D panels; on dark ground. The report page has its own, on white."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sortie.scenarios.link_state import is_tried

Floats = NDArray[np.float64]
Rgba = tuple[int, int, int, int]

DRONE_COLOURS: tuple[Rgba, ...] = (
    (86, 156, 255, 255),
    (255, 159, 64, 255),
    (199, 125, 255, 255),
    (64, 214, 200, 255),
    (255, 118, 168, 255),
    (222, 206, 92, 255),
    (150, 190, 230, 255),
    (226, 142, 110, 255),
    (170, 210, 120, 255),
    (190, 170, 160, 255),
)
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
    return _from_red_to_green(np.where(is_tried(mbps), level, np.nan))


def share_colours(share: Floats) -> NDArray[np.uint8]:
    """Colours [..., 4] of shares: red at none, yellow at half, green at all; grey where there is none to tell of (NaN)."""
    return _from_red_to_green(share)


def _from_red_to_green(level: Floats) -> NDArray[np.uint8]:
    """Colours [..., 4] of 0 … 1; grey of NaN."""
    there = ~np.isnan(level)
    known = np.where(there, level, 0.0)
    red, green = np.clip(2.0 - 2.0 * known, 0.0, 1.0), np.clip(2.0 * known, 0.0, 1.0)
    colour = np.stack([50 + 205 * red, 45 + 185 * green, np.full_like(red, 60), np.full_like(red, 255)], axis=-1)
    return np.where(there[..., None], colour, UNMEASURED).astype(np.uint8)
