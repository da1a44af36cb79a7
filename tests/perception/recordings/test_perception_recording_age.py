"""What the age of a recorded map leaves of its boxes: once, with and without a fusion of one's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from perception_examples import capture
from recording_examples import small

from sortie.perception.lateness import reach_m, still_right
from sortie.perception.recordings.detector import RecordedDetector
from sortie.perception.types import Share
from sortie.scenarios.schema import Perception

CAR = np.array([[4.5, 1.9]])


@pytest.mark.parametrize("weight", [1.0, 0.5])
@pytest.mark.parametrize("age_s", [0.0, 0.1, 0.3, 0.8])
@pytest.mark.parametrize("joins", ["nms", "average"])
def test_a_late_map_s_boxes_lose_what_their_age_leaves_once(
    weight: float, age_s: float, joins: str, tmp_path: Path
) -> None:
    """Drone 0 sees nothing, and gets a map of drone 1 of that age: its box keeps its score times weight and what is left."""
    pose = np.array([[(0, 0, 0), (10, 0, 0)]] * 2, float)
    none, box = np.zeros((0, 6)), np.array([[0.0, 20.0, 4.5, 1.9, 0.2, 0.8]])
    frames = [[none, box]] * 2
    path = small(tmp_path / "flown.npz", t_s=[0.0, 1.0], pose=pose, boxes=frames, features=None)
    detector = RecordedDetector(Perception(detector="recorded", recording=str(path), join=joins, score_threshold=0.01))
    now_s = 1.0
    ego, peer = capture(0.0, 0.0, t_s=now_s), capture(10.0, 0.0, drone=1, t_s=now_s)
    share = Share(peer._replace(t_s=now_s - age_s), "features", 1.0, None, weight, age_s=age_s)
    (out,) = detector.detect([(ego, [share])])
    left = float(still_right(reach_m(CAR), age_s)[0])
    assert out.xy_m.tolist() == [pytest.approx([10.0, 20.0], abs=1e-4)]
    assert out.score[0] == pytest.approx(0.8 * weight * left, rel=1e-5)
