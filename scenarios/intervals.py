"""Intervals of means and of resampled figures: the one definition of each that all of Sortie uses.

An interval covers what was drawn independently, its units: sorties, draws of a campaign, conditions, frames. Blocks of a
single sortie (`sim/experiment/compare.py`) are nearly independent only; an interval over them describes that sortie. Two cases:

- **The mean of independent units** (`mean_interval`): Student's interval. Sortie's samples are small, eight sorties for
  one, where a percentile bootstrap covers well below 95 % (`research/pages/coverage.md`). A metric with a smallest or
  largest possible value gets Student's interval on a scale without ends, so that no rate leaves 0 … 1 and no number of
  bytes is negative. A yes or no has the exact binomial interval.
- **A figure that pools its units**, such as an average precision over many frames, is no mean. Its units are resampled
  (`resamples`), and `percentile_interval` and `p_value` read the draws.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sortie.scenarios.streams import stream

Floats = NDArray[np.float64]
LEVEL = 0.95
DRAWS = 1000
EQUAL = 30
"""Values that are all equal count as known from so many units on. If one unit in ten differed, 30 would all be equal in 4 % of
cases."""
ROUNDING = 1e-12


class Range(NamedTuple):
    """The smallest and the largest value that a metric can have: both, the smallest alone, or neither."""

    low: float = -math.inf
    high: float = math.inf
    yes_or_no: bool = False
    """Whether there are no values between the two."""

    def of_differences(self) -> Range:
        """The range of one value minus another."""
        return Range(self.low - self.high, self.high - self.low)


ANY = Range()
AMOUNT = Range(0.0)
"""Bytes, joules, seconds, counts."""
SHARE = Range(0.0, 1.0)
"""Rates, fractions, average precision."""
FLAG = Range(0.0, 1.0, yes_or_no=True)
"""Whether something holds: 0 or 1."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A mean with its interval; NaN where there are too few values."""

    mean: float
    low: float
    high: float
    count: int
    """Units that had a value."""

    @property
    def half_width(self) -> float:
        """Half the length of the interval; NaN below two values, 0 where all values are equal."""
        return (self.high - self.low) / 2

    def reaches(self, half_width: float) -> bool:
        """Whether enough was measured for this half-width: values that are all equal have no interval, and count as `EQUAL` says."""
        return self.half_width <= half_width and (self.low < self.high or self.count >= EQUAL)


def mean_interval(values: ArrayLike, within: Range = ANY, level: float = LEVEL) -> Estimate:
    """The mean of independent values with Student's interval.

    Args:
        values: any shape, a value a unit; NaN are left out.
        within: what values are possible. The interval is Student's for the logit of the mean between two ends, for its
            logarithm above one end, and for the mean itself where there is none; the standard error is carried over by
            the delta method (Oehlert, *A Note on the Delta Method*, 1992). Far from an end, the three agree. Of a yes or
            no it is the binomial's exact one (Clopper and Pearson, 1934); averages of several have that between two ends.
        level: of the two-sided interval.

    Returns:
        The estimate. Below two values it has no interval. Measured values that are all equal show no spread, from which
        an interval could follow: it is that value alone, and reports write "all equal" in its place. A yes or no that is
        always the same has an interval like any other.

    Raises:
        ValueError: a value that is not possible.

    Example:
        >>> rates = [0.9, 0.95, 1.0, 1.0]
        >>> round(mean_interval(rates).high, 3), round(mean_interval(rates, SHARE).high, 3)
        (1.039, 0.995)
        >>> round(mean_interval([0] * 8, FLAG).high, 3)  # no drone lost in eight sorties: up to 37 % may be
        0.369
    """
    kept = [_to_end(v, within) for v in np.asarray(values, float).ravel().tolist() if not math.isnan(v)]
    for value in kept:
        if not within.low <= value <= within.high:
            raise ValueError(f"{value!r}, must be {within.low:g} to {within.high:g}")
    if not kept:
        return Estimate(math.nan, math.nan, math.nan, 0)
    n, mean = len(kept), math.fsum(kept) / len(kept)
    if n == 1:
        return Estimate(mean, math.nan, math.nan, 1)
    if within.yes_or_no and set(kept) <= {0.0, 1.0}:
        return _binomial(round(math.fsum(kept)), n, level)
    error = math.sqrt(math.fsum((v - mean) ** 2 for v in kept) / (n - 1) / n)
    if min(kept) == max(kept):
        return Estimate(kept[0], kept[0], kept[0], n)
    from scipy.special import expit, logit, stdtrit  # here: half of what this module takes to import

    off = float(stdtrit(n - 1, 0.5 + level / 2)) * error
    if math.isinf(within.low) and math.isinf(within.high):
        return Estimate(mean, mean - off, mean + off, n)
    if math.isinf(within.high):
        factor = off / (mean - within.low)
        with np.errstate(over="ignore"):
            low, high = (within.low + (mean - within.low) * float(np.exp(sign * factor)) for sign in (-1, 1))
        return Estimate(mean, low, high, n)
    width = within.high - within.low
    part = (mean - within.low) / width
    off /= width * part * (1 - part)
    low, high = (within.low + width * float(expit(logit(part) + sign * off)) for sign in (-1, 1))
    return Estimate(mean, low, high, n)


def _binomial(k: int, n: int, level: float) -> Estimate:
    """The exact interval of a probability, `k` of `n` times."""
    from scipy.special import betaincinv

    tail = 0.5 - level / 2
    low = 0.0 if k == 0 else float(betaincinv(k, n - k + 1, tail))
    high = 1.0 if k == n else float(betaincinv(k + 1, n - k, 1 - tail))
    return Estimate(k / n, low, high, n)


def _to_end(value: float, within: Range) -> float:
    """The end of the range that rounding has left a value just beside."""
    return next((end for end in within[:2] if abs(value - end) < ROUNDING), value)


@dataclass(frozen=True, slots=True)
class Paired:
    """A difference on the same draws."""

    difference: Estimate
    saved: float
    """How many times as many runs unpaired policies would have needed: (Var a + Var b) / Var(b − a); NaN without spread."""


def paired(a: Floats, b: Floats, within: Range = ANY) -> Paired:
    """b − a, unit by unit; units where either is NaN are left out.

    Args:
        within: the range of a and of b.
    """
    both = ~(np.isnan(a) | np.isnan(b))
    a, b = a[both], b[both]
    spread = float(np.var(b - a, ddof=1)) if len(a) > 1 else math.nan
    apart = float(np.var(a, ddof=1) + np.var(b, ddof=1)) if len(a) > 1 else math.nan
    return Paired(mean_interval(b - a, within.of_differences()), apart / spread if spread > 0 else math.nan)


def resamples(units: int, draws: int = DRAWS, seed: int = 0) -> Floats:
    """[draws, units]: how often each unit is drawn when as many as there are are drawn with replacement."""
    if units == 0:
        return np.zeros((draws, 0))
    rng = stream(seed, 0, (), "ap.bootstrap")
    return rng.multinomial(units, np.full(units, 1.0 / units), size=draws).astype(np.float64)


def percentile_interval(draws: Floats, level: float = LEVEL) -> tuple[float, float]:
    """The percentile interval of resampled values; NaN draws (nothing to find) are left out."""
    tail = 50 * (1 - level)
    low, high = np.nanpercentile(draws, [tail, 100 - tail])
    return float(low), float(high)


def p_value(draws: Floats) -> float:
    """Two-sided p of "no difference": twice the smaller part of draws on either side of 0, the observed one counted in.

    Never below 2 / (draws + 1) (Davison and Hinkley, *Bootstrap Methods and their Application*, 1997, 4.2).
    """
    draws = draws[~np.isnan(draws)]
    tail = min(np.count_nonzero(draws <= 0), np.count_nonzero(draws >= 0))
    return min(1.0, 2.0 * (tail + 1) / (len(draws) + 1))


def benjamini_hochberg(p: Sequence[float]) -> list[float]:
    """Adjusted p-values: below q, at most a part q of the differences called real are expected to be none."""
    from scipy.stats import false_discovery_control  # here: it takes most of a second to import

    return [float(q) for q in false_discovery_control(p)] if len(p) else []
