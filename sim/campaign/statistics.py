"""Student's intervals, paired differences, and the runs that pairing saved. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
LEVEL = 0.95


class RunningMean:
    """A running mean and its spread (Welford 1962), whatever the number of values."""

    def __init__(self) -> None:
        self.count, self.mean, self._squares = 0, 0.0, 0.0

    def add(self, value: float) -> None:
        """One more value."""
        self.count += 1
        before = value - self.mean
        self.mean += before / self.count
        self._squares += before * (value - self.mean)

    @property
    def variance(self) -> float:
        """Sample variance; NaN below two values."""
        return self._squares / (self.count - 1) if self.count > 1 else math.nan


def t_interval(mean: RunningMean, level: float = LEVEL) -> float:
    """Half the width of Student's interval; infinite below two values."""
    if mean.count < 2:
        return math.inf
    from scipy.special import stdtrit

    return float(stdtrit(mean.count - 1, 0.5 + level / 2) * math.sqrt(mean.variance / mean.count))


@dataclass(frozen=True, slots=True)
class Estimate:
    """A mean with its interval; NaN where there are too few values."""

    mean: float
    low: float
    high: float
    count: int

    @property
    def half_width(self) -> float:
        return (self.high - self.low) / 2


def estimate(values: Sequence[float] | Floats, level: float = LEVEL) -> Estimate:
    """The mean of independent values; NaN are left out."""
    kept = RunningMean()
    for value in np.asarray(values, float).ravel().tolist():
        if not math.isnan(value):
            kept.add(value)
    if kept.count == 0:
        return Estimate(math.nan, math.nan, math.nan, 0)
    half = t_interval(kept, level) if kept.count > 1 else math.nan
    return Estimate(kept.mean, kept.mean - half, kept.mean + half, kept.count)


@dataclass(frozen=True, slots=True)
class Paired:
    """A difference on the same draws."""

    difference: Estimate
    saved: float
    """How many times as many runs unpaired policies would have needed: (Var a + Var b) / Var(b − a); NaN without spread."""


def paired(a: Floats, b: Floats, level: float = LEVEL) -> Paired:
    """b − a, unit by unit; units where either is NaN are left out."""
    both = ~(np.isnan(a) | np.isnan(b))
    a, b = a[both], b[both]
    spread = float(np.var(b - a, ddof=1)) if len(a) > 1 else math.nan
    apart = float(np.var(a, ddof=1) + np.var(b, ddof=1)) if len(a) > 1 else math.nan
    return Paired(estimate(b - a, level), apart / spread if spread > 0 else math.nan)
