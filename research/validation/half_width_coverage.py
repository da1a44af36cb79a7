"""Whether a comparison to a half-width is unbiased, and how often its intervals contain the truth.

    make figures FIGURE=half_width     # for research/pages/price.md; half a minute of processor time

The plan, written before it was run. The factor by which intervals are widened (`control_variates.STOPPING`), the pilot of 12
and the batches had been chosen before, by runs of a similar simulation with other random numbers.

- **Made data**: a pair of measurements with a known mean of 0 and a correlation of 0, 0.6 or 0.9; normal, with a skewness of
  0.5 (gamma, shape 16), or with heavy tails (Student's with 6 degrees of freedom). The half-width is such that the expensive
  measurement alone needs 12, 30 or 80 units. An expensive unit costs 17 cheap ones. Every case has 400 repetitions of the
  whole procedure (`half_width.next_batch`), pilot, plans and stop included.
- **Sorties**: the gains of 2,000 sorties of the surrogate (`compare_coverage.csv`, second run), drawn with replacement. The
  gain over `worked` in the mission disc stands as the expensive measurement: that of full sharing, with the gain of silence in
  the same sortie as the cheap measurement (correlation 0.83), and that of silence, with its gain in the full scene (0.52). Both
  are skewed with heavy tails. The truth is the mean of the 2,000. Half-widths of 1.5 and 3 AP points, 400 repetitions each.
- **Hypothesis 1**: the printed intervals of all made data together contain the truth in 93 to 97 %, and so do those of all
  sorties. No case leaves 93 to 97 % by more than two of its standard errors (1.1 points).
- **Hypothesis 2**: without widening they contain it less often: fewer than 94 % of all made data.
- **Hypothesis 3**: the mean of the estimates differs from the truth by at most a tenth of the half-width in every case.
- **Bias at fixed numbers of units**: 12 with both measurements, 48 with the cheap one, both exponential, and the expensive one
  follows the square of the cheap one. 10,000 repetitions. Hypothesis 4: the mean of the estimates with a coefficient for each
  unit differs from the truth by at most three standard errors; with one coefficient from all units it differs by more.

A first form of this plan had 1,000 and 40,000 repetitions. It was cut off before it had printed anything, for want of processor
time.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from research.validation.stored import Cell, Column, Table
from sortie.scenarios.control_variates import controlled_mean, widened
from sortie.sim.experiment.half_width import FURTHER, Batch, Flown, Row, Settings, next_batch

Floats = NDArray[np.float64]
Source = Callable[[int], Floats]
"""So many units: [n, 2], the expensive measurement and the cheap one."""
SORTIES = Path(__file__).parent / "compare_coverage.csv"
REPETITIONS = 400
HALF_WIDTH = 0.01
CORRELATIONS = (0.0, 0.6, 0.9)
UNITS = (12, 30, 80)
COST = 17.0
OF_SORTIES = {
    "full sharing": ("all-4 mission", "silence mission"),
    "silence": ("silence mission", "silence full_scene"),
}
POLICY, METRIC = "policy", "ap50.full_scene"
SHAPES: dict[str, Callable[[np.random.Generator, tuple[int, int]], Floats]] = {
    "normal": lambda rng, size: rng.normal(size=size),
    "skewed": lambda rng, size: rng.gamma(16, size=size) / 4 - 4,
    "heavy tails": lambda rng, size: rng.standard_t(6, size=size) / math.sqrt(1.5),
}
"""Independent numbers with a mean of 0 and a variance of 1."""


def made(rng: np.random.Generator, shape: str, correlation: float, deviation: float) -> Source:
    """Made data of a shape."""

    def draw(count: int) -> Floats:
        z = SHAPES[shape](rng, (count, 2))
        high = correlation * z[:, 0] + math.sqrt(1 - correlation**2) * z[:, 1]
        return deviation * np.column_stack([high, z[:, 0]])

    return draw


def sorties(expensive: str, cheap: str) -> Floats:
    """[sorties, 2]: two gains over `worked` of the second run, by the names of their columns."""
    with SORTIES.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if 4_010_001 <= int(row["seed"]) < 4_020_001]
    gains = np.array([[float(row[name] or "nan") for name in (expensive, cheap)] for row in rows])
    return gains[~np.isnan(gains).any(axis=1)]


def compared(source: Source, half_width: float) -> Flown:
    """A whole comparison to a half-width on data from a source."""
    settings, flown = Settings(half_width, METRIC, most=2000), Flown()
    while (batch := next_batch(flown, [POLICY], settings)) is not None:
        _fly(flown, batch, source)
        flown.plans.append(batch)
    return flown


def _fly(flown: Flown, batch: Batch, source: Source) -> None:
    for high, low in source(batch.paired - len(flown.torch)):
        seed = len(flown.torch)
        flown.torch.append(Row("torch", seed, {POLICY: {METRIC: high}}, COST))
        flown.surrogate.append(Row("surrogate", seed, {POLICY: {METRIC: low}}, 1.0))
    further = batch.further - sum(row.seed >= FURTHER for row in flown.surrogate)
    for _, low in source(max(further, 0)):
        flown.surrogate.append(Row("surrogate", FURTHER + len(flown.surrogate), {POLICY: {METRIC: low}}, 1.0))


def repeated(source: Source, truth: float, half_width: float, repetitions: int = REPETITIONS) -> Floats:
    """[repetitions, 6]: whether the printed and the plain interval contain the truth, the error in half-widths, the paired
    and the further units, and whether the cheap measurement was used."""
    found = []
    for _ in range(repetitions):
        flown = compared(source, half_width)
        plain = flown.estimate(POLICY, METRIC, control=flown.control).estimate
        printed = widened(plain)
        contain = [float(e.low <= truth <= e.high) for e in (printed, plain)]
        error, further = (plain.mean - truth) / half_width, len(flown.surrogate) - len(flown.torch)
        found.append([*contain, error, len(flown.torch), further, float(flown.control)])
    return np.array(found)


def tables() -> dict[str, Table]:
    """`half_width`: cover, bias and units of every case; `fixed_units`: bias at fixed numbers of units."""
    rng = np.random.default_rng(27)
    rows: list[list[Cell]] = []
    every = []
    for shape in SHAPES:
        for correlation in CORRELATIONS:
            for units in UNITS:
                source = made(rng, shape, correlation, HALF_WIDTH * math.sqrt(units) / 1.96)
                every.append(repeated(source, 0.0, HALF_WIDTH))
                rows.append([f"{shape}, correlation {correlation:g}, {units} units", *_columns(every[-1])])
    rows.append(["all made data", *_columns(np.concatenate(every))])
    every = []
    for told, names in OF_SORTIES.items():
        gains = sorties(*names)
        for half_width in (0.015, 0.03):
            source = lambda count, gains=gains: gains[rng.integers(len(gains), size=count)]  # noqa: E731
            every.append(repeated(source, float(gains[:, 0].mean()), half_width))
            rows.append([f"sorties, {told}, ±{100 * half_width:g} points", *_columns(every[-1])])
    rows.append(["all sorties", *_columns(np.concatenate(every))])
    share = {"form": ".1f", "factor": 100}
    columns = [
        Column("case"), Column("printed interval", **share), Column("plain interval", **share),  # type: ignore[arg-type]
        Column("mean error, half-widths", ".3f"), Column("paired units", ".1f"), Column("further units", ".1f"),
        Column("surrogate used", ".0f", factor=100),
    ]  # fmt: skip
    about = f"{REPETITIONS:,} repetitions each. Shares in per cent: how often an interval contains the truth."
    return {"half_width": Table(columns, rows, about), "fixed_units": fixed_units(rng)}


def _columns(found: Floats) -> list[Cell]:
    return [float(v) for v in found.mean(axis=0)]


def fixed_units(rng: np.random.Generator, repetitions: int = 10_000) -> Table:
    """The mean error of both ways to choose the coefficient, with its 95 % interval, in standard deviations of the estimate."""
    errors: dict[str, list[float]] = {
        "a coefficient for each unit, from the others": [],
        "one coefficient from all units": [],
    }
    for _ in range(repetitions):
        x, more = rng.exponential(size=12), rng.exponential(size=48)
        y = x**2 + rng.normal(size=12)
        one = 48 / 60 * float(np.cov(x, y)[0, 1] / np.var(x, ddof=1))
        ways = controlled_mean(y, x, more).estimate.mean, float(y.mean()) - one * float(x.mean() - more.mean())
        for kept, value in zip(errors.values(), ways, strict=True):
            kept.append(value - 2.0)
    rows: list[list[Cell]] = []
    for name, values in errors.items():
        mean, deviation = float(np.mean(values)), float(np.std(values))
        off = 1.96 / math.sqrt(repetitions)
        rows.append([name, (mean / deviation, mean / deviation - off, mean / deviation + off)])
    about = f"{repetitions:,} repetitions; mean error in standard deviations of the estimate."
    return Table([Column("coefficient"), Column("mean error", "+.3f")], rows, about)
