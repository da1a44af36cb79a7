"""Late fusion of maps: where the boxes that are found in a peer's map lie."""

from __future__ import annotations

import numpy as np
from perception_examples import capture

from sortie.perception.network.detector import TorchDetector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Share
from sortie.scenarios.schema import Perception, Scene


def test_a_late_map_s_boxes_lie_where_its_sender_was_or_without_compensation_where_it_is() -> None:
    """A drone without a look of its own has the boxes of one peer, who has flown 6 m and turned since."""
    town = SceneModel(Scene(), None, (-50.0, -50.0, 50.0, 50.0))
    was, now = capture(10.0, 20.0, yaw=0.3, drone=1), capture(16.0, 20.0, yaw=0.5, drone=1, t_s=5.6)
    blind = capture(10.0, 20.0, yaw=0.3, t_s=5.6)._replace(looked=False)
    share = Share(was, "features", 0.2, None, 1.0)
    there, moved = (
        TorchDetector(town, Perception(fusion="late", motion_compensation=compensates), 1).detect(
            [(blind, [share]), (now, [])]
        )[0]
        for compensates in (True, False)
    )
    assert len(there) > 5
    c, s = np.cos(0.2), np.sin(0.2)
    off = there.xy_m - np.array([10.0, 20.0])
    turned = np.array([16.0, 20.0]) + np.stack([c * off[:, 0] - s * off[:, 1], s * off[:, 0] + c * off[:, 1]], axis=1)
    apart = np.hypot(*(turned[:, None] - moved.xy_m[None]).transpose(2, 0, 1)).min(axis=1)
    inner = np.hypot(*off.T) < 80.0  # both squares hold these
    assert np.count_nonzero(inner) > 5
    assert apart[inner].max() < 0.01
