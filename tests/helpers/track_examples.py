"""Tracks for tests of tracking and following."""

from __future__ import annotations

from typing import Any

import numpy as np

from sortie.perception.motion import Tracks


def tracks(n: int = 1, **changes: Any) -> Tracks:
    """Confirmed tracks at 10 s, seen there and then, that drive east at 8 m/s from the origin."""
    columns: dict[str, Any] = {
        "owner": np.zeros(n, np.int64),
        "id": np.arange(n),
        "t_s": np.full(n, 10.0),
        "xy_m": np.zeros((n, 2)),
        "velocity_mps": np.tile([8.0, 0.0], (n, 1)),
        "covariance": np.tile([0.3, 0.2, 1.0], (n, 1)),
        "size_m": np.tile([4.6, 1.9], (n, 1)),
        "yaw_rad": np.zeros(n),
        "score": np.full(n, 0.8),
        "hits": np.full(n, 9),
        "looks": np.full(n, 9),
        "seen_s": np.full(n, 10.0),
        "confirmed": np.ones(n, bool),
        "kind": np.zeros(n, np.int8),
    }
    return Tracks(**(columns | changes))
