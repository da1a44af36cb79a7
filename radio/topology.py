"""The fleet as a graph of usable links: who is connected, who is cut off, where the bottleneck is.

networkx is imported where it is used: a sortie needs only `linked_drones`, and the import a fifth of a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Connectivity(NamedTuple):
    """A fleet's links in one look."""

    connected: bool
    """Whether every drone reaches every other, over several hops if need be."""
    cut: tuple[int, ...]
    """Drones outside the largest group whose members all reach one another, ascending."""
    bottleneck: tuple[int, int, float] | None
    """Sender, receiver and quality of the link that limits the worst-off pair that is connected; None without links."""


def link_graph(quality: ArrayLike, threshold: float) -> Any:
    """Directed graph of the links whose quality is at least `threshold`.

    Args:
        quality: [N, N], sender by receiver: goodput in Mb/s or SNR in dB; the diagonal and NaN are no links.
        threshold: the bound, in the unit of `quality`.

    Returns:
        A networkx.DiGraph of the nodes 0 … N − 1, edges with attribute `quality`.

    Raises:
        ValueError: if `quality` is not square.
    """
    import networkx as nx

    matrix = np.asarray(quality, dtype=float)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise ValueError(f"quality has shape {matrix.shape}, must be square")
    graph = nx.DiGraph()
    graph.add_nodes_from(range(len(matrix)))
    usable = matrix >= threshold
    np.fill_diagonal(usable, False)
    graph.add_edges_from(
        (int(i), int(j), {"quality": float(matrix[i, j])}) for i, j in zip(*np.nonzero(usable), strict=True)
    )
    return graph


def linked_drones(quality: ArrayLike, threshold: float) -> list[int]:
    """Drones with at least one usable link, in or out, ascending; arguments as for `link_graph`."""
    usable = np.asarray(quality, dtype=float) >= threshold
    usable |= usable.T
    np.fill_diagonal(usable, False)
    linked: list[int] = np.flatnonzero(usable.any(axis=0)).tolist()
    return linked


def is_connected(graph: Any) -> bool:
    """Whether every drone reaches every other, over several hops if need be."""
    import networkx as nx

    return len(graph) <= 1 or bool(nx.is_strongly_connected(graph))


def cut_drones(graph: Any) -> list[int]:
    """Drones outside the largest strongly connected group (of equals, that with the lowest id), ascending."""
    import networkx as nx

    groups = sorted(nx.strongly_connected_components(graph), key=lambda g: (-len(g), min(g)))
    return sorted(set(graph) - groups[0]) if groups else []


def bottleneck(graph: Any, path: Sequence[int]) -> tuple[int, int, float]:
    """The weakest link (sender, receiver, quality) of a path of at least two drones.

    Raises:
        ValueError: if the path has no link.
    """
    if len(path) < 2:
        raise ValueError(f"path is {list(path)}, must have at least two drones")
    links = ((a, b, float(graph.edges[a, b]["quality"])) for a, b in pairwise(path))
    return min(links, key=lambda link: link[2])


def widest_path(graph: Any, source: int, target: int) -> list[int]:
    """The path whose weakest link is strongest; fewest hops among equals; empty if there is none."""
    import networkx as nx

    strengths = sorted({quality for _, _, quality in graph.edges(data="quality")}, reverse=True)
    low, high = 0, len(strengths)  # the strongest threshold at which a path is left, by bisection
    while low < high:
        middle = (low + high) // 2
        if nx.has_path(_at_least(graph, strengths[middle]), source, target):
            high = middle
        else:
            low = middle + 1
    if low == len(strengths):
        return []
    return [int(i) for i in nx.shortest_path(_at_least(graph, strengths[low]), source, target)]


def widths(quality: ArrayLike) -> NDArray[np.float64]:
    """How good the weakest link of the widest route between each pair is (Floyd's recursion with min and max).

    Args:
        quality: [N, N], sender by receiver; NaN is no link.

    Returns:
        [N, N]; −inf where there is no route, and on the diagonal.
    """
    wide = np.array(quality, dtype=float)
    wide[np.isnan(wide)] = -np.inf
    np.fill_diagonal(wide, -np.inf)
    for via in range(len(wide)):
        np.maximum(wide, np.minimum(wide[:, via, None], wide[None, via, :]), out=wide)
    np.fill_diagonal(wide, -np.inf)
    return wide


def connectivity(quality: ArrayLike, threshold: float) -> Connectivity:
    """How a fleet hangs together; arguments and errors as for `link_graph`."""
    graph = link_graph(quality, threshold)
    usable = np.array(quality, dtype=float)
    usable[~(usable >= threshold)] = np.nan
    np.fill_diagonal(usable, np.nan)
    reached = widths(usable)
    worst = None
    if np.isfinite(reached).any():
        limit = reached[np.isfinite(reached)].min()
        i, j = (int(at[0]) for at in np.nonzero(usable == limit))
        worst = (i, j, float(limit))
    return Connectivity(is_connected(graph), tuple(cut_drones(graph)), worst)


def _at_least(graph: Any, quality: float) -> Any:
    import networkx as nx

    return nx.subgraph_view(graph, filter_edge=lambda a, b: graph.edges[a, b]["quality"] >= quality)
