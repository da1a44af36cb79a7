"""`perception.match_poses` in a sortie's detector: it fuses as if drones had believed the corrected poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from perception_examples import cross

from sortie.perception.errors import InputError
from sortie.perception.network.detector import TorchDetector
from sortie.perception.pose_matching import matched_poses, sure
from sortie.perception.recordings.detector import RecordedDetector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.types import Capture, Share
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


def found(scene: SceneModel, captures: list[Capture], match: bool, representation: str) -> np.ndarray:
    """Boxes and scores of the first drone, which hears the others."""
    detector = TorchDetector(scene, Perception(match_poses=match), 1, FINE)
    ego, *peers = captures
    (boxes,) = detector.detect([(ego, [Share(c, representation, 1.0, None, 1.0) for c in peers])])
    return np.column_stack([boxes.table(), boxes.score])


@pytest.mark.parametrize("looked", [True, False])
@pytest.mark.parametrize("representation", ["features", "detections", "uncertain_boxes"])
def test_it_fuses_as_if_drones_had_believed_the_corrected_poses(representation: str, looked: bool) -> None:
    """A drone without a look of its own, as a ground station is, corrects those that it hears."""
    scene, fleet = SceneModel(Scene(), None, (-50, -50, 50, 50)), erring()
    alone = TorchDetector(scene, Perception(), 1, FINE).detect([(c, ()) for c in fleet])
    assert min(map(len, alone)) > 5
    fleet[0] = fleet[0]._replace(looked=looked)
    order = [1, 2, 0]  # peers first, as the detector has them: the sums are the same to the last digit
    seen = [sure(alone[k]).xy_m[: None if fleet[k].looked else 0] for k in order]
    fitted = matched_poses([fleet[k].est_pose for k in order], seen)
    corrected = [believing(fleet[k], tuple(fitted[order.index(k)].tolist())) for k in range(3)]
    wanted, got = found(scene, corrected, False, representation), found(scene, fleet, True, representation)
    np.testing.assert_allclose(got, wanted, atol=0.01)
    assert len(got) > 5
    assert np.abs(got[:5, :2] - found(scene, fleet, False, representation)[:5, :2]).max() > 0.02


def test_maps_that_came_as_codes_are_matched_by_the_boxes_in_them() -> None:
    """Codes of full length are nearly the features: so are the poses that fit."""
    scene, fleet = SceneModel(Scene(), None, (-50, -50, 50, 50)), erring()
    features, codes = (found(scene, fleet, True, way)[:20] for way in ("features", "codes"))
    plain = found(scene, fleet, False, "codes")[:20]

    def off_m(others: np.ndarray) -> float:
        away = np.linalg.norm(features[:, None, :2] - others[None, :, :2], axis=2).min(axis=1)
        return float(np.median(away))

    assert off_m(codes) < 0.1
    assert off_m(plain) > 2 * off_m(codes)


def test_a_drone_that_hears_nobody_keeps_its_pose() -> None:
    scene = SceneModel(Scene(), None, (-50, -50, 50, 50))
    ego = cross(10.0, 20.0, 0.3)[0]
    (plain,), (matched,) = (
        TorchDetector(scene, Perception(match_poses=match), 1, FINE).detect([(ego, ())]) for match in (False, True)
    )
    np.testing.assert_array_equal(matched.table(), plain.table())


@pytest.mark.parametrize(
    ("option", "value", "shown", "usual"),
    [
        ("match_poses", True, "true", "false"),
        ("maps_bring_boxes", True, "true", "false"),
        ("fused_grids", "all", "'all'", "own"),
    ],
)
def test_the_surrogate_and_recordings_refuse_it(option: str, value: object, shown: str, usual: str) -> None:
    """Also where a configuration was changed after it was read, as comparisons by several detectors do."""
    scene, on = SceneModel(Scene(), None, (-50, -50, 50, 50)), {option: value}
    recorded = Perception.model_validate({"detector": "recorded", "recording": "seen.npz"})
    with pytest.raises(InputError, match=rf"perception.{option} is {shown}: .* calibrated without it, must be {usual}"):
        SurrogateDetector(scene, Perception(detector="surrogate").model_copy(update=on), 1)
    with pytest.raises(InputError, match=rf"perception\.{option} is {shown}, must be {usual} for a recording"):
        RecordedDetector(recorded.model_copy(update=on))
