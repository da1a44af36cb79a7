"""Cells and bytes: closed forms, brute force, and the selection that must agree with the count."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sortie.perception import budget

rois = st.none() | st.tuples(st.floats(-150, 150), st.floats(-150, 150), st.floats(0.5, 200))
poses = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-4, 4))


@pytest.mark.parametrize(
    ("cells", "content", "index"),
    [(4096, 655_360, 0), (1024, 163_840, 512), (82, 13_120, 123), (341, 54_560, 512), (1, 160, 2), (0, 0, 0)],
)
def test_bytes_are_the_papers(cells: int, content: int, index: int) -> None:
    assert budget.payload_bytes(cells) == content
    assert budget.index_bytes(cells) == index
    assert budget.content_bytes("features", cells=cells) == content + index


def test_bytes_of_boxes_and_tracks() -> None:
    assert [budget.boxes_sent("detections", n) for n in (5, 40)] == [5, 40]
    assert [budget.boxes_sent("tracks", n) for n in (5, 40)] == [5, 12]
    assert budget.content_bytes("detections", boxes=40) == 960
    assert budget.content_bytes("tracks", boxes=12) == 240
    assert budget.content_bytes("raw") == 5_400_000
    with pytest.raises(
        ValueError,
        match=r"representation is 'none', must be features, codes, detections, uncertain_boxes, tracks or raw",
    ):
        budget.content_bytes("none")


def test_the_mission_disc_is_314_cells() -> None:
    """FACTS of the paper: a 32 m disc about the drone is 314 of 4096 cells (7.7 %), give or take the raster."""
    assert budget.cells_sent(1.0, (0, 0, 32.0), 0, 0, 0) == pytest.approx(math.pi * 32**2 / 3.2**2, abs=4)


@pytest.mark.parametrize("radius_m", [1e5, 1e20, 3e38])
def test_a_disc_of_any_size_holds_all_cells(radius_m: float) -> None:
    """A directive's region may be as large as single precision has numbers."""
    assert budget.cells_sent(1.0, (7.0, -3.0, radius_m), 20.0, 5.0, 0.3) == 4096
    assert budget.cells_sent(1.0, (3e38, 0.0, radius_m / 2), 20.0, 5.0, 0.3) == 0


@settings(max_examples=60, deadline=None)
@given(roi=rois, pose=poses, rho=st.floats(0, 1))
def test_count_and_selection_agree_with_brute_force(
    roi: tuple[float, float, float] | None, pose: tuple[float, float, float], rho: float
) -> None:
    x, y, yaw = pose
    rank = np.random.Generator(np.random.PCG64(1)).random((64, 64))
    inside = []
    for i in range(64):
        for j in range(64):
            f, s = (i + 0.5 - 32) * 3.2, (j + 0.5 - 32) * 3.2
            wx, wy = x + math.cos(yaw) * f - math.sin(yaw) * s, y + math.sin(yaw) * f + math.cos(yaw) * s
            if (
                roi is None
                or abs(math.hypot(wx - roi[0], wy - roi[1]) - roi[2]) < 1e-6
                or math.hypot(wx - roi[0], wy - roi[1]) < roi[2]
            ):
                inside.append((i, j))
    count = min(math.floor(rho * 4096 + 1e-9), len(inside))
    assert budget.cells_sent(rho, roi, x, y, yaw) == pytest.approx(count, abs=0)
    best = sorted(inside, key=lambda c: -rank[c])[:count]
    chosen = budget.select(rank, rho, roi, x, y, yaw)
    assert set(map(tuple, np.argwhere(chosen).tolist())) == set(best)


def test_ties_go_to_the_lower_index() -> None:
    chosen = budget.select(np.zeros((64, 64)), 10 / 4096, None, 0, 0, 0)
    assert np.flatnonzero(chosen).tolist() == list(range(10))


def test_a_disc_out_of_reach_sends_nothing() -> None:
    assert budget.cells_sent(1.0, (1000, 0, 32), 0, 0, 0) == 0
    assert not budget.select(np.ones((64, 64)), 1.0, (1000, 0, 32), 0, 0, 0).any()
