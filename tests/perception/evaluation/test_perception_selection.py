"""Conditions, who shares, how many cells, and which: against brute force, shapely and the sortie's own rules."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sortie.perception import budget
from sortie.perception.evaluation import FULL_SHARING, SINGLE, Sharing, sharing
from sortie.perception.geometry import FULL, SMALL
from sortie.scenarios.disc import rank_by_overlap

CROSS = np.array([(0.0, 0.0), (20.0, 0.0), (0.0, 20.0), (-20.0, 0.0), (0.0, -20.0)])
RADII = np.full(5, sharing.FOOTPRINT_M)
coordinate = st.floats(-120, 120)


conditions = st.one_of(
    st.just(SINGLE),
    st.builds(
        Sharing,
        st.floats(0, 1),
        st.sampled_from(["all-4", "best-1", "best-2", "best-4", "worst-2", "worst-3", "random-2", "random-4"]),
        st.sampled_from(["uniform", "overlap"]),
        st.sampled_from(["zero", "masked"]),
        st.booleans(),
    ),
)


@given(conditions)
def test_a_label_names_its_condition(condition: Sharing) -> None:
    assert Sharing.parse(condition.label) == condition


def test_labels_are_short() -> None:
    assert SINGLE.label == "single"
    assert FULL_SHARING.label == "all-4@1"
    assert Sharing(0.02, "best-2").label == "best-2@0.02"
    assert Sharing(0.1, "all-4", "overlap", "masked", True).label == "all-4@0.1,overlap,masked,roi"


def test_what_a_condition_and_its_label_refuse() -> None:
    refused = {
        "received_budget is 1.5, must be 0 to 1": {"received_budget": 1.5},
        "received_budget is nan, must be 0 to 1": {"received_budget": float("nan")},
        "peers is 'nearest-2', must be none, or all-k, best-k": {"received_budget": 0.1, "peers": "nearest-2"},
        "peers is 'best-0', must be": {"received_budget": 0.1, "peers": "best-0"},
        "received_budget is 0.1 with no peers, must be 0": {"received_budget": 0.1, "peers": "none"},
        "allocation is 'equal', must be uniform or overlap": {"received_budget": 0.1, "allocation": "equal"},
        "unsent is 'gone', must be zero or masked": {"received_budget": 0.1, "unsent": "gone"},
    }
    for message, knobs in refused.items():
        with pytest.raises(ValueError, match=message):
            Sharing(**knobs)
    for label in ("", "best-2", "best-2@x", "best-2@0.1,loud", "best-2@7"):
        with pytest.raises(ValueError, match=r"must be like best-2@0\.02,masked"):
            Sharing.parse(label)


def test_overlap_is_of_the_receivers_footprint() -> None:
    """Of 42 m, as in the paper."""
    assert pytest.approx(42.0, abs=0.02) == sharing.FOOTPRINT_M
    shares = sharing.footprint_overlap(np.array([(0.0, 0.0), (5.0, 0.0)]), np.array([42.0, 10.0]))
    assert shares == pytest.approx(np.array([[1.0, (10 / 42) ** 2], [1.0, 1.0]]))


def test_best_worst_and_all_in_a_cross() -> None:
    overlap = sharing.footprint_overlap(CROSS, RADII)
    # drone 1 is at the tip: the centre is nearest, the opposite tip farthest, equal ones go by id after the ego's
    assert sharing.choose(Sharing(0.1, "best-2"), 1, overlap[1]) == (0, 2)
    assert sharing.choose(Sharing(0.1, "worst-2"), 1, overlap[1]) == (4, 3)
    assert sharing.choose(Sharing(0.1, "all-4"), 1, overlap[1]) == (0, 2, 3, 4)
    assert sharing.choose(Sharing(0.0, "none"), 1, overlap[1]) == ()
    for peers in ("best-5", "all-3", "all-5"):
        with pytest.raises(ValueError, match=f"peers is '{peers}', must fit a fleet with 4 peers"):
            sharing.choose(Sharing(0.1, peers), 0, np.ones(5))


@given(st.lists(st.floats(0, 1), min_size=5, max_size=5), st.integers(0, 4), st.integers(1, 4))
def test_best_and_worst_are_brute_forces(overlap: list[float], ego: int, k: int) -> None:
    overlap = [round(o, 1) for o in overlap]  # whole steps of the ranking
    row = np.array(overlap)
    peers = [i for i in range(5) if i != ego]
    by_sum = {sum(sorted(overlap[i] for i in c)) for c in itertools.combinations(peers, k)}
    chosen = {rule: sharing.choose(Sharing(0.1, f"{rule}-{k}"), ego, row) for rule in ("best", "worst", "random")}
    assert sum(sorted(overlap[i] for i in chosen["best"])) == max(by_sum)
    assert sum(sorted(overlap[i] for i in chosen["worst"])) == min(by_sum)
    for some in chosen.values():
        assert len(set(some)) == k
        assert ego not in some
        assert list(some) == [i for i in rank_by_overlap(ego, {i: overlap[i] for i in peers}) if i in some], (
            "most overlapping first"
        )


def test_random_peers_are_the_frames_own_and_even() -> None:
    overlap, condition = sharing.footprint_overlap(CROSS, RADII), Sharing(0.1, "random-2")
    draws = [sharing.choose(condition, 0, overlap[0], (7, n)) for n in range(3000)]
    assert draws[5] == sharing.choose(condition, 0, overlap[0], (7, 5))
    pairs = [draws.count(pair) for pair in itertools.combinations((1, 2, 3, 4), 2)]
    assert sum(pairs) == 3000
    assert min(pairs) > 400  # 500 expected, σ 20
    other = [sharing.choose(condition, 1, overlap[1], (7, n)) for n in range(50)]
    turned = [tuple(sorted((peer - 1) % 5 for peer in pair)) for pair in other]
    assert sum(a == b for a, b in zip(turned, draws, strict=False)) < 25, "and the ego's"
    assert draws[:50] != [sharing.choose(condition, 0, overlap[0], (7, n), seed=1) for n in range(50)]


overlaps = st.lists(st.one_of(st.just(0.0), st.floats(1e-6, 1)), min_size=1, max_size=5)


@given(st.integers(0, 20_000), overlaps, st.sampled_from(["uniform", "overlap"]))
def test_allocation_spends_the_whole_budget(total: int, overlap: list[float], rule: str) -> None:
    cells = sharing.allocate(total, overlap, rule)
    assert sum(cells) == min(total, 4096 * len(overlap))
    assert all(0 <= c <= 4096 for c in cells)


@given(st.integers(0, 400), st.lists(st.integers(0, 9), min_size=1, max_size=4), st.integers(1, 100))
def test_allocation_is_the_fairest_there_is(total: int, weights: list[int], most: int) -> None:
    """Brute force: cell by cell to whoever is farthest below the quota, all quotas found by raising one level."""
    overlap = [w / 9 for w in weights]
    cells = sharing.allocate(total, overlap, "overlap", most)
    left, quota = float(total), [0.0] * len(weights)
    open_, share = set(range(len(weights))), [float(w) for w in weights]
    while open_:  # pour level by level: whoever is filled first leaves
        if sum(share[i] for i in open_) == 0:
            share = [1.0] * len(weights)
        whole = sum(share[i] for i in open_)
        over = [i for i in open_ if share[i] * left / whole >= most - 1e-9]
        if not over:
            for i in open_:
                quota[i] = share[i] * left / whole
            break
        for i in over:
            quota[i] = most
            left -= most
            open_.discard(i)
    for c, q in zip(cells, quota, strict=True):
        assert q - 1 < c + 1e-6
        assert c - 1e-6 < q + 1


def test_remainders_go_to_the_largest_fraction_then_to_the_first() -> None:
    cells = {1: 16384, 0.25: 4096, 0.1: 1638, 0.05: 819, 0.02: 327, 0.01: 163, 0: 0}
    assert {rho: budget.cells_in(rho, 4) for rho in cells} == cells
    assert sharing.allocate(327, [0.7, 0.7, 0.6, 0.4], "uniform") == [82, 82, 82, 81]
    assert sharing.allocate(10, [0.5, 0.25, 0.25], "overlap") == [5, 3, 2]
    assert sharing.allocate(5000, [0.9, 0.1], "overlap") == [4096, 904]
    assert sharing.allocate(10, [0.0, 0.0], "overlap") == [5, 5]
    assert sharing.allocate(16384, [0.9, 0.1], "uniform") == [4096, 4096]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 30), st.booleans(), st.integers(0, 4096))
def test_sent_cells_are_brute_forces(seed: int, levels: int, with_roi: bool, cells: int) -> None:
    rng = np.random.Generator(np.random.PCG64(seed))
    rank = rng.integers(0, levels, (2, 64, 64)).astype(np.float32)  # many ties
    first = rng.random((2, 64, 64)) < 0.1 if with_roi else None
    order = sharing.sending_order(rank, first)
    for d in range(2):
        wanted = sorted(range(4096), key=lambda i: (first is not None and not first[d].flat[i], -rank[d].flat[i], i))[
            :cells
        ]
        assert set(np.flatnonzero(order[d] < cells).tolist()) == set(wanted)


def test_without_a_disc_the_cells_are_the_sorties() -> None:
    rank = np.random.Generator(np.random.PCG64(3)).normal(size=(1, 64, 64)).astype(np.float32)
    order = sharing.sending_order(rank)
    for rho in (0.02, 0.1, 0.25, 1.0):
        sent = budget.select(rank[0], rho, None, 0.0, 0.0, 0.0)
        assert np.array_equal(order[0] < math.floor(rho * 4096), sent)


@given(st.tuples(coordinate, coordinate, st.floats(1, 60)), st.tuples(coordinate, coordinate, st.floats(-4, 4)))
def test_the_disc_is_the_sorties(disc: tuple, pose: tuple) -> None:
    assert np.array_equal(sharing.in_disc(np.array([pose]), disc)[0], budget.roi_mask(disc, *pose))


def test_the_disc_in_cells() -> None:
    at = np.zeros((1, 3))
    assert sharing.in_disc(at, (0.0, 0.0, 32.0), FULL).sum() == pytest.approx(314, abs=6)
    assert sharing.in_disc(at, (0.0, 0.0, 32.0), SMALL).sum() == pytest.approx(4 * 314, abs=20)


def test_bytes_are_the_papers() -> None:
    assert sharing.link_bytes([4096] * 4) == (4 * 655_360, 0)
    assert sharing.link_bytes([1024] * 4) == (4 * 163_840, 4 * 512)
    assert sharing.link_bytes([82, 82, 82, 81]) == (327 * 160, 3 * 123 + 122)
    assert sharing.link_bytes([]) == (0, 0)
