"""Pairs of least cost among those that are allowed (the Hungarian method), for many tables at once. Free of torch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


def least_cost(i: Ints, j: Ints, cost: Floats, table: Ints, free: float) -> Bools:
    """Which of the allowed pairs are taken, so that each i and each j is in at most one, and the sum of costs is least.

    Args:
        i, j, cost: [p] the allowed pairs, and what each costs, below `free`.
        table: [p] pairs of different tables have no i and no j in common.
        free: what an i or j without a partner costs; pairs that are not allowed cost it too.
    """
    alone: Bools = (np.bincount(i)[i] == 1) & (np.bincount(j)[j] == 1)
    taken: Bools = alone.copy()
    rest = np.flatnonzero(~alone)
    rest = rest[np.argsort(table[rest], kind="stable")]
    for some in np.split(rest, np.flatnonzero(np.diff(table[rest])) + 1) if len(rest) else ():
        rows, row = np.unique(i[some], return_inverse=True)
        columns, column = np.unique(j[some], return_inverse=True)
        shape = len(rows), len(columns)
        costs, which = np.full(shape, free), np.full(shape, -1)
        costs[row, column], which[row, column] = cost[some], some
        pairs = which[linear_sum_assignment(costs)]
        taken[pairs[pairs >= 0]] = True
    return taken
