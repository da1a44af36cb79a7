from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sortie.radio.topology import bottleneck, cut_drones, is_connected, link_graph, linked_drones, widest_path

NAN = np.nan
CHAIN = np.array([[NAN, 9.0, 1.0, 0.0], [9.0, NAN, 6.0, 0.0], [1.0, 6.0, NAN, 0.0], [0.0, 0.0, 0.0, NAN]])


def test_who_is_connected_and_who_is_cut() -> None:
    graph = link_graph(CHAIN, 5.0)
    assert sorted(graph.edges) == [(0, 1), (1, 0), (1, 2), (2, 1)]
    assert cut_drones(graph) == [3]
    assert not is_connected(graph)
    assert is_connected(link_graph(CHAIN[:3, :3], 5.0))
    assert cut_drones(link_graph(CHAIN, 100.0)) == [1, 2, 3]
    one_way = np.array([[NAN, 9.0], [0.0, NAN]])
    assert not is_connected(link_graph(one_way, 5.0))


@given(arrays(float, st.integers(1, 6).map(lambda n: (n, n)), elements=st.floats(-10, 10) | st.just(NAN)))
def test_linked_drones_are_those_with_an_edge(quality: np.ndarray) -> None:
    graph = link_graph(quality, 0.0)
    assert linked_drones(quality, 0.0) == [i for i in sorted(graph) if graph.degree(i)]


def test_the_widest_path_goes_round_the_weak_link() -> None:
    graph = link_graph(CHAIN, 0.5)
    assert widest_path(graph, 0, 2) == [0, 1, 2]
    assert bottleneck(graph, [0, 1, 2]) == (1, 2, 6.0)
    assert widest_path(graph, 0, 3) == []


@given(arrays(float, (5, 5), elements=st.integers(0, 4).map(float)))
def test_no_simple_path_is_wider(quality: np.ndarray) -> None:
    graph = link_graph(quality, 1.0)
    best = max(
        (
            min(quality[a, b] for a, b in itertools.pairwise(path))
            for r in range(4)
            for middle in itertools.permutations((1, 2, 3), r)
            for path in [(0, *middle, 4)]
        ),
        default=0.0,
    )
    path = widest_path(graph, 0, 4)
    assert (bottleneck(graph, path)[2] if path else 0.0) == best


def test_broken_input() -> None:
    with pytest.raises(ValueError, match=r"quality has shape \(2, 3\), must be square"):
        link_graph(np.zeros((2, 3)), 1.0)
    with pytest.raises(ValueError, match=r"path is \[1\], must have at least two drones"):
        bottleneck(link_graph(CHAIN, 1.0), [1])
