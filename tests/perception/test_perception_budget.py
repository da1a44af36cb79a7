"""Cells and bytes: closed forms, brute force, and the selection that must agree with the count."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sortie.perception import budget

rois = st.none() | st.tuples(st.floats(-150, 150), st.floats(-150, 150), st.floats(0.5, 200))
poses = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-4, 4))


def test_bytes_of_features_are_the_papers() -> None:
    """160 B a cell, and of an index a list or a bitmap, whichever is smaller, and none where all are sent."""
    content = {4096: 655_360, 1024: 163_840, 82: 13_120, 341: 54_560, 1: 160, 0: 0}
    assert {cells: budget.payload_bytes(cells) for cells in content} == content
    index = {0: 0, 1: 2, 2: 3, 81: 122, 82: 123, 340: 510, 341: 512, 342: 512, 1000: 512, 4095: 512, 4096: 0}
    assert {cells: budget.index_bytes(cells) for cells in index} == index
    assert {n: budget.content_bytes("features", cells=n) for n in index} == {n: 160 * n + index[n] for n in index}


def test_bytes_of_everything_else() -> None:
    """Codes have the index of features and 8 B of their codebook; several classes cost a byte a box."""
    assert [budget.boxes_sent("detections", n) for n in (5, 40)] == [5, 40]
    assert [budget.boxes_sent("tracks", n) for n in (5, 40)] == [5, 12]
    wanted = {"detections": 40 * 24, "uncertain_boxes": 40 * 36, "tracks": 40 * 20, "raw": 5_400_000}
    assert {name: budget.content_bytes(name, boxes=40) for name in wanted} == wanted
    for name in ("detections", "uncertain_boxes"):
        assert budget.content_bytes(name, boxes=40, classes=True) == wanted[name] + 40
    for length in (5, 20):
        assert budget.content_bytes("codes", cells=205, code_bytes=length) == 8 + 205 * length + 308
    assert budget.content_bytes("codes", cells=4096, code_bytes=10) == 8 + 40960
    message = "representation is 'none', must be features, codes, detections, uncertain_boxes, tracks or raw"
    with pytest.raises(ValueError, match=message):
        budget.content_bytes("none")


def test_a_disc_of_any_size_is_counted() -> None:
    """32 m about the drone are 314 of 4096 cells, give or take the raster; single precision may hold far more."""
    assert budget.cells_sent(1.0, (0, 0, 32.0), 0, 0, 0) == pytest.approx(math.pi * 32**2 / 3.2**2, abs=4)
    for radius_m in (1e5, 1e20, 3e38):
        assert budget.cells_sent(1.0, (7.0, -3.0, radius_m), 20.0, 5.0, 0.3) == 4096
        assert budget.cells_sent(1.0, (3e38, 0.0, radius_m / 2), 20.0, 5.0, 0.3) == 0
    assert budget.cells_sent(1.0, (1000, 0, 32), 0, 0, 0) == 0
    assert not budget.select(np.ones((64, 64)), 1.0, (1000, 0, 32), 0, 0, 0).any()


@settings(max_examples=60, deadline=None)
@given(roi=rois, pose=poses, rho=st.floats(0, 1), missing=st.sets(st.integers(0, 40)))
def test_count_and_selection_agree_with_brute_force(
    roi: tuple[float, float, float] | None, pose: tuple[float, float, float], rho: float, missing: set[int]
) -> None:
    """Cells in the region, best first, cut to the budget, less those that went missing by their rank."""
    x, y, yaw = pose
    rank = np.random.Generator(np.random.PCG64(1)).random((64, 64))
    inside = []
    for i in range(64):
        for j in range(64):
            f, s = (i + 0.5 - 32) * 3.2, (j + 0.5 - 32) * 3.2
            wx, wy = x + math.cos(yaw) * f - math.sin(yaw) * s, y + math.sin(yaw) * f + math.cos(yaw) * s
            if roi is None or math.hypot(wx - roi[0], wy - roi[1]) < roi[2] + 1e-6:
                inside.append((i, j))
    allowed = math.floor(rho * 4096 + 1e-9)
    best = sorted(inside, key=lambda c: -rank[c])[:allowed]
    assert budget.cells_sent(rho, roi, x, y, yaw) == len(best)
    assert budget.must_choose(rho, roi, x, y, yaw) == (allowed < len(inside))
    chosen = budget.select(rank, rho, roi, x, y, yaw, sorted(missing))
    arrived = {cell for place, cell in enumerate(best) if place not in missing}
    assert set(map(tuple, np.argwhere(chosen).tolist())) == arrived


def test_ties_go_to_the_lower_index() -> None:
    chosen = budget.select(np.zeros((64, 64)), 10 / 4096, None, 0, 0, 0)
    assert np.flatnonzero(chosen).tolist() == list(range(10))
