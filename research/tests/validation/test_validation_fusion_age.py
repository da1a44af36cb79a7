"""Fusion as a sortie flies it: the method by name, boxes joined late, late maps placed by the pose of then or of now."""

import re

import numpy as np
import pytest
from perception_examples import capture, cross

from research.validation.fusion_age import earlier, measure
from sortie.perception.lateness import map_weight
from sortie.perception.network.detector import SHIPPED_WEIGHTS, TorchDetector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.types import Boxes, Capture, Share
from sortie.scenarios.schema import Perception, Scene


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


def test_a_late_map_lies_where_its_sender_was_or_is(scene: SceneModel, fleet: list[Capture]) -> None:
    now = fleet[:2]
    then = earlier(fleet[1], 0.5, 10.0)
    jobs = [(now[0], shares([then])), (now[1], [])]
    compensated = TorchDetector(scene, Perception(), seed=1).detect(jobs)[0]
    ignored = TorchDetector(scene, Perception(motion_compensation=False), seed=1)
    assert not same(ignored.detect(jobs)[0], compensated)
    assert same(ignored.detect(jobs[:1])[0], compensated)  # nobody knows where the sender is now
    fresh = [(now[0], shares([now[1]])), (now[1], [])]
    assert same(ignored.detect(fresh)[0], TorchDetector(scene, Perception(), seed=1).detect(fresh)[0])


def test_earlier_is_where_a_straight_flight_was() -> None:
    c = capture(100.0, 50.0, yaw=np.pi / 2, t_s=20.0, est=(100.5, 49.0, 60.0, 1.5))
    was = earlier(c, 0.5, 10.0)
    assert was.t_s == 19.5
    assert was.position_m == pytest.approx((100.0, 45.0, 60.0))
    assert was.est_position_m == pytest.approx((100.5, 44.0, 60.0))
    assert (was.orientation_xyzw, was.est_yaw_rad) == (c.orientation_xyzw, c.est_yaw_rad)


def test_ages_begin_fresh() -> None:
    from sortie.perception.network.checkpoint import load_weights

    with pytest.raises(ValueError, match=re.escape("ages_s is (0.1,), must begin with 0 and hold no negative age")):
        measure(load_weights(SHIPPED_WEIGHTS), ages_s=(0.1,))


@pytest.mark.slow
def test_compensation_gains() -> None:
    from sortie.perception.network.checkpoint import load_weights

    fresh, late = measure(load_weights(SHIPPED_WEIGHTS), scenes=2, frames=1, ages_s=(0.0, 0.5))
    assert fresh.gain.delta == 0.0
    assert late.gain.delta > 0.05
    assert late.gain.ap_b < fresh.gain.ap_b


def test_a_late_map_counts_less(scene: SceneModel, fleet: list[Capture]) -> None:
    late = [Share(earlier(c, 0.3, 5.0), "features", 1.0, None, 1.0) for c in fleet[1:]]
    detector = TorchDetector(scene, Perception(), seed=1)
    ageless, aged, weak = detector.detect(
        [
            (fleet[0], late),
            (fleet[0], [s._replace(age_s=0.395) for s in late]),
            (fleet[0], [s._replace(weight=map_weight(0.395, 0.095)) for s in late]),
        ]
    )
    assert not same(aged, ageless)
    np.testing.assert_allclose(aged.score, weak.score, atol=1e-5)
