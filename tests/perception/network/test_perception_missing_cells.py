"""Cells that were sent and did not arrive: out of the choice, out of the fusion, for every detector."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from perception_examples import cross

from sortie.perception import budget
from sortie.perception.network.detector import TorchDetector
from sortie.perception.scene.scene_model import SceneModel
from sortie.perception.surrogate.detector import SurrogateDetector
from sortie.perception.types import Boxes, Share
from sortie.scenarios.schema import Perception, Scene

POSE = (0.0, 0.0, 0.3)
BOUNDS = (-50.0, -50.0, 50.0, 50.0)


@given(seed=st.integers(0, 99), missing=st.sets(st.integers(0, 408)))
def test_what_is_missing_is_taken_out_by_its_rank(seed: int, missing: set[int]) -> None:
    rank = np.random.default_rng(seed).random((64, 64))
    whole = budget.select(rank, 0.1, None, *POSE)
    part = budget.select(rank, 0.1, None, *POSE, missing=sorted(missing))
    assert not (part & ~whole).any()
    lost = np.sort(rank[whole & ~part])[::-1]
    np.testing.assert_array_equal(lost, np.sort(rank[whole])[::-1][sorted(missing)])


@pytest.fixture(scope="module", params=[TorchDetector, SurrogateDetector])
def detector(request: pytest.FixtureRequest) -> TorchDetector | SurrogateDetector:
    scene = SceneModel(Scene(), None, BOUNDS)
    return request.param(scene, Perception(), seed=3)  # type: ignore[no-any-return]


def found(detector: TorchDetector | SurrogateDetector, rho: float, missing: tuple[int, ...]) -> Boxes:
    fleet = cross(10.0, 20.0, 0.3)
    return detector.detect([(fleet[0], [Share(c, "features", rho, None, 1.0, missing) for c in fleet[1:]])])[0]


def same(a: Boxes, b: Boxes) -> bool:
    return len(a) == len(b) and all(np.array_equal(getattr(a, f), getattr(b, f)) for f in Boxes.__slots__)


@pytest.mark.slow
@pytest.mark.parametrize("rho", [1.0, 0.1])
def test_the_first_cells_of_a_map_are_a_smaller_budget(detector: TorchDetector | SurrogateDetector, rho: float) -> None:
    sent = int(rho * budget.CELLS)
    few = found(detector, 205 / budget.CELLS, ())
    assert same(found(detector, rho, tuple(range(205, sent))), few)
    assert not same(found(detector, rho, ()), few)


@pytest.mark.slow
def test_lost_cells_cost_boxes_or_scores(detector: TorchDetector | SurrogateDetector) -> None:
    whole, half = found(detector, 0.1, ()), found(detector, 0.1, tuple(range(0, 409, 2)))
    assert not same(whole, half)
