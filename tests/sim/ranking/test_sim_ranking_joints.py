"""How many further draws a ranking by torch takes, and where labels of its figure stand."""

from __future__ import annotations

import pytest

from sortie.sim.folders import RunError
from sortie.sim.ranking.board import _spread
from sortie.sim.ranking.rank import FURTHER, SUITE, _further

pytestmark = pytest.mark.slow


def test_as_many_draws_are_further_ones_as_are_asked_for_also_none() -> None:
    assert _further(SUITE, 0) == []
    assert len(_further(SUITE, 2)) == 60
    assert len(_further(SUITE, None)) == 30 * FURTHER
    assert _further("mine.yaml", None) == _further("mine.yaml", 0) == []
    with pytest.raises(RunError, match="no further draws of it"):
        _further("mine.yaml", 2)


@pytest.mark.parametrize(
    ("heights", "labels"),
    [
        ([0.9, 0.5, 0.1], [0.9, 0.5, 0.1]),
        ([0.5, 0.49, 0.48], [0.5, 0.4, 0.3]),
        ([0.9, 0.05, 0.02], [0.9, 0.1, 0.0]),  # what would be pushed below the axes goes up again
        ([], []),
    ],
)
def test_labels_stand_apart_and_within_the_axes(heights: list[float], labels: list[float]) -> None:
    assert _spread(heights, 0.1) == pytest.approx(labels)
