"""Draws of varied fields: a design in the unit cube, mapped through each field's distribution. Pure functions."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sortie.scenarios.reading.campaign import whole
from sortie.scenarios.schema.campaign import (
    SAMPLED,
    Campaign,
    Choice,
    Column,
    Grid,
    Integers,
    Linspace,
    LogNormal,
    Normal,
    SampledField,
    Spread,
    Triangular,
    Uniform,
)
from sortie.scenarios.streams import stream

Floats = NDArray[np.float64]
MORRIS_LEVELS = 4
TAIL = 0.005
"""Morris' levels reach 0 and 1, where a distribution without ends has none: there it is cut at these quantiles."""


def drawn_fields(campaign: Campaign) -> list[str]:
    """The varied fields that are drawn, in the file's order."""
    return [name for name, spread in campaign.vary.items() if isinstance(spread, SAMPLED)]


def design(sample: SampledField, fields: int, seed: int) -> Floats:
    """Points of the unit cube [draws, fields], in the order in which they are flown.

    Random, Latin hypercube and scrambled Sobol' points come from `scipy.stats.qmc`, Morris' trajectories and Saltelli's
    blocks (without second order) from SALib; their order carries meaning and is kept.

    Raises:
        ImportError: SALib is missing where a method needs it.
    """
    if fields == 0:
        return np.zeros((1, 0))
    rng = stream(seed, 0, (), "campaign.design")
    if sample.method == "random":
        return rng.random((sample.count, fields))
    if sample.method in ("morris", "saltelli"):
        problem = unit_problem(fields)
        number = int(rng.integers(2**32))
        if sample.method == "morris":
            from SALib.sample import morris

            return np.asarray(morris.sample(problem, sample.count, num_levels=MORRIS_LEVELS, seed=number))
        from SALib.sample import sobol

        return np.asarray(sobol.sample(problem, sample.count, calc_second_order=False, seed=number))
    from scipy.stats import qmc  # here: it takes most of a second to import

    if sample.method == "sobol":
        return np.asarray(qmc.Sobol(fields, rng=rng).random(sample.count))
    return np.asarray(qmc.LatinHypercube(fields, rng=rng).random(sample.count))


def unit_problem(fields: int) -> dict[str, Any]:
    """SALib's description of the unit cube: distributions are ours, so that every method has them all."""
    return {"num_vars": fields, "names": [f"x{i}" for i in range(fields)], "bounds": [[0, 1]] * fields}


def quantiles(spread: Spread, u: Floats, *, tail: float = 0.0) -> Sequence[Any]:
    """The values of a drawn field at quantiles u [draws], each in [0, 1]."""
    if isinstance(spread, Uniform):
        uniform: list[float] = (spread.low + u * (spread.high - spread.low)).tolist()
        return uniform
    if isinstance(spread, Integers):
        return [min(spread.high, spread.low + int(v * (spread.high - spread.low + 1))) for v in u]
    if isinstance(spread, Choice):
        weights = np.ones(len(spread.values)) if spread.weights is None else np.asarray(spread.weights)
        last = np.flatnonzero(weights > 0)[-1]
        at = np.searchsorted(np.cumsum(weights) / weights.sum(), u, side="right")
        return [spread.values[k] for k in np.minimum(at, last)]
    from scipy.special import ndtri  # here, as elsewhere in campaigns: light commands do without scipy
    from scipy.stats import triang, truncnorm

    if isinstance(spread, Triangular):
        width = spread.high - spread.low
        found = triang.ppf(u, (spread.mode - spread.low) / width, spread.low, width)
    elif isinstance(spread, Normal):
        low = -np.inf if spread.low is None else spread.low
        high = np.inf if spread.high is None else spread.high
        cut = np.clip(u, tail if spread.low is None else 0.0, 1.0 - (tail if spread.high is None else 0.0))
        ends = ((end - spread.mean) / spread.sd for end in (low, high))
        found = np.clip(truncnorm.ppf(cut, *ends, spread.mean, spread.sd), low, high)
    else:
        assert isinstance(spread, LogNormal)  # noqa: S101
        found = spread.median * np.exp(spread.sigma * ndtri(np.clip(u, tail, 1.0 - tail)))
    values: list[float] = found.tolist()
    return values


def grid(campaign: Campaign, columns: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Every combination of the grid fields, the last field fastest; columns of one file go together."""
    axes: dict[str, list[dict[str, Any]]] = {}
    for name, spread in campaign.vary.items():
        if isinstance(spread, Column):
            rows = axes.setdefault(f"file {spread.file}", [{} for _ in columns[name]])
            for row, value in zip(rows, columns[name], strict=True):
                row[name] = value
        elif isinstance(spread, Linspace):
            axes[name] = [{name: whole(v)} for v in np.linspace(spread.low, spread.high, spread.count).tolist()]
        elif isinstance(spread, Grid):
            axes[name] = [{name: v} for v in spread.values]
    return [{k: v for part in parts for k, v in part.items()} for parts in itertools.product(*axes.values())]
