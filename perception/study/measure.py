"""What the study asks of an evaluation: the fall below a single drone, the flip, the oracle's gain. Free of torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from perception.ap import Matched
from perception.harness.condition import FULL_SHARING, SINGLE, Condition
from perception.harness.evaluation import Evaluation
from perception.harness.measures import POINTS, Contrast, Level, Oracle
from perception.harness.scores import Bootstrap
from perception.study.plan import Measured, Tau, Variant

MODEL_TAU = 0.1


@dataclass(frozen=True, slots=True)
class F1:
    """A score threshold and what it is worth at full sharing on the tau split."""

    tau: float
    f1: float


@dataclass(frozen=True, slots=True)
class Row:
    """One quantity of one network under one way to fuse, rank and cut; AP in points, interval paired over frames."""

    variant: str
    seed: int
    density: str
    unsent: str
    cells_by: str
    tau_name: str
    tau: float
    quantity: str
    """gain, starved, level, contrast or oracle."""
    rho: float
    """The budget; NaN where there is none."""
    value: float
    low: float
    high: float


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


def rows_of(measured: Measured, variant: Variant, seed: int, density: str, found: Evaluation, tau_f1: F1) -> list[Row]:
    """Every quantity of one network on one density's test split.

    gain: full sharing over a drone alone; starved: everyone at the least budget over a drone alone; level: AP itself;
    contrast: two peers over four at each budget; oracle: the best of each budget over the best single policy.
    """
    out: list[Row] = []
    many, few = measured.policies
    wide = tuple(tuple(Condition(rho, peers) for rho in measured.budgets) for peers in measured.policies)
    for unsent in measured.unsent:
        for cells_by in measured.cells_by:
            asked = Condition(measured.starved, many, cells_by=cells_by, unsent=unsent)
            if asked not in found.conditions:
                continue
            for name in measured.taus:
                tau = threshold(name, tau_f1)
                scores = Bootstrap(found.at(max(tau, found.settings.floor)), unsent, cells_by)

                def row(quantity: str, rho: float, what: Contrast | Level | Oracle) -> Row:
                    m = what.measure(scores)  # noqa: B023 (called at once)
                    low, high = (np.nan if v is None else v for v in (m.low, m.high))
                    head = (variant.name, seed, density, unsent, cells_by, str(name), tau)  # noqa: B023
                    unit = POINTS if isinstance(what, Level) else 1.0  # levels come as 0 … 1
                    return Row(*head, quantity, rho, unit * m.value, unit * low, unit * high)

                out.append(row("gain", np.nan, Contrast((FULL_SHARING,), (SINGLE,))))
                out.append(row("level", 0.0, Level(SINGLE)))
                out.append(row("level", 1.0, Level(FULL_SHARING)))
                starved = Condition(measured.starved, many)
                out.append(row("starved", measured.starved, Contrast((starved,), (SINGLE,))))
                for rho in measured.budgets:
                    two, four = Condition(rho, few), Condition(rho, many)
                    out.append(row("contrast", rho, Contrast((two,), (four,))))
                    out += [row(f"level {c.peers}", rho, Level(c)) for c in (two, four)]
                out.append(row("oracle", np.nan, Oracle(wide)))
    return out


def threshold(name: Tau, tau_f1: F1) -> float:
    """The score threshold that a name of the plan stands for."""
    if name == "model":
        return MODEL_TAU
    return tau_f1.tau if name == "f1" else float(name)


def to_table(rows: Sequence[Row]) -> pa.Table:
    """Rows as an Arrow table, columns as `Row` names them."""
    return pa.Table.from_pylist([asdict(r) for r in rows])


def from_table(table: pa.Table) -> list[Row]:
    """The rows of such a table."""
    return [Row(**r) for r in table.to_pylist()]
