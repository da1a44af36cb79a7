"""Seconds outside, frames inside: which frame a moment belongs to.

Frame k begins at k · `frame_s`, and moments that scenarios and records name are sums of such lengths. They come out a few
last digits beside a frame's begin. So a moment is compared with frames only here, once, and by whole numbers from then on.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

DIGITS = 6
"""Decimals of a frame that count: what is nearer to a frame's begin is the begin."""


def frame_at(t_s: float, frame_s: float) -> int:
    """The frame in which a moment lies: the last that has begun.

    Example:
        >>> 0.3 / 0.1, frame_at(0.3, 0.1), frame_at(0.29, 0.1)
        (2.9999999999999996, 3, 2)
    """
    return math.floor(round(t_s / frame_s, DIGITS))


def frame_from(t_s: float, frame_s: float) -> int:
    """The first frame that begins at a moment or after it.

    Example:
        >>> 0.3 - 0.1 * 3, frame_from(3 * 0.1, 0.1), frame_from(0.29, 0.1)
        (-5.551115123125783e-17, 3, 3)
    """
    return math.ceil(round(t_s / frame_s, DIGITS))


def frames_at(t_s: ArrayLike, frame_s: float) -> NDArray[np.int64]:
    """`frame_at` of many moments."""
    return np.floor(np.round(np.asarray(t_s, dtype=np.float64) / frame_s, DIGITS)).astype(np.int64)


def frames_from(t_s: ArrayLike, frame_s: float) -> NDArray[np.int64]:
    """`frame_from` of many moments."""
    return np.ceil(np.round(np.asarray(t_s, dtype=np.float64) / frame_s, DIGITS)).astype(np.int64)


def instant(t_s: float) -> int:
    """A moment or a span as a whole number of nanoseconds, so that two that differ by rounding alone are equal.

    Example:
        >>> 0.1 + 0.2 <= 0.3, instant(0.1 + 0.2) <= instant(0.3)
        (False, True)
    """
    return round(t_s * 1e9)


def instants(t_s: ArrayLike) -> NDArray[np.int64]:
    """`instant` of many moments."""
    return np.rint(np.asarray(t_s, dtype=np.float64) * 1e9).astype(np.int64)


def with_frame(t_s: float, frame_s: float) -> float:
    """A moment, or the begin of the frame that it is but for rounding.

    So an event is no later than a frame of the same instant: at 7.5 Hz the frame of 14.8 s begins a last digit earlier.
    """
    frame_s_at = frame_from(t_s, frame_s) * frame_s
    return frame_s_at if frame_s_at < t_s else t_s
