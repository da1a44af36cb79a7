"""Fusion as a sortie flies it: the method by name, boxes joined late, late maps placed by the pose of then or of now."""

import numpy as np
import pytest
from perception_examples import cross

from sortie.perception.joining import LATE_MIN_SCORE, sendable
from sortie.perception.network.detector import SHIPPED_WEIGHTS, TorchDetector, shipped
from sortie.perception.network.fusion.base import Fusion
from sortie.perception.network.fusion.when2com import When2com
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.schema import Perception, Scene
from sortie.scenarios.shipped import NETWORKS


@pytest.fixture(scope="module")
def scene() -> SceneModel:
    return SceneModel(Scene(), None, (-50, -50, 50, 50))


@pytest.fixture(scope="module")
def fleet() -> list[Capture]:
    return cross(10.0, 20.0, 0.3)


def shares(captures: list[Capture], representation: str = "features", rho: float = 1.0) -> list[Share]:
    return [Share(c, representation, rho, None, 1.0) for c in captures]


def same(a: Boxes, b: Boxes) -> bool:
    return len(a) == len(b) and all(np.array_equal(getattr(a, f), getattr(b, f)) for f in Boxes.__slots__)


def test_none_is_a_drone_alone_and_late_joins_the_same_boxes_from_maps_as_from_boxes(
    scene: SceneModel, fleet: list[Capture]
) -> None:
    single = TorchDetector(scene, Perception(), seed=1).detect([(fleet[0], [])])[0]
    ignored = TorchDetector(scene, Perception(fusion="none"), seed=1).detect([(fleet[0], shares(fleet[1:]))])[0]
    assert same(ignored, single)
    late = TorchDetector(scene, Perception(fusion="late"), seed=1)
    whole, boxes, starved, mute = late.detect(
        [
            (fleet[0], shares(fleet[1:])),
            (fleet[0], shares(fleet[1:], "detections")),
            (fleet[0], shares(fleet[1:], rho=0.1)),
            (fleet[0], [Share(c, "features", 1.0, None, 0.0) for c in fleet[1:]]),
        ]
    )
    assert same(whole, boxes)
    assert len(whole) > len(single)
    assert not same(starved, whole)
    assert same(mute, single)


def test_a_handshake_weighs_what_arrives(
    scene: SceneModel, fleet: list[Capture], monkeypatch: pytest.MonkeyPatch
) -> None:
    detector, job = TorchDetector(scene, Perception(fusion="when2com"), seed=1), (fleet[0], shares(fleet[1:]))
    weighed = detector.detect([job])[0]
    monkeypatch.setattr(When2com, "weigh", Fusion.weigh)
    assert not same(detector.detect([job])[0], weighed)


def test_late_fusion_sends_what_is_sure() -> None:
    rows = np.array([(x, 0, 4.5, 1.85, 0.0, score) for x, score in ((0, 0.8), (60, 0.3), (90, LATE_MIN_SCORE))])
    assert sendable(Boxes.placed(rows, (0.0, 0.0, 0.0))).score.tolist() == pytest.approx([0.8, 0.3])


def test_late_fusion_pays_for_the_boxes_that_it_sends(scene: SceneModel, fleet: list[Capture]) -> None:
    late, other = (
        TorchDetector(scene, Perception(fusion=fusion, score_threshold=0.1), seed=1) for fusion in ("late", "disconet")
    )
    alone = late.detect([(fleet[1], [])])[0]
    for roi in (None, (10.0, 20.0, 40.0)):
        assert late.count_boxes(fleet[1], roi) == len(sendable(alone).inside(roi))
        assert other.count_boxes(fleet[1], roi) == len(alone.inside(roi)) > late.count_boxes(fleet[1], roi)


def test_averaged_late_fusion_knows_who_kept_something_back(scene: SceneModel, fleet: list[Capture]) -> None:
    """A raw map is whole whatever its directive's budget; a map that was lost on the way says nothing of any place."""
    late, peer = TorchDetector(scene, Perception(fusion="late", join="average"), seed=1), fleet[1]
    region, lost = (10.0, 20.0, 30.0), tuple(range(4096))
    single, whole, raw, aimed, nothing = late.detect(
        [
            (fleet[0], []),
            (fleet[0], shares([peer])),
            (fleet[0], shares([peer], "raw", rho=0.0)),
            (fleet[0], [Share(peer, "raw", 0.0, region, 1.0)]),
            (fleet[0], [Share(peer, "features", 1.0, None, 1.0, lost)]),
        ]
    )
    assert same(raw, whole)
    assert same(aimed, whole)
    assert not same(whole, single)
    assert same(nothing, single)


def test_weights_of_another_fusion_are_refused(scene: SceneModel) -> None:
    with pytest.raises(ValueError) as caught:
        TorchDetector(scene, Perception(fusion="v2vnet"), seed=1, weights=SHIPPED_WEIGHTS)
    assert str(caught.value) == (
        f"{SHIPPED_WEIGHTS}: made for fusion 'disconet', perception.fusion is 'v2vnet', must be the same"
    )
    assert shipped("late") == shipped("none") == shipped("disconet") == SHIPPED_WEIGHTS
    assert shipped("fcooper").name == "fcooper.safetensors"


@pytest.mark.parametrize("fusion", ["disconet", "v2vnet", "where2comm"])
def test_a_drone_without_a_look_fuses_its_peers_maps_alone(
    fusion: str, scene: SceneModel, fleet: list[Capture], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One whole map seen from the place where it was made is that drone's own; nothing is rendered for the ego."""
    peer, other = fleet[1], fleet[2]
    blind = peer._replace(drone=0, looked=False)
    coarse = NETWORKS / f"{fusion}.safetensors"  # a fine network also corrects each map that it receives
    detector = TorchDetector(scene, Perception(fusion=fusion), seed=1, weights=coarse)
    whole = Share(peer, "features", 1.0, None, 0.5)
    one, both, none, boxes, alone = detector.detect(
        [
            (blind, [whole]),
            (blind, [whole, Share(other, "features", 0.25, None, 1.0)]),
            (blind, []),
            (blind, shares([peer], "detections")),
            (peer, []),
        ]
    )
    np.testing.assert_allclose(one.table(), alone.table(), atol=1e-3)
    np.testing.assert_allclose(one.score, alone.score, atol=1e-4)
    assert same(boxes, alone)
    assert len(none) == 0
    assert len(both) > 0
    assert not same(both, one)
    assert blind not in detector._kept
