"""The search under the proofs: ranges that tile their axis, parts of a view in every way, and refusals."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable
from typing import Any

import pytest
from policies_examples import fleet_of

from sortie.policies.contract import Directive
from sortie.policies.geometry import peers_by_overlap
from sortie.policies.verification.proof.ranges import FleetOfRanges, _places
from sortie.policies.verification.proof.search import Run, rosters
from sortie.policies.verification.proof.solver import solver_paths
from sortie.policies.verification.proof.symbols import Path, Refused, explore

DECIDERS: list[Callable[[Any], Any]] = [
    lambda x: x < 0.25,
    lambda x: x <= 0.25,
    lambda x: x > -1.5,
    lambda x: x >= 2,
    lambda x: x == 0.1,
    lambda x: x != 0,
    lambda x: x + 0.1 < 0.3,
    lambda x: 3 - x > 1.7,
    lambda x: x - 0.7 <= 0.1,
    lambda x: x * -3 >= 0.3,
    lambda x: x / 3 > 0.1,
    lambda x: x // 1 == -1,
    lambda x: x // 0.3 >= 2,
    lambda x: abs(x) < 0.5,
    lambda x: -x < 0.5,
    lambda x: (x < 1, x * 2 < 1, x < -1),
    lambda x: (x < 0.5) + (x < 0.25) + (x < 0.75) if x > 0.125 else -1,
    lambda x: x < math.nan,
    lambda x: not x,
    lambda x: (x + 1 < x + 1, x + 1 <= x + 1, x == x),
    lambda x: (x * -0.1 + 0.7 < 0.3, x * 1e-3 - 1.9 == 0.5, x * 3 + 0.2 == 0.5),
]


def cells(decide: Callable[[Any], Any], low: float, high: float) -> list[tuple[float, float, Any]]:
    found = [(*p.bounds("x", 0.0), answer) for p, answer in explore(lambda path: decide(path.number("x", low, high)))]
    return sorted(found, key=lambda cell: cell[0])


def test_the_cells_tile_the_axis_and_decide_as_the_floats_in_them() -> None:
    for decide, (low, high) in itertools.product(DECIDERS, ((-2.0, 3.0), (0.0, 1.0), (-3, 4))):
        found = cells(decide, low, high)
        assert (found[0][0], found[-1][1]) == (low, high)
        for (_, end, _), (begin, _, _) in itertools.pairwise(found):
            assert begin == (end + 1 if isinstance(low, int) else math.nextafter(end, math.inf)), "no float between"
        for a, b, answer in found:
            inside = (a, b) if isinstance(low, int) else (a, a + (b - a) / 3, b)
            assert [decide(x) for x in inside] == [answer] * len(inside)


def test_a_threshold_cuts_at_the_very_float() -> None:
    below = math.nextafter(0.3, 0)
    assert cells(lambda x: x >= 0.3, 0.0, 1.0) == [(0.0, below, False), (0.3, 1.0, True)]
    at = [(0.0, below, False), (0.3, 0.3, True), (math.nextafter(0.3, 1), 1.0, False)]
    assert cells(lambda x: x == 0.3, 0.0, 1.0) == at
    assert cells(lambda n: 2 <= n < 4, 0, 5) == [(0, 1, False), (2, 3, True), (4, 5, False)]


def test_what_no_float_can_hold_or_no_range_can_answer_is_refused_and_no_check_hides_it() -> None:
    steps = (lambda x: x * 1e308, lambda x: x * -1e308, lambda x: x - 1e308 - 1e308, lambda x: 1 / x)
    for act in (*steps, math.sqrt, hash, lambda x: int(x * 1e6), lambda x: x % 2, lambda x: x**2):

        def run(path: Path, act: Callable[[Any], Any] = act) -> None:
            with contextlib.suppress(Exception):
                act(path.number("charge", -1.0, 1e5))

        with pytest.raises(Refused, match="charge"):
            list(explore(run))
    with pytest.raises(Refused, match="combines a and b"):
        list(explore(lambda p: p.number("a", 0.0, 1.0) < p.number("b", 0.0, 1.0)))


# --- the parts of a view --------------------------------------------------------------------------


def fleet(path: Path, drones: int = 3, ego: int = 0) -> FleetOfRanges:
    return FleetOfRanges(path, drones, ego, tuple(range(drones)), 0.1)


def flags_of(act: Callable[[Any], Any]) -> list[Any]:
    """What becomes of a drone's novelty flags, cell by cell."""
    return [found for _, found in explore(lambda p: act(fleet(p).view().descriptors[1].novelty_flags))]


def test_novelty_flags_are_every_byte_and_fork_by_the_bits_that_are_asked_for() -> None:
    whole = (hash, bool, int, lambda n: list(range(256))[n], lambda n: n in {3, 200}, lambda n: n & 6)
    compared = (lambda n: n == 77, lambda n: n != 77, lambda n: n < 128, lambda n: n >= 7, lambda n: n > 255)
    for act in (*whole, *compared):
        assert set(flags_of(act)) == {act(n) for n in range(256)}
    assert sorted(flags_of(lambda n: n & 128)) == [0, 128]
    assert sorted(flags_of(lambda n: 3 & n)) == [0, 1, 2, 3]
    assert sorted(flags_of(lambda n: n & 0b1000_0001)) == [0, 1, 128, 129]
    assert sorted(flags_of(lambda n: (n & 5, n & 4))) == [(0, 0), (1, 0), (4, 4), (5, 4)]

    def run(path: Path) -> tuple[int, int, bool]:
        mine, other = (fleet(path).view().descriptors[i].novelty_flags & 1 for i in (0, 1))
        return mine, other, mine == other

    assert {found for _, found in explore(run)} == {(a, b, a == b) for a in (0, 1) for b in (0, 1)}


def test_a_mapping_is_seen_in_every_order_and_in_the_same_one_throughout() -> None:
    def run(path: Path) -> tuple[int, ...]:
        view = fleet(path).view()
        seen = list(view.descriptors)
        assert list(reversed(view.descriptors)) == seen[::-1]
        assert [i for i, _ in view.age_s.items()] == seen
        return tuple(seen)

    assert [found for _, found in explore(run)] == list(itertools.permutations(range(3)))
    assert {tuple(fleet(Path([k]), 2).view().age_s) for k in (0, 1)} == {(0, 1), (1, 0)}


def test_a_network_is_the_egos_or_another_whoever_is_asked_first() -> None:
    def run(path: Path) -> tuple[bool, ...]:
        d = fleet(path, ego=1).view().descriptors
        same, codebook = d[0].feature_space == d[1].feature_space, d[1].codebook == d[0].codebook
        assert (d[1].feature_space == d[0].feature_space) == same
        assert (d[0].feature_space != d[1].feature_space) != same
        assert d[1].feature_space == d[1].feature_space
        example = fleet(path, ego=1).example()
        assert example.shares_features_with(0) == same
        assert (example.descriptors[0].codebook == example.descriptors[1].codebook) == codebook
        return same, codebook

    assert sorted(found for _, found in explore(run)) == sorted(itertools.product([False, True], repeat=2))
    for one, other in (((1, "codebook"), (2, "codebook")), ((0, "codebook"), (1, "feature_space"))):

        def compare(p: Path, one: Any = one, other: Any = other) -> bool:
            d = fleet(p).view().descriptors
            return bool(getattr(d[one[0]], one[1]) == getattr(d[other[0]], other[1]))

        with pytest.raises(Refused):
            list(explore(compare))


def test_every_ego_hears_every_subset_of_the_others_once() -> None:
    for drones in (1, 2, 3, 4):
        found, ids = list(rosters(drones)), range(drones)
        subsets = [s for n in range(1, drones + 1) for s in itertools.combinations(ids, n)]
        assert len(found) == len(set(found)) == drones * 2 ** (drones - 1)
        assert set(found) == {(ego, s) for ego in ids for s in subsets if ego in s}


def test_places_realise_every_order_of_peers() -> None:
    for n in (1, 2, 3, 4):
        view = fleet_of(n + 1)
        for order in itertools.permutations(range(1, n + 1)):
            at = _places(0, order)
            placed = {i: d._replace(position_m=at[i]) for i, d in view.descriptors.items()}
            assert peers_by_overlap(view._replace(descriptors=placed)) == list(order)


def test_a_run_that_ranks_the_peers_of_several_drones_is_replayed_with_all_its_orders() -> None:
    asked = list[tuple[list[int], ...]]()

    def decide(view: Any) -> list[Directive]:
        asked.append(tuple(peers_by_overlap(view, i) for i in range(3)))
        return [Directive(0, 1)]

    count = 0
    for _, found in explore(lambda p: Run(decide, fleet(p))):
        found.compare()
        count += 1
    assert count == 2**3
    assert asked[::2] == asked[1::2]
    assert len(set(map(str, asked))) == count
    assert peers_by_overlap(fleet_of(3), 0) == peers_by_overlap(fleet_of(3).frozen, 0)


# --- several inputs -------------------------------------------------------------------------------

COMBINING: list[Callable[[Any, Any], Any]] = [
    lambda x, y: 1 - x < y,
    lambda x, y: x - 0.5 > y,
    lambda x, y: x * y > 0.25,
    lambda x, y: 2 / (x + 1) > 1.5,
    lambda x, y: x / (y + 1) >= 0.5,
    lambda x, y: abs(x - y) < 0.125,
    lambda x, y: -x >= y - 1,
    lambda x, y: (x < y, x <= y, x > y, x >= y, x == y, x != y),
    lambda x, y: (x <= math.inf, x < -math.inf, x > -math.inf, x >= math.inf, x == math.inf),
    lambda x, y: (x**2 < y, x + y > 1, x < 0.5),
]


def test_a_solver_s_cells_decide_as_the_numbers_in_them() -> None:
    grid = [k / 8 for k in range(9)]
    for decide in COMBINING:
        found, wanted = set(), {decide(x, y) for x in grid for y in grid}

        def run(path: Path, decide: Callable[[Any, Any], Any] = decide) -> Any:
            return decide(path.number("x", 0.0, 1.0), path.number("y", 0.0, 1.0))

        for path, answer in explore(run, solver_paths()):
            x, y = path.bounds("x", 0.0)[0], path.bounds("y", 0.0)[0]
            assert 0 <= x <= 1
            assert 0 <= y <= 1
            assert decide(x, y) == answer
            found.add(answer)
        assert found >= wanted
