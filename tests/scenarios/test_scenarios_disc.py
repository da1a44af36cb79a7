"""Overlap of two discs against closed forms and shapely, and the order of peers by it."""

from __future__ import annotations

import math

import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from sortie.scenarios.disc import disc_overlap, rank_by_overlap


@pytest.mark.parametrize(
    ("distance_m", "expected"), [(0.0, 1.0), (84.0, 0.0), (100.0, 0.0), (42.0, 2 / 3 - 3**0.5 / (2 * math.pi))]
)
def test_closed_forms_of_equal_discs(distance_m: float, expected: float) -> None:
    """Equal circles one radius apart share 2/3 − √3/(2π) of their area."""
    assert disc_overlap(distance_m, 42.0, 42.0) == pytest.approx(expected, abs=1e-12)


def test_the_share_is_of_the_first_disc() -> None:
    assert disc_overlap(5.0, 10.0, 42.0) == 1.0
    assert disc_overlap(5.0, 42.0, 10.0) == pytest.approx((10 / 42) ** 2)
    assert disc_overlap(5.0, 0.0, 42.0) == disc_overlap(5.0, 42.0, 0.0) == 0.0


@given(st.floats(0, 130), st.floats(20, 60), st.floats(20, 60))
def test_any_two_discs_are_shapelys(distance_m: float, a_m: float, b_m: float) -> None:
    a = shapely.Point(0, 0).buffer(a_m, quad_segs=256)
    b = shapely.Point(distance_m, 0).buffer(b_m, quad_segs=256)
    assert disc_overlap(distance_m, a_m, b_m) == pytest.approx(a.intersection(b).area / a.area, abs=2e-4)


def test_peers_go_by_tenths_of_overlap_and_then_round_by_id() -> None:
    assert rank_by_overlap(1, {0: 0.52, 2: 0.81, 3: 0.46, 4: 0.5}) == [2, 3, 4, 0]
