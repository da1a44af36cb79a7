"""How a fleet hangs together: closed forms, and the bottleneck beside every path there is."""

from __future__ import annotations

import itertools

import networkx as nx
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sortie.radio.topology import Connectivity, Edge, bottleneck, connectivity, usable_graph


def both_ways(*links: tuple[int, int, float]) -> list[Edge]:
    return [end for a, b, mbps in links for end in ((a, b, mbps), (b, a, mbps))]


LINE = both_ways((0, 1, 9.0), (1, 2, 6.0), (2, 3, 8.0))
# name: drones, links, what it is
FLEETS = {
    "a line": (4, LINE, Connectivity(True, (), (1, 2), 20 / 12, (1, 2, 6.0))),
    "one that nobody hears": (5, LINE, Connectivity(False, (4,), (1, 2), 20 / 12, (1, 2, 6.0))),
    "a ring": (4, [*LINE, *both_ways((3, 0, 1.0))], Connectivity(True, (), (), 16 / 12, (1, 2, 6.0))),
    "one way": (2, [(0, 1, 9.0)], Connectivity(False, (1,), (), 1.0, (0, 1, 9.0))),
    "two pairs": (4, both_ways((0, 1, 5.0), (2, 3, 4.0)), Connectivity(False, (2, 3), (), 1.0, (2, 3, 4.0))),
    "links of others": (2, both_ways((0, 1, 5.0), (1, 2, 1.0)), Connectivity(True, (), (), 1.0, (0, 1, 5.0))),
    "no link": (3, [], Connectivity(False, (1, 2), (), None, None)),
    "a drone alone": (1, [], Connectivity(True, (), (), None, None)),
    "nobody": (0, [], Connectivity(True, (), (), None, None)),
}


def test_fleets_whose_figures_are_known() -> None:
    found = {name: connectivity(usable_graph(range(n), links)) for name, (n, links, _) in FLEETS.items()}
    assert found == {name: wanted for name, (_, _, wanted) in FLEETS.items()}


@given(st.dictionaries(st.tuples(st.integers(0, 4), st.integers(0, 4)), st.integers(1, 4).map(float)))
def test_the_bottleneck_limits_the_pair_whose_widest_path_is_narrowest(mbps: dict[tuple[int, int], float]) -> None:
    graph = usable_graph(range(5), ((a, b, value) for (a, b), value in mbps.items() if a != b))
    widest = [
        max(min(graph.edges[hop]["mbps"] for hop in itertools.pairwise(path)) for path in paths)
        for a, b in itertools.permutations(graph, 2)
        if (paths := list(nx.all_simple_paths(graph, a, b)))
    ]
    found = bottleneck(graph)
    assert (found is None) == (not widest)
    if found is not None:
        assert found[2] == min(widest) == graph.edges[found[:2]]["mbps"]
        assert not np.isnan(found[2])
