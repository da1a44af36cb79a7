"""Formations: the shapes, their spacing, and that adding a drone moves nobody."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from sortie.scenarios.formation import slots

GROWING = ["cross", "line", "wedge", "grid"]
SHAPES = [*GROWING, "circle"]
R = 20 / np.sqrt(2)


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ("cross", [(0, 0), (20, 0), (0, 20), (-20, 0), (0, -20), (40, 0), (0, 40)]),
        ("line", [(0, 0), (0, 20), (0, -20), (0, 40), (0, -40)]),
        ("wedge", [(0, 0), (-R, R), (-R, -R), (-2 * R, 2 * R), (-2 * R, -2 * R)]),
        ("grid", [(0, 0), (20, 0), (20, 20), (0, 20), (-20, 20), (-20, 0), (-20, -20), (0, -20), (20, -20), (40, -20)]),
        ("circle", [(80 / 2 / np.pi, 0), (0, 80 / 2 / np.pi), (-80 / 2 / np.pi, 0), (0, -80 / 2 / np.pi)]),
    ],
)
def test_slots_by_hand(shape: str, expected: list[tuple[float, float]]) -> None:
    np.testing.assert_allclose(slots(shape, len(expected), 20.0), expected, atol=1e-12)


@pytest.mark.parametrize("shape", GROWING)
def test_adding_drones_moves_nobody(shape: str) -> None:
    everyone = slots(shape, 200, 15.0)
    for n in range(1, 200):
        assert np.array_equal(slots(shape, n, 15.0), everyone[:n])


@given(st.sampled_from(GROWING), st.integers(2, 120), st.floats(0.5, 500))
def test_neighbours_keep_the_spacing(shape: str, n: int, spacing_m: float) -> None:
    assert pdist(slots(shape, n, spacing_m)).min() == pytest.approx(spacing_m)


@pytest.mark.parametrize("n", [1, 9, 25, 49])
def test_an_odd_square_number_makes_a_full_centred_grid(n: int) -> None:
    half = int(np.sqrt(n)) // 2
    square = {(float(x), float(y)) for x in range(-half, half + 1) for y in range(-half, half + 1)}
    assert {(x, y) for x, y in slots("grid", n, 1.0).tolist()} == square


@pytest.mark.parametrize("n", [2, 3, 10, 50])
def test_circle_has_the_spacing_along_the_arc(n: int) -> None:
    s = slots("circle", n, 20.0)
    radius = np.hypot(s[:, 0], s[:, 1])
    np.testing.assert_allclose(radius, n * 20 / (2 * np.pi))
    gaps = np.diff(np.unwrap(np.arctan2(s[:, 1], s[:, 0])), append=2 * np.pi)
    np.testing.assert_allclose(gaps * radius, 20.0)


@pytest.mark.parametrize("shape", SHAPES)
def test_one_drone_flies_at_the_reference_point(shape: str) -> None:
    assert slots(shape, 1, 20.0).tolist() == [[0.0, 0.0]]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("blob", 5, 20.0), "shape is 'blob', must be one of ['cross', 'line', 'wedge', 'grid', 'circle']"),
        (("cross", 0, 20.0), "n is 0, must be at least 1"),
        (("cross", 5, 0.0), "spacing_m is 0.0, must be > 0"),
        (("cross", 5, float("nan")), "spacing_m is nan, must be > 0"),
    ],
)
def test_nonsense_is_refused(arguments: tuple[str, int, float], message: str) -> None:
    with pytest.raises(ValueError) as caught:
        slots(*arguments)
    assert str(caught.value) == message
