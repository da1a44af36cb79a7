"""The study of predicted tracks judges a still car that every drone sees as found in every frame."""

from __future__ import annotations

import numpy as np
import pytest

from research.validation.track_prediction import END, Flight, judged
from sortie.perception.motion import Tracks
from sortie.perception.types import Boxes, Capture


@pytest.mark.parametrize("kind", [0, 1])
def test_a_still_vehicle_is_followed_where_its_class_is_right(kind: int) -> None:
    """AP is 1, and HOTA all but the looks before the track is confirmed; a truck that is taken for a car is missed by both."""
    at = np.array([[10.0, 5.0]], np.float32), np.array([[4.5, 2.0]], np.float32), np.zeros(1, np.float32)
    car = Boxes(*at, np.ones(1, np.float32))
    truth = Boxes(*at, np.ones(1, np.float32), np.zeros(1, np.int32), np.full(1, kind, np.int8))

    def capture(drone: int, frame: int) -> Capture:
        return Capture(drone, frame / 10, (0.0, 0.0, 60.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 60.0), 0.0)

    frames = range(END)
    flight = Flight(
        captures=[[capture(d, f) for d in range(2)] for f in frames],
        own=[[car, car] for _ in frames],
        truth=[[truth, truth] for _ in frames],
        tracks={10: [[Tracks.empty()] * 2 for _ in frames]},
    )
    found = judged(flight, 1, 10, "alone", "nms")
    assert found.ap == (1.0 if kind == 0 else 0.0)
    assert found.hota == (pytest.approx(1.0, abs=0.1) if kind == 0 else 0.0)
    assert judged(flight, 1, 10, "alone", "average") == found, "alone there is nothing to average"
