"""How a fleet hangs together over its usable links: who is connected, who is cut off, where the bottleneck is (`networkx`)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import networkx as nx

Edge = tuple[int, int, float]
"""Sender, receiver and goodput, Mb/s."""


class Connectivity(NamedTuple):
    """A fleet's links in one look."""

    connected: bool
    """Whether every drone reaches every other, over several hops if need be."""
    cut: tuple[int, ...]
    """Drones outside the largest group whose members all reach one another (of equals, that with the lowest id), ascending."""
    articulation: tuple[int, ...]
    """Drones without which a group that talks both ways falls apart, ascending."""
    hops: float | None
    """Links on the shortest route, the mean over all pairs with one; None without links."""
    bottleneck: Edge | None
    """The link that limits the worst-off pair that is connected; None without links."""


def usable_graph(drones: Iterable[int], edges: Iterable[Edge]) -> nx.DiGraph:
    """The usable links as a graph, with `mbps` on the edges; links of other drones are left out."""
    import networkx as nx  # here: commands would wait a fifth of a second for it

    found = nx.DiGraph()
    found.add_nodes_from(drones)
    found.add_edges_from((a, b, {"mbps": mbps}) for a, b, mbps in edges if a in found and b in found)
    return found


def connectivity(usable: nx.DiGraph) -> Connectivity:
    """How a fleet hangs together.

    Args:
        usable: its usable links, as `usable_graph` makes it.

    Example, three drones in a row, and a fourth that nobody hears:

    >>> links = [(0, 1, 9.0), (1, 0, 9.0), (1, 2, 6.0), (2, 1, 6.0)]
    >>> connectivity(usable_graph(range(4), links))
    Connectivity(connected=False, cut=(3,), articulation=(1,), hops=1.3333333333333333, bottleneck=(1, 2, 6.0))
    """
    import networkx as nx

    groups = sorted(nx.strongly_connected_components(usable), key=lambda group: (-len(group), min(group)))
    lengths = [hops for _, to in nx.all_pairs_shortest_path_length(usable) for hops in to.values() if hops]
    return Connectivity(
        len(groups) <= 1,
        tuple(sorted(drone for group in groups[1:] for drone in group)),
        tuple(sorted(nx.articulation_points(usable.to_undirected(reciprocal=True)))),
        sum(lengths) / len(lengths) if lengths else None,
        bottleneck(usable),
    )


def bottleneck(usable: nx.DiGraph) -> Edge | None:
    """The link that limits the worst-off pair: without it and the better ones alone, somebody is reached no more.

    Only links of at least its goodput are needed for everybody to reach whom they reach over all links.
    """
    import networkx as nx

    edges: list[Edge] = sorted(usable.edges(data="mbps"), key=lambda edge: (edge[2], edge[0], edge[1]))
    if not edges:
        return None
    reached = {drone: nx.descendants(usable, drone) for drone in usable}
    low, high = 0, len(edges) - 1  # the links from `low` on are enough, and the answer is the last such place
    while low < high:
        middle = (low + high + 1) // 2
        part = usable_graph(usable, (edge for edge in edges if edge[2] >= edges[middle][2]))
        is_enough = all(nx.descendants(part, drone) == reached[drone] for drone in part)
        low, high = (middle, high) if is_enough else (low, middle - 1)
    return next(edge for edge in edges if edge[2] == edges[low][2])
