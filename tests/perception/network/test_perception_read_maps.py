"""`perception.read_maps`: the boxes of fused maps are joined with those that are found in each received map alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from perception_examples import cross

from sortie.perception import budget
from sortie.perception.joining import EgoSources, SourceBoxes, joined_many
from sortie.perception.network.detector import LEAST_READ, TorchDetector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Perception, Scene

SCENE = SceneModel(Scene(), None, (-50, -50, 50, 50))
FINE = Path("fine.safetensors")
EGO, *PEERS = cross(10.0, 20.0, 0.3)[:3]


def detector(read: bool) -> TorchDetector:
    return TorchDetector(SCENE, Perception(read_maps=read), 1, FINE)


def found(read: bool, shares: list[Share], ego: Capture = EGO) -> Boxes:
    (boxes,) = detector(read).detect([(ego, shares)])
    return boxes


def same(a: Boxes, b: Boxes) -> bool:
    return len(a) == len(b) and np.allclose(a.table(), b.table()) and np.allclose(a.score, b.score)


@pytest.mark.parametrize("representation", ["features", "raw"])
@pytest.mark.parametrize("looked", [True, False])
def test_boxes_of_all_maps_together_weigh_as_much_as_those_of_each(representation: str, looked: bool) -> None:
    ego = EGO._replace(looked=looked)
    shares = [Share(c, representation, 1.0, None, 1.0) for c in PEERS]
    fused = found(False, shares, ego)
    alone = [SourceBoxes(found(False, [], c), 1.0, c.est_pose) for c in PEERS]
    own = SourceBoxes(fused, 3.0, ego.est_pose)
    (wanted,) = joined_many([EgoSources(ego.est_pose, Boxes.empty(), False, [own, *alone], looked=False)], "average")
    got = found(True, shares, ego)
    assert same(got, wanted)
    assert not same(got, fused)


def test_a_link_without_weight_is_not_read() -> None:
    shares = [Share(c, "features", 1.0, None, 0.0) for c in PEERS]
    assert same(found(True, shares), found(False, []))


@pytest.mark.parametrize("roi", [None, Disc(5.0, -5.0, 40.0)])
def test_maps_of_which_little_came_are_not_read(roi: Disc | None) -> None:
    """A fifth of the cells, or of those in the region, must be there, whether others were not sent or were lost."""
    pose = PEERS[0].est_pose
    whole = budget.cells_sent(1.0, roi, *pose)
    least = int(np.ceil(LEAST_READ * whole))

    def reads(rho: float, lost: int = 0) -> bool:
        shares = [Share(PEERS[0], "features", rho, roi, 1.0, tuple(range(whole - lost, whole)))]
        return not same(found(True, shares), found(False, shares))

    share = least / 4096 + 1e-9
    assert reads(share)
    assert not reads(share - 1 / 4096)
    assert reads(1.0, whole - least)
    assert not reads(1.0, whole - least + 1)


def test_codes_are_read_too() -> None:
    shares = [Share(c, "codes", 1.0, None, 1.0) for c in PEERS]
    assert not same(found(True, shares), found(False, shares))


def test_late_fusion_has_nothing_more_to_read() -> None:
    shares = [Share(c, "features", 1.0, None, 1.0) for c in PEERS]

    def late(read: bool) -> Boxes:
        (boxes,) = TorchDetector(SCENE, Perception(fusion="late", read_maps=read), 1, FINE).detect([(EGO, shares)])
        return boxes

    assert same(late(True), late(False))
