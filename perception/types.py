"""What passes between perception and the rest, free of torch: a capture, a peer's share of it, boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Capture:
    """One drone's sensing at one instant: a cheap handle, rendered only when somebody looks."""

    drone: int
    t_s: float
    """When it was sensed."""
    position_m: tuple[float, float, float]
    """Where the drone was, ENU."""
    orientation_xyzw: tuple[float, float, float, float]
    """How it was turned, FLU in ENU."""
    est_position_m: tuple[float, float, float]
    """Where it believed it was, ENU."""
    est_yaw_rad: float
    """The heading it believed, from east towards north."""


@dataclass(frozen=True, slots=True)
class Share:
    """One peer's payload as it was delivered."""

    capture: Capture
    representation: str
    """features, detections, tracks or raw."""
    rho: float
    roi: tuple[float, float, float] | None
    """x_m, y_m, radius_m, ENU."""
    weight: float
    """Fusion weight from the directive, 0 … 1."""


@dataclass(frozen=True, slots=True)
class Boxes:
    """Oriented boxes on the ground, world frame ENU; float32 arrays over n boxes."""

    xy_m: np.ndarray
    """[n, 2] centres."""
    size_m: np.ndarray
    """[n, 2] length, width."""
    yaw_rad: np.ndarray
    """[n]"""
    score: np.ndarray
    """[n]; ones for ground truth."""

    def __len__(self) -> int:
        return len(self.score)
