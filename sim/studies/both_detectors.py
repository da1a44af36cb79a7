"""Sorties with the traffic of the surrogate whose boxes are the torch detector's."""

from __future__ import annotations

from pathlib import Path

from sortie.perception.detectors import Constructor, Detector
from sortie.perception.scene.scene_model import SceneModel
from sortie.scenarios.schema import Perception


class BothDetectors:
    """The torch detector's boxes, and the traffic of the surrogate: its guess of how many a drone would send, and its tracks."""

    name = "torch, with the traffic of the surrogate"

    def __init__(self, torch: Detector, surrogate: Detector) -> None:
        self.detect, self.truth = torch.detect, torch.truth
        self.count_boxes, self.camera_views = surrogate.count_boxes, torch.camera_views
        self.looks = surrogate


def torch_answers(calibration: Path | None = None, weights: Path | None = None) -> Constructor:
    """What makes a sortie's detector so that its traffic is the surrogate's and its boxes are the torch detector's, which is
    asked at scored moments alone. None takes what is shipped.

    Sorties that are made one after the other in one scene, under several policies, share the torch detector, its scenery
    and what it has encoded.
    """
    from sortie.perception.network.detector import TorchDetector  # here: torch takes a second to import

    ours = surrogate_of(calibration)
    last: list[tuple[object, Detector]] = []

    def make(scene: SceneModel, config: Perception, seed: int, replication: int) -> Detector:
        key = scene.made_of, config, seed, replication
        if not last or last[0][0] != key:
            last[:] = [(key, TorchDetector(scene, config, seed, weights, replication))]
        return BothDetectors(last[0][1], ours(scene, config, seed, replication))

    return make


def surrogate_of(calibration: Path | None) -> Constructor:
    """What makes a sortie's surrogate, with a calibration or the shipped one."""
    from sortie.perception.surrogate.detector import SurrogateDetector

    def make(scene: SceneModel, config: Perception, seed: int, replication: int) -> Detector:
        return SurrogateDetector(scene, config, seed, calibration, replication)

    return make
