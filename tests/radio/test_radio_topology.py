"""How a fleet hangs together, beside networkx and beside every path there is."""

from __future__ import annotations

import itertools

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sortie.radio.topology import Connectivity, connectivity, linked_drones, widths

NAN = np.nan


CHAIN = np.array([[NAN, 9.0, 1.0, 0.0], [9.0, NAN, 6.0, 0.0], [1.0, 6.0, NAN, 0.0], [0.0, 0.0, 0.0, NAN]])


ANY = arrays(float, st.integers(0, 6).map(lambda n: (n, n)), elements=st.floats(-10, 10) | st.just(NAN))


FEW = arrays(float, st.integers(1, 5).map(lambda n: (n, n)), elements=st.integers(0, 4).map(float) | st.just(NAN))
"""Values that are often equal, and often no link at a threshold of 1."""


def graph_of(quality: np.ndarray, threshold: float) -> nx.DiGraph:
    """The usable links."""
    graph = nx.DiGraph()
    graph.add_nodes_from(range(len(quality)))
    n = range(len(quality))
    graph.add_edges_from((i, j) for i in n for j in n if i != j and quality[i, j] >= threshold)
    return graph


def test_who_is_connected_and_who_is_cut() -> None:
    assert connectivity(CHAIN, 5.0) == Connectivity(False, (3,), (1, 2, 6.0))
    assert connectivity(CHAIN[:3, :3], 5.0) == Connectivity(True, (), (1, 2, 6.0))
    assert connectivity(CHAIN, 100.0) == Connectivity(False, (1, 2, 3), None)
    one_way = np.array([[NAN, 9.0], [0.0, NAN]])
    assert connectivity(one_way, 5.0) == Connectivity(False, (1,), (0, 1, 9.0))
    assert connectivity(np.zeros((1, 1)), 5.0) == Connectivity(True, (), None)
    assert connectivity(np.zeros((0, 0)), 5.0) == Connectivity(True, (), None)


@given(ANY)
def test_linked_drones_are_those_with_an_edge(quality: np.ndarray) -> None:
    graph = graph_of(quality, 0.0)
    assert linked_drones(quality, 0.0) == [i for i in sorted(graph) if graph.degree(i)]


@given(ANY)
def test_groups_are_strongly_connected_components(quality: np.ndarray) -> None:
    groups = sorted(nx.strongly_connected_components(graph_of(quality, 0.0)), key=lambda g: (-len(g), min(g)))
    found = connectivity(quality, 0.0)
    assert found.connected == (len(groups) <= 1)
    assert set(found.cut) == {i for group in groups[1:] for i in group}
    assert list(found.cut) == sorted(found.cut)


@given(FEW)
def test_no_path_is_wider_than_the_widest(quality: np.ndarray) -> None:
    n = len(quality)
    usable = np.where(quality >= 1.0, quality, NAN)
    found, reached = widths(usable), []
    for i, j in itertools.product(range(n), repeat=2):
        others = [k for k in range(n) if k not in (i, j)]
        paths = [(i, *via, j) for r in range(n - 1) for via in itertools.permutations(others, r)] if i != j else []
        ways = [[usable[a, b] for a, b in itertools.pairwise(path)] for path in paths]
        best = max((min(way) for way in ways if not np.isnan(way).any()), default=-np.inf)
        assert found[i, j] == best
        reached += [best] if np.isfinite(best) else []
    bottleneck = connectivity(quality, 1.0).bottleneck
    assert (bottleneck is None) == (not reached)
    if bottleneck is not None:
        i, j, width = bottleneck
        assert i != j
        assert width == min(reached) == quality[i, j]


def test_broken_input() -> None:
    with pytest.raises(ValueError, match=r"^quality has shape \(2, 3\), must be square$"):
        connectivity(np.zeros((2, 3)), 1.0)
