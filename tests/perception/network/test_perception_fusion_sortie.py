"""Fusion as a sortie flies it: by name, late, for drones without a look, and by corrected poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from perception_examples import boxes_at, capture, cross, same

from sortie.perception.joining import LATE_MIN_SCORE, sendable
from sortie.perception.network.detector import SHIPPED_WEIGHTS, TorchDetector, shipped
from sortie.perception.network.fused import Peer, fused_map
from sortie.perception.network.fusion.base import Fusion
from sortie.perception.network.fusion.when2com import When2com
from sortie.perception.network.model import CarNet, ModelConfig
from sortie.perception.pose_matching import matched_poses, sure
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Capture, Share
from sortie.policies.contract import Disc
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


def test_late_fusion_sends_what_is_sure_and_pays_for_that(scene: SceneModel, fleet: list[Capture]) -> None:
    rows = boxes_at((0, 0, 0.8), (60, 0, 0.3), (90, 0, LATE_MIN_SCORE))
    assert sendable(rows).score.tolist() == pytest.approx([0.8, 0.3])
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
    with pytest.raises(
        ValueError, match=r"made for fusion 'disconet', perception.fusion is 'v2vnet', must be the same"
    ):
        TorchDetector(scene, Perception(fusion="v2vnet"), seed=1, weights=SHIPPED_WEIGHTS)
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


# --- by hand, with the maximum as the fusion ------------------------------------------------------------

POSE = (300.0, -40.0, 0.0)
ALL, NONE = torch.ones(64, 64, dtype=torch.bool), torch.zeros(64, 64, dtype=torch.bool)


def peer(weight: float, value: float, sent: torch.Tensor = ALL) -> Peer:
    """At the ego's own pose, saying the same in every cell."""
    return Peer(POSE, weight, torch.full((80, 64, 64), value), sent)


@pytest.mark.parametrize("turn", [1, -1])
def test_without_a_look_the_peer_that_counts_most_leads_and_the_others_follow(turn: int) -> None:
    """Weights are relative to the largest: a peer of half of it takes the map half of the way up."""
    with torch.inference_mode():
        net = CarNet(ModelConfig(fusion="fcooper")).eval()
        half = torch.zeros(64, 64, dtype=torch.bool)
        half[:32] = True
        peers = [peer(0.5, 1.0, half), peer(0.25, 3.0)][::turn]
        masked = fused_map(net, POSE, None, peers, "masked")
        zero = fused_map(net, POSE, None, peers, "zero")
        nobody = fused_map(net, POSE, None, [peer(0.5, 1.0, NONE)], "masked")
    assert nobody is None
    for found in (masked, zero):
        assert found is not None
        assert found[0, :, :32].unique().tolist() == pytest.approx([1.0 + 0.5 * (3.0 - 1.0)])
        # who sent nothing of a cell does not lead there, however much it counts
        assert found[0, :, 32:].unique().tolist() == pytest.approx([3.0])


FINE = Path("fine.safetensors")
REGION = Disc(5.0, 5.0, 40.0)


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
        ("features", 1.0, None, True),
        ("features", 1.0, REGION, False),
        ("features", 0.02, None, False),
        ("codes", 0.02, None, True),
        ("raw", 0.0, REGION, True),
        ("detections", 0.0, None, True),
        ("uncertain_boxes", 0.0, None, False),
    ],
)
def test_it_fuses_as_if_drones_had_believed_the_corrected_poses(
    detectors: dict[bool, TorchDetector], sent: str, rho: float, roi: Disc | None, looked: bool
) -> None:
    """A drone without a look of its own, as a ground station is, corrects those that it hears.

    However few cells came, it goes by all boxes of the sender's look, in the region if one was asked for.
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
