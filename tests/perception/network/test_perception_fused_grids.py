"""`perception.fused_grids`: maps are fused on the grid of each drone that sent one, too, and the boxes of all grids are joined."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from perception_examples import cross

from sortie.perception.joining import EgoSources, SourceBoxes, joined_many
from sortie.perception.network.detector import TorchDetector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.disc import Disc
from sortie.scenarios.schema import Perception, Scene

SCENE = SceneModel(Scene(), None, (-50, -50, 50, 50))
FINE = Path("fine.safetensors")
EGO, *PEERS = cross(10.0, 20.0, 0.3)[:3]


def found(grids: str, shares: list[Share], ego: Capture = EGO, **options: object) -> Boxes:
    config = Perception.model_validate({"fused_grids": grids, **options})
    (boxes,) = TorchDetector(SCENE, config, 1, FINE).detect([(ego, shares)])
    return boxes


def same(a: Boxes, b: Boxes) -> bool:
    return len(a) == len(b) and np.allclose(a.table(), b.table()) and np.allclose(a.score, b.score)


@pytest.mark.parametrize("roi", [None, Disc(5.0, -5.0, 40.0)])
@pytest.mark.parametrize("rho", [1.0, 0.1])
@pytest.mark.parametrize("looked", [True, False])
def test_a_peers_grid_is_that_of_a_drone_there_without_a_look(rho: float, roi: Disc | None, looked: bool) -> None:
    """Such a drone hears the peer first and the ego too. The boxes of a grid count as its sender's link does."""
    ego = EGO._replace(looked=looked)
    shares = [Share(c, "features", rho, roi, weight) for c, weight in zip(PEERS, (1.0, 0.6), strict=True)]
    whole = [Share(ego, "features", 1.0, None, 1.0)] if looked else []
    sources = [SourceBoxes(found("own", shares, ego), 2.0, ego.est_pose)]
    for k, peer in enumerate(PEERS):
        others = [shares[k], *whole, *shares[:k], *shares[k + 1 :]]
        boxes = found("own", others, peer._replace(looked=False))
        sources.append(SourceBoxes(boxes, shares[k].weight, peer.est_pose))
    (wanted,) = joined_many([EgoSources(ego.est_pose, Boxes.empty(), False, sources, looked=False)], "average")
    got = found("all", shares, ego)
    assert same(got, wanted)
    assert not same(got, sources[0].boxes)


def test_a_link_without_weight_gives_no_grid() -> None:
    shares = [Share(PEERS[0], "features", 1.0, None, 1.0), Share(PEERS[1], "features", 1.0, None, 0.0)]
    assert same(found("all", shares), found("all", shares[:1]))


@pytest.mark.parametrize("representation", ["codes", "raw"])
def test_codes_and_images_are_fused_on_all_grids_too(representation: str) -> None:
    shares = [Share(c, representation, 1.0, None, 1.0) for c in PEERS]
    assert not same(found("all", shares), found("own", shares))


def test_poses_are_corrected_before() -> None:
    shares = [Share(c, "features", 1.0, None, 1.0) for c in PEERS]
    matched = found("all", shares, match_poses=True)
    assert not same(matched, found("all", shares))
    assert not same(matched, found("own", shares, match_poses=True))


@pytest.mark.parametrize("fusion", ["late", "none"])
def test_without_fused_maps_nothing_changes(fusion: str) -> None:
    shares = [Share(c, "features", 1.0, None, 1.0) for c in PEERS]
    assert same(found("all", shares, fusion=fusion), found("own", shares, fusion=fusion))


def test_boxes_that_came_are_joined_as_well() -> None:
    shares = [Share(PEERS[0], "features", 1.0, None, 1.0), Share(PEERS[1], "detections", 1.0, None, 1.0)]
    assert not same(found("all", shares), found("all", shares[:1]))
