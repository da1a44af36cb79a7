"""What a drone without a look of its own has of the surrogate's boxes: where maps were asked for."""

from __future__ import annotations

import numpy as np
import pytest
from perception_examples import capture

from sortie.perception.surrogate.exchange import received_only
from sortie.perception.types import Boxes, Share
from sortie.scenarios.disc import Disc

NEAR, ASIDE = Disc(0.0, 0.0, 10.0), Disc(60.0, 0.0, 10.0)


@pytest.mark.parametrize(
    ("shares", "left"),
    [
        ([("features", NEAR, 1.0)], [0]),
        ([("features", NEAR, 1.0), ("features", ASIDE, 1.0)], [0, 60]),
        ([("features", NEAR, 1.0), ("features", ASIDE, 0.0)], [0]),
        ([("features", NEAR, 1.0), ("detections", None, 1.0)], [0]),
        ([("features", None, 1.0)], [0, 30, 60]),
        ([("raw", NEAR, 1.0)], [0, 30, 60]),  # an image is sent whole, whatever region is asked for
        ([("raw", None, 0.0)], []),
        ([], []),
    ],
)
def test_boxes_lie_where_a_map_that_counts_was_asked_for_and_in_the_own_square(
    shares: list[tuple[str, Disc | None, float]], left: list[int]
) -> None:
    table = np.array([(x, 0.0, 4.5, 1.9, 0.0, 0.5) for x in (0, 30, 60, 150)], float)
    boxes = Boxes.placed(table, (0.0, 0.0, 0.0))
    given = [Share(capture(20.0, drone=1), what, 1.0, roi, weight) for what, roi, weight in shares]
    assert received_only(boxes, capture()._replace(looked=False), given).xy_m[:, 0].tolist() == left
