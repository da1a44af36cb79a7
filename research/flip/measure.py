"""What the study measures: the fall below a single drone, the flip, the oracle's gain. Free of torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from research.flip.plan import MeasuredGrid, Tau, Variant
from research.paper.measures import POINTS, ApOf, Contrast, Oracle
from research.paper.results import TAU
from research.paper.scores import Bootstrap
from research.paper.verdict import MeasuredValue as Measurement
from research.paper.ways import FULL_SHARING, SINGLE, Sharing
from sortie.perception.evaluation.harness import Evaluation
from sortie.perception.metrics.ap import Matched
from sortie.scenarios.intervals import percentile_interval


@dataclass(frozen=True, slots=True)
class F1:
    """A score threshold and what it is worth at full sharing on the tau split."""

    tau: float
    f1: float


@dataclass(frozen=True, slots=True)
class StudyRow:
    """One quantity of one network under one way to fuse, rank and cut; AP in points, interval paired over frames."""

    variant: str
    seed: int
    density: str
    unsent: str
    cells_by: str
    tau_name: str
    tau: float
    quantity: str
    """gain, level, starved, contrast, fill or oracle: see `rows_of`."""
    received_budget: float
    """The budget; NaN where there is none."""
    value: float
    low: float
    high: float
    frames: int
    """Of the test split, from its first on."""


def optimal_f1(units: Sequence[Matched], taus: NDArray[np.float64]) -> F1:
    """The threshold with the highest F1 over all units, the lowest of equal ones."""
    score = np.concatenate([u.score for u in units])
    hit = np.concatenate([u.hit for u in units])
    truths = sum(u.truths for u in units)
    found = np.array([(score >= t).sum() for t in taus])
    right = np.array([(hit & (score >= t)).sum() for t in taus])
    f1 = 2 * right / np.maximum(found + truths, 1)
    best = int(np.argmax(f1))
    return F1(float(taus[best]), float(f1[best]))


def rows_of(
    measured: MeasuredGrid, variant: Variant, seed: int, density: str, found: Evaluation, tau_f1: F1
) -> list[StudyRow]:
    """Every quantity of one network on one density's test split.

    gain: full sharing over a drone alone; level: AP itself; starved: everyone at the least budget over a drone alone;
    contrast: two peers over four at each budget; fill: zero fill over masked fusion, everyone sharing, at each budget;
    oracle: the best of each budget over the best single policy.
    """
    out: list[StudyRow] = []
    many, few = measured.policies
    starved = Sharing(measured.starved, many)
    wide = tuple(tuple(Sharing(budget, peers) for budget in measured.budgets) for peers in measured.policies)
    for cells_by in measured.cells_by:
        if replace(starved, cells_by=cells_by, unsent=measured.unsent[0]) not in found.conditions:
            continue
        for name in measured.taus:
            tau = threshold(name, tau_f1)
            cut = found.at(max(tau, found.settings.floor))
            ways = {unsent: Bootstrap(cut, unsent, cells_by) for unsent in measured.unsent}
            for unsent, scores in ways.items():
                head = (variant.name, seed, density, unsent, cells_by, str(name), tau)

                def add(quantity: str, budget: float, of: Figures, unit: float = 1.0) -> None:
                    value, low, high = (unit * v for v in of)
                    out.append(StudyRow(*head, quantity, budget, value, low, high, len(found.scene)))  # noqa: B023 (called at once)

                add("gain", np.nan, _figures(Contrast((FULL_SHARING,), (SINGLE,)).measure(scores)))
                add("level", 0.0, _figures(ApOf(SINGLE).measure(scores)), POINTS)  # levels come as 0 … 1
                add("level", 1.0, _figures(ApOf(FULL_SHARING).measure(scores)), POINTS)
                add("starved", measured.starved, _figures(Contrast((starved,), (SINGLE,)).measure(scores)))
                for budget in measured.budgets:
                    two, four = Sharing(budget, few), Sharing(budget, many)
                    add("contrast", budget, _figures(Contrast((two,), (four,)).measure(scores)))
                    for c in (two, four):
                        add(f"level {c.peers}", budget, _figures(ApOf(c).measure(scores)), POINTS)
                if unsent == "zero" and "masked" in ways:
                    for budget in (measured.starved, *measured.budgets):
                        add("fill", budget, _between(scores, ways["masked"], Sharing(budget, many)), POINTS)
                add("oracle", np.nan, _figures(Oracle(wide).measure(scores)))
    return out


Figures = tuple[float, float, float]
"""A value with its interval; NaN where there is none."""


def _figures(m: Measurement) -> Figures:
    return m.value, np.nan if m.low is None else m.low, np.nan if m.high is None else m.high


def _between(a: Bootstrap, b: Bootstrap, condition: Sharing) -> Figures:
    """AP of one condition under a minus under b, 0 … 1, on the same resamples."""
    low, high = percentile_interval(a.draws(condition, "full") - b.draws(condition, "full"))
    return a.ap(condition, "full") - b.ap(condition, "full"), low, high


def threshold(name: Tau, tau_f1: F1) -> float:
    """The score threshold that a name of the plan stands for."""
    if name == "model":
        return TAU
    return tau_f1.tau if name == "f1" else float(name)


def to_table(rows: Sequence[StudyRow]) -> pa.Table:
    """Rows as an Arrow table, columns as `StudyRow` names them."""
    return pa.Table.from_pylist([asdict(r) for r in rows])


def from_table(table: pa.Table) -> list[StudyRow]:
    """The rows of such a table."""
    return [StudyRow(**r) for r in table.to_pylist()]
