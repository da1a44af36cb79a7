"""The search under the proofs: what ranges answer, what they refuse, and that every case is met."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sortie.policies.geometry import peers_by_overlap
from sortie.policies.verification.proof.ranges import FleetOfRanges, _places
from sortie.policies.verification.proof.symbols import Path, Ranged, Refused, explore


def cells(run: Callable[[Ranged], object], low: float = 0.0, high: float = 1.0) -> list[tuple[float, float, object]]:
    found = []
    for path, result in explore(lambda p: run(p.number("x", low, high))):
        found.append((*path.ranges["x"], result))
    return sorted(found, key=lambda c: c[0])


@given(
    st.lists(st.floats(-2, 2), max_size=5),
    st.sampled_from([1.0, -1.0, 3.0, -0.1, 1e-3]),
    st.floats(-2, 2),
    st.lists(st.floats(0, 1), max_size=20),
)
def test_cells_cover_every_float_and_decide_alike(
    thresholds: list[float], factor: float, offset: float, points: list[float]
) -> None:
    def decide(x: object) -> list[bool]:
        value = x * factor + offset  # type: ignore[operator]
        return [value < t for t in thresholds] + [value == t for t in thresholds]

    found = cells(decide)
    assert found[0][0] == 0.0
    assert found[-1][1] == 1.0
    for (_, end, _), (begin, _, _) in pairwise(found):
        assert math.nextafter(end, math.inf) == begin, "no float lies between two cells"
    for low, high, answer in found:
        assert decide(low) == answer == decide(high)
    for x in points:
        assert [answer for low, high, answer in found if low <= x <= high] == [decide(x)]


def test_a_threshold_cuts_at_the_very_float() -> None:
    below = math.nextafter(0.3, 0)
    assert cells(lambda x: x >= 0.3) == [(0.0, below, False), (0.3, 1.0, True)]
    assert cells(lambda x: x == 0.3) == [(0.0, below, False), (0.3, 0.3, True), (math.nextafter(0.3, 1), 1.0, False)]
    assert cells(lambda n: 2 <= n < 4, 0, 5) == [(0, 1, False), (2, 3, True), (4, 5, False)]


@pytest.mark.parametrize(
    "act",
    [
        math.sqrt,
        lambda x: int(x * 1e6),
        hash,
        lambda x: x % 2,
        lambda x: x**2,
        lambda x: 1 / x,
    ],
)
def test_what_a_range_cannot_answer_is_refused_and_no_check_hides_it(act: Callable[[object], object]) -> None:
    def run(path: Path) -> None:
        with contextlib.suppress(Exception):
            act(path.number("charge", 0.0, 1.0))

    with pytest.raises(Refused, match="charge"):
        list(explore(run))


def flags_of(act: Callable[[Any], object]) -> list[object]:
    """What becomes of the ego's novelty flags, cell by cell."""

    def run(path: Path) -> object:
        me = FleetOfRanges(path, 1, 0, (0,), 0.1).view().me
        assert me is not None
        return act(me.novelty_flags)

    return [found for _, found in explore(run)]


@pytest.mark.parametrize(
    "act",
    [
        hash, bool, int, lambda n: n == 77, lambda n: n != 77, lambda n: n in {3, 200}, lambda n: n < 128, lambda n: n >= 7,
        lambda n: n > 255, lambda n: list(range(256))[n], lambda n: n & 6,
    ],
)  # fmt: skip
def test_novelty_flags_are_every_byte(act: Callable[[Any], object]) -> None:
    assert set(flags_of(act)) == {act(n) for n in range(256)}


def test_novelty_flags_fork_by_the_bits_that_are_asked_for() -> None:
    assert sorted(flags_of(lambda n: n & 128)) == [0, 128]  # type: ignore[type-var]
    assert sorted(flags_of(lambda n: 3 & n)) == [0, 1, 2, 3]  # type: ignore[type-var]
    assert sorted(flags_of(lambda n: (n & 5, n & 4))) == [(0, 0), (1, 0), (4, 4), (5, 4)]  # type: ignore[type-var]


def test_flags_of_two_drones_are_compared() -> None:
    def run(path: Path) -> tuple[int, int, bool]:
        view = FleetOfRanges(path, 2, 0, (0, 1), 0.1).view()
        mine, other = (view.descriptors[i].novelty_flags for i in (0, 1))
        if mine & 254 or other & 254:
            return 0, 0, True
        return mine & 1, other & 1, mine == other

    assert {found for _, found in explore(run)} == {(0, 0, True), (0, 1, False), (1, 0, False), (1, 1, True)}


def test_two_axes_are_not_compared() -> None:
    with pytest.raises(Refused, match="combines a and b"):
        list(explore(lambda p: p.number("a", 0.0, 1.0) < p.number("b", 0.0, 1.0)))


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_places_realise_every_order(n: int) -> None:
    import itertools

    from policies_examples import fleet_of

    view = fleet_of(n + 1)
    for order in itertools.permutations(range(1, n + 1)):
        at = _places(0, order)
        placed = {i: d._replace(position_m=at[i]) for i, d in view.descriptors.items()}
        assert peers_by_overlap(view._replace(descriptors=placed)) == list(order)
