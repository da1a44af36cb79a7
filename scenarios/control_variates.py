"""Means of an expensive measurement, with a cheap one of the same draws as control variate. Pure functions.

The expensive measurement (the torch detector) is made on n units, the cheap one (the surrogate) on the same n and on m
others. The mean of the cheap one over the n units, compared with its mean over all n + m, corrects the mean of the
expensive one. That mean stays unbiased whatever the error of the cheap one. The higher the correlation, the more precise it is.

This is the approximate control variate of Peherstorfer, Willcox and Gunzburger (*Optimal Model Management for Multifidelity
Monte Carlo Estimation*, 2016) and Gorodetsky et al. (*A Generalized Approximate Control Variate Framework for Multifidelity
Uncertainty Quantification*, 2020) with one cheap model.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sortie.scenarios.intervals import LEVEL, Estimate, mean_interval
from sortie.scenarios.plain_sum import plain_sum

LEAST_PAIRS = 4
"""Below so many units with both measurements there is no coefficient; the expensive ones are averaged alone."""
MOST_CHEAP = 100.0
"""Cheap units that are planned for each expensive one, at most."""


@dataclass(frozen=True, slots=True)
class Controlled:
    """A mean of the expensive measurement, and what the cheap one added to it."""

    estimate: Estimate
    """`count` is the number of units with the expensive measurement."""
    coefficient: float
    """By which the cheap measurement's deviation is subtracted: the mean of the units' own; 0 without a control variate."""
    correlation: float
    """Of the two measurements over the units that have both; NaN where either does not vary."""
    explained: float
    """Share of the expensive measurement's variance that the cheap one predicts for units that were left out; below 0 where
    predicting does harm. Lower than the squared correlation, as the coefficient is estimated."""
    variance: float
    """Of the expensive measurement among units; NaN below two."""


def controlled_mean(
    expensive: ArrayLike, cheap: ArrayLike, more: ArrayLike, level: float = LEVEL, *, control: bool = True
) -> Controlled:
    """The mean of the expensive measurement, corrected by the cheap one.

    Each unit's coefficient is estimated from the other units (leave one out). It so depends on nothing that it is multiplied
    with, and the mean is unbiased for any error of the cheap measurement. With one coefficient from all units it would be
    biased where the differences are skewed.

    Args:
        expensive, cheap: [n], both measurements of the same units; units where either is NaN are left out.
        more: [m], the cheap measurement of other units; NaN are left out.
        level: of the two-sided interval.
        control: False averages the expensive measurement alone, with Student's interval.

    Returns:
        The mean with an interval by Welch's degrees of freedom: the corrected units have n − 2, the other units m − 1.
        Without `more`, below four pairs, or where the cheap measurement does not vary: Student's interval of `expensive`.

    Raises:
        ValueError: `expensive` and `cheap` have different lengths.

    Example:
        >>> found = controlled_mean([1.0, 2.1, 2.9, 4.2, 5.0], [0, 1, 2, 3, 4], [1.5, 2.0, 2.5, 2.0, 1.0, 3.0])
        >>> round(found.coefficient, 2), round(found.correlation, 3)
        (0.55, 0.998)
    """
    y, x = (np.asarray(v, float).ravel() for v in (expensive, cheap))
    if len(y) != len(x):
        raise ValueError(f"{len(y)} expensive and {len(x)} cheap measurements, must be of the same units")
    both = ~(np.isnan(y) | np.isnan(x))
    y, x = y[both], x[both]
    others = np.asarray(more, float).ravel()
    others = others[~np.isnan(others)]
    n, m = len(y), len(others)
    variance = float(np.var(y, ddof=1)) if n > 1 else math.nan
    alone = mean_interval(y, level=level)
    if n < LEAST_PAIRS or np.ptp(x) == 0:
        return Controlled(alone, 0.0, math.nan, 0.0, variance)
    slopes, error = _left_out(y, x)
    explained = 1.0 - error / (variance * n * n / (n - 1)) if variance > 0 else 0.0
    correlation = float(np.corrcoef(x, y)[0, 1]) if variance > 0 else math.nan
    if not control or m < 2:
        return Controlled(alone, 0.0, correlation, explained, variance)
    coefficients = m / (n + m) * slopes
    corrected = y - coefficients * (x - others.mean())
    coefficient = float(coefficients.mean())
    parts = float(np.var(corrected, ddof=1)) / n, coefficient**2 * float(np.var(others, ddof=1)) / m
    off = _welch(parts, (n - 2, m - 1), level)
    mean = float(corrected.mean())
    return Controlled(Estimate(mean, mean - off, mean + off, n), coefficient, correlation, explained, variance)


def _left_out(y: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, float]:
    """Slopes of y on x without each unit [n], and the sum of squared errors of predicting each from the others."""
    n, off = len(y), x - x.mean()
    spread = float(off @ off)
    leverage = np.minimum(1 / n + off**2 / spread, 1 - 1e-9)  # of 1: the unit alone determines the slope
    slope = float(off @ y) / spread
    residual = (y - y.mean() - slope * off) / (1 - leverage)
    return slope - off * residual / spread, float(residual @ residual)


def _welch(parts: tuple[float, float], degrees: tuple[float, float], level: float) -> float:
    """Half the interval of a sum of two independent means with these squared standard errors."""
    from scipy.special import stdtrit  # here: half of what this module takes to import

    total = plain_sum(parts)
    if total == 0:
        return 0.0
    freedom = total**2 / plain_sum(part**2 / of for part, of in zip(parts, degrees, strict=True))
    return float(stdtrit(freedom, 0.5 + level / 2)) * math.sqrt(total)


STOPPING = 3.0
"""An interval at which a comparison stopped is widened by the square root of 1 + this / units (`widened`)."""


def widened(found: Estimate) -> Estimate:
    """An interval as it is read where flying stops as soon as it is narrow enough.

    Such a stop comes too early where the spread happens to be small, so that plain intervals cover less than they say, by an
    amount that falls as 1 / units. The factor was chosen by simulation; `make figures FIGURE=half_width` measures the cover with
    it, by other random numbers (`research/pages/price.md`).

    Example:
        >>> widened(Estimate(0.0, -1.0, 1.0, 12)).half_width
        1.118033988749895
    """
    off = found.half_width * _factor(found.count) if found.count else math.nan
    return Estimate(found.mean, found.mean - off, found.mean + off, found.count)


def _factor(units: int) -> float:
    return math.sqrt(1 + STOPPING / units)


class Plan(NamedTuple):
    """How many units are to be measured in all."""

    expensive: int
    """Units with both measurements; with the expensive one alone where `cheap` is 0."""
    cheap: int
    """Further units with the cheap measurement; 0: the expensive one alone costs no more."""
    cost_ratio: float
    """Predicted cost of the plan relative to the expensive measurement alone at the same half-width; at most 1."""


def plan_units(
    pilot: Sequence[Controlled],
    half_width: float,
    expensive_s: float,
    cheap_s: float,
    level: float = LEVEL,
    *,
    measured: int = 0,
    control: bool = True,
) -> Plan:
    """The cheapest number of units that brings every quantity's half-width below a limit, as `widened` has it.

    Args:
        pilot: each quantity, as measured so far; all of them come from the same units.
        half_width: the limit.
        expensive_s, cheap_s: cost of either measurement of a unit, in one unit of cost.
        level: of the interval.
        measured: units that have both measurements already; the plan has no fewer.
        control: False plans for the expensive measurement alone.

    Returns:
        The plan. With `r` cheap units for each expensive one a quantity has the variance
        variance / n · (1 − explained · r / (1 + r)); the quantity that needs most decides.

    Example:
        >>> import numpy as np
        >>> x = np.random.default_rng(1).normal(size=40)
        >>> good = controlled_mean(x + 0.2 * np.random.default_rng(2).normal(size=40), x, [])
        >>> plan = plan_units([good], 0.2, expensive_s=100.0, cheap_s=1.0)
        >>> plan.expensive < plan_units([good], 0.2, 100.0, 1.0, control=False).expensive, plan.cost_ratio < 0.5
        (True, True)
    """
    alone = max(p.variance for p in pilot)

    def variance(total: float) -> float:
        """Of one expensive unit's share, with `total` cheap units for each expensive one, its own included."""
        return max(p.variance * (1 - max(p.explained, 0.0) * (1 - 1 / total)) for p in pilot)

    def cost(log_total: float) -> float:
        total = math.exp(log_total)
        return variance(total) * (expensive_s + total * cheap_s)

    if control and alone > 0:
        from scipy.optimize import minimize_scalar

        most = math.log(1 + MOST_CHEAP)
        best = minimize_scalar(cost, bounds=(0.0, most), method="bounded", options={"xatol": 1e-3})
        ratio, total = float(best.fun) / (alone * expensive_s), math.exp(float(best.x))
        if ratio < 1.0:
            n = _units(variance(total), half_width, 2, level)
            if n >= measured:
                return Plan(n, math.ceil(n * (total - 1)), ratio)
            enough = (half_width / _off(measured, 2, level)) ** 2  # the variance that so many units may have
            return Plan(measured, max(_cheap_units(p, measured, enough) for p in pilot), ratio)
    return Plan(max(_units(alone, half_width, 1, level), measured), 0, 1.0)


def _cheap_units(found: Controlled, n: int, enough: float) -> int:
    """How many cheap units bring the variance of a unit's share of n down to what is enough."""
    share = (1 - enough / found.variance) / found.explained if found.explained > 0 < found.variance else 0.0
    most = MOST_CHEAP / (1 + MOST_CHEAP)
    return math.ceil(n * share / (1 - share)) if 0 < share < most else math.ceil(n * MOST_CHEAP) if share > 0 else 0


def _off(n: int, lost: int, level: float) -> float:
    """The widened half-width of n units with a variance of 1 and n − `lost` degrees of freedom."""
    from scipy.special import stdtrit

    return float(stdtrit(n - lost, 0.5 + level / 2)) * _factor(n) / math.sqrt(n)


def _units(variance: float, half_width: float, lost: int, level: float) -> int:
    """The least number of units at which the widened interval is below the limit."""
    from scipy.special import ndtri

    n = max(LEAST_PAIRS, math.ceil((float(ndtri(0.5 + level / 2)) / half_width) ** 2 * variance))
    while _off(n, lost, level) * math.sqrt(variance) > half_width:
        n += 1
    return n
