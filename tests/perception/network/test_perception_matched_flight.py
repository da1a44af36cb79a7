"""`perception.match_poses` in a sortie's detector: it fuses as if drones had believed the corrected poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from perception_examples import cross

from sortie.perception.network.detector import TorchDetector
from sortie.perception.pose_matching import matched_poses, sure
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Capture, Share
from sortie.policies.contract import Disc
from sortie.scenarios.schema import Perception, Scene

FINE = Path("fine.safetensors")


def believing(capture: Capture, pose: tuple[float, float, float]) -> Capture:
    x, y, yaw = pose
    return capture._replace(est_position_m=(x, y, capture.est_position_m[2]), est_yaw_rad=yaw)


def erring() -> list[Capture]:
    """Three drones with pose errors."""
    rng = np.random.default_rng(2)
    return [
        believing(c, tuple((np.array(c.est_pose) + rng.normal(0, [0.3, 0.3, 0.004])).tolist()))
        for c in cross(10.0, 20.0, 0.3)[:3]
    ]


REGION = Disc(5.0, 5.0, 40.0)


@pytest.fixture(scope="module")
def detectors() -> dict[bool, TorchDetector]:
    """One that corrects poses, and one that does not, over one scene."""
    scene = SceneModel(Scene(), None, (-50, -50, 50, 50))
    return {match: TorchDetector(scene, Perception(match_poses=match), 1, FINE) for match in (False, True)}


def found(
    detector: TorchDetector, captures: list[Capture], sent: str, rho: float = 1.0, roi: Disc | None = None
) -> np.ndarray:
    """Boxes and scores of the first drone, which hears the others."""
    ego, *peers = captures
    (boxes,) = detector.detect([(ego, [Share(c, sent, rho, roi, 1.0) for c in peers])])
    return np.column_stack([boxes.table(), boxes.score])


@pytest.mark.parametrize(
    ("sent", "rho", "roi", "looked"),
    [
        ("features", 1.0, None, True), ("features", 1.0, REGION, False), ("features", 0.02, None, False),
        ("codes", 0.02, None, True), ("raw", 0.0, REGION, True),
        *((boxes, 0.0, None, looked) for boxes in ("detections", "uncertain_boxes") for looked in (True, False)),
    ],
)  # fmt: skip
def test_it_fuses_as_if_drones_had_believed_the_corrected_poses(
    detectors: dict[bool, TorchDetector], sent: str, rho: float, roi: Disc | None, looked: bool
) -> None:
    """A drone without a look of its own, as a ground station is, corrects those that it hears.

    However few cells came, it goes by all boxes of the sender's look, in the region where one was asked for. Pictures show all.
    """
    fleet = erring()
    alone = detectors[False].detect([(c, ()) for c in fleet])
    assert min(map(len, alone)) > 5
    fleet[0] = fleet[0]._replace(looked=looked)
    order = [1, 2, 0]  # peers first, as the detector has them: the sums are the same to the last digit
    region = None if sent == "raw" else roi
    seen = [sure(boxes).xy_m for boxes in (alone[1].inside(region), alone[2].inside(region), alone[0])]
    seen[2] = seen[2] if looked else seen[2][:0]
    fitted = matched_poses([fleet[k].est_pose for k in order], seen)
    corrected = [believing(fleet[k], tuple(fitted[order.index(k)].tolist())) for k in range(3)]
    wanted, got = found(detectors[False], corrected, sent, rho, roi), found(detectors[True], fleet, sent, rho, roi)
    np.testing.assert_allclose(got, wanted, atol=0.01)
    assert len(got) >= 5
    assert np.abs(got[:5, :2] - found(detectors[False], fleet, sent, rho, roi)[:5, :2]).max() > 0.02


def test_a_drone_that_hears_nobody_keeps_its_pose(detectors: dict[bool, TorchDetector]) -> None:
    ego = cross(10.0, 20.0, 0.3)[0]
    (plain,), (matched,) = (detectors[match].detect([(ego, ())]) for match in (False, True))
    np.testing.assert_array_equal(matched.table(), plain.table())
