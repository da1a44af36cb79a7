"""Places: overlap of two discs against closed forms and shapely, the order of peers by it, and formations."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from sortie.scenarios.disc import AGENT_IDS, disc_overlap, rank_by_overlap
from sortie.scenarios.formation import slots

GROWING = ["cross", "line", "wedge", "grid"]
R, ROUND = 20 / np.sqrt(2), 40 / np.pi
BY_HAND: dict[str, list[tuple[float, float]]] = {
    "cross": [(0, 0), (20, 0), (0, 20), (-20, 0), (0, -20), (40, 0), (0, 40)],
    "line": [(0, 0), (0, 20), (0, -20), (0, 40), (0, -40)],
    "wedge": [(0, 0), (-R, R), (-R, -R), (-2 * R, 2 * R), (-2 * R, -2 * R)],
    "grid": [(0, 0), (20, 0), (20, 20), (0, 20), (-20, 20), (-20, 0), (-20, -20), (0, -20), (20, -20), (40, -20)],
    "circle": [(ROUND, 0), (0, ROUND), (-ROUND, 0), (0, -ROUND)],
}


def test_closed_forms_of_overlap() -> None:
    """Equal circles one radius apart share 2/3 − √3/(2π) of their area. The share is of the first disc."""
    for distance_m, expected in ((0.0, 1.0), (84.0, 0.0), (100.0, 0.0), (42.0, 2 / 3 - 3**0.5 / (2 * math.pi))):
        assert disc_overlap(distance_m, 42.0, 42.0) == pytest.approx(expected, abs=1e-12)
    assert disc_overlap(5.0, 10.0, 42.0) == 1.0
    assert disc_overlap(5.0, 42.0, 10.0) == pytest.approx((10 / 42) ** 2)
    assert disc_overlap(5.0, 0.0, 42.0) == disc_overlap(5.0, 42.0, 0.0) == disc_overlap(0.0, 0.0, 42.0) == 0.0


@given(st.floats(0, 130), st.floats(20, 60), st.floats(20, 60))
def test_any_two_discs_are_shapelys(distance_m: float, a_m: float, b_m: float) -> None:
    a = shapely.Point(0, 0).buffer(a_m, quad_segs=256)
    b = shapely.Point(distance_m, 0).buffer(b_m, quad_segs=256)
    assert disc_overlap(distance_m, a_m, b_m) == pytest.approx(a.intersection(b).area / a.area, abs=2e-4)


def test_peers_go_by_tenths_of_overlap_and_then_round_by_id() -> None:
    assert rank_by_overlap(1, {0: 0.52, 2: 0.81, 3: 0.46, 4: 0.5}) == [2, 3, 4, 0]
    for ego in (0, 2, 4, 200):
        peers = [p for p in (0, 1, 2, 3, 4, 200, 255) if p != ego]
        assert rank_by_overlap(ego, dict.fromkeys(peers, 0.5)) == sorted(peers, key=lambda p: (p - ego) % AGENT_IDS)


def test_slots_by_hand() -> None:
    for shape, expected in BY_HAND.items():
        np.testing.assert_allclose(slots(shape, len(expected), 20.0), expected, atol=1e-12, err_msg=shape)
        assert slots(shape, 1, 20.0).tolist() == [[0.0, 0.0]], "one drone flies at the reference point"


def test_adding_drones_moves_nobody() -> None:
    for shape in GROWING:
        everyone = slots(shape, 200, 15.0)
        assert all(np.array_equal(slots(shape, n, 15.0), everyone[:n]) for n in range(1, 200, 3)), shape


@given(st.sampled_from(GROWING), st.integers(2, 120), st.floats(0.5, 500))
def test_neighbours_keep_the_spacing(shape: str, n: int, spacing_m: float) -> None:
    assert pdist(slots(shape, n, spacing_m)).min() == pytest.approx(spacing_m)


def test_an_odd_square_number_makes_a_full_centred_grid() -> None:
    for half in (0, 1, 2, 3):
        square = {(float(x), float(y)) for x in range(-half, half + 1) for y in range(-half, half + 1)}
        assert {(x, y) for x, y in slots("grid", (2 * half + 1) ** 2, 1.0).tolist()} == square


@pytest.mark.parametrize("n", [2, 3, 10, 50])
def test_circle_has_the_spacing_along_the_arc(n: int) -> None:
    s = slots("circle", n, 20.0)
    radius = np.hypot(s[:, 0], s[:, 1])
    np.testing.assert_allclose(radius, n * 20 / (2 * np.pi))
    gaps = np.diff(np.unwrap(np.arctan2(s[:, 1], s[:, 0])), append=2 * np.pi)
    np.testing.assert_allclose(gaps * radius, 20.0)


def test_nonsense_is_refused() -> None:
    for arguments, message in (
        (("blob", 5, 20.0), "shape is 'blob', must be one of ['cross', 'line', 'wedge', 'grid', 'circle']"),
        (("cross", 0, 20.0), "n is 0, must be at least 1"),
        (("cross", 5, 0.0), "spacing_m is 0.0, must be > 0"),
        (("cross", 5, float("nan")), "spacing_m is nan, must be > 0"),
    ):
        with pytest.raises(ValueError) as caught:
            slots(*arguments)
        assert str(caught.value) == message
