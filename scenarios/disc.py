"""A disc on the ground: the one type for a mission's region and for the region of interest of a link."""

from __future__ import annotations

from typing import NamedTuple


class Disc(NamedTuple):
    """A disc on the ground, ENU, metres."""

    x_m: float
    y_m: float
    radius_m: float
