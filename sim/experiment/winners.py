"""Where the winner changes in a campaign's rows: parts of fields in which another policy leads."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sortie.scenarios.intervals import LEVEL, Estimate, Floats, mean_interval
from sortie.sim.experiment.rows import CampaignRows, sign
from sortie.sim.results.outcome import possible


@dataclass(frozen=True, slots=True)
class OtherWinner:
    """A part of a varied field's range where another policy than the overall winner comes out first."""

    field: str
    part: str
    winner: str
    gain: Estimate
    """Of the part's winner over the overall one, paired, the interval widened for all parts looked at (Bonferroni)."""

    @property
    def sure(self) -> bool:
        """Whether the interval leaves 0 out."""
        return self.gain.low > 0


@dataclass(frozen=True, slots=True)
class Rule:
    """The best rule of the form: field below a threshold → one policy, above → another."""

    field: str
    threshold: float
    below: str
    above: str
    gain: Estimate
    """Over the best fixed policy, unit by unit, on units that had no part in finding the rule."""


def winner(rows: CampaignRows, metric: str) -> str:
    """The policy with the best mean; of a metric that has a `sign`."""
    return rows.plan.policies[_first(sign(metric) * rows.by_unit(metric))]


def other_winners(rows: CampaignRows, metric: str) -> list[OtherWinner]:
    """Every part of every varied field in which another policy than the overall winner has the best mean."""
    policies = rows.plan.policies
    best = policies.index(winner(rows, metric))
    parts = [(field, *part) for field in rows.plan.campaign.vary for part in rows.bins(field)]
    level = 1 - (1 - LEVEL) / max(1, len(parts) * (len(policies) - 1))
    others = []
    for field, label, _, mask in parts:
        means = sign(metric) * rows.by_unit(metric, mask)
        if not len(means):
            continue
        here = _first(means)
        if here != best:
            gain = mean_interval(means[:, here] - means[:, best], possible(metric).of_differences(), level)
            others.append(OtherWinner(field, label, policies[here], gain))
    return others


def _first(means: Floats) -> int:
    """Which column has the highest mean; one that never has a value has none."""
    return int(np.argmax(np.nan_to_num(means.mean(axis=0), nan=-math.inf)))


def rule(rows: CampaignRows, metric: str) -> Rule | None:
    """The best one-threshold rule, fitted on every second unit and evaluated on the others, and the other way round.

    Returns:
        The rule found on all units, with the gain that rules found on one half had on the other; None where no field
        has enough distinct numbers, one policy has values, or there are fewer than four units.
    """
    labels, unit, x, y = _cells(rows, metric)
    number = np.unique(unit, return_inverse=True)[1] if len(unit) else unit
    if len(labels) < 2 or not x or len(unit) < 8 or number.max() < 3:
        return None
    even = number % 2 == 0
    gains: list[float] = []
    for learn, judge in ((even, ~even), (~even, even)):
        fitted = _best({k: v[learn] for k, v in x.items()}, y[learn])
        if fitted is None:
            return None
        field, threshold, below, above = fitted
        fixed = int(np.argmax(y[learn].mean(axis=0)))
        chosen = np.where(x[field][judge] < threshold, y[judge][:, below], y[judge][:, above])
        gain, of = chosen - y[judge][:, fixed], number[judge]
        gains += [float(gain[of == k].mean()) for k in np.unique(of)]
    whole = _best(x, y)
    if whole is None:
        return None
    field, threshold, below, above = whole
    if below == above:
        return None
    return Rule(field, threshold, labels[below], labels[above], mean_interval(gains, possible(metric).of_differences()))


def _cells(rows: CampaignRows, metric: str) -> tuple[list[str], NDArray[np.int64], dict[str, Floats], Floats]:
    """The policies that have values, and the cells of units with scenes that count: their units, their numeric fields, and
    what each of these policies got."""
    use = np.flatnonzero(rows.counted(metric)[0])
    valued, policy = np.unique(rows.policy[use], return_inverse=True)
    cell = rows.unit[use] * rows.plan.cells + rows.table["cell"].to_numpy()[use]
    _, first, at = np.unique(cell, return_index=True, return_inverse=True)
    slot = at * len(valued) + policy
    y = np.bincount(slot, sign(metric) * rows.values(metric)[use]) / np.bincount(slot)
    x = {}
    for field in rows.plan.campaign.vary:
        column = rows.table[field].to_numpy(zero_copy_only=False)
        if column.dtype != object:
            x[field] = column[use[first]].astype(float)
    labels = [rows.plan.policies[i] for i in valued]
    return labels, rows.unit[use[first]], x, y.reshape(len(first), len(valued))


def _best(x: dict[str, Floats], y: Floats) -> tuple[str, float, int, int] | None:
    """The threshold with the highest mean, at least an eighth of the cells on either side; ties go to the first."""
    best, split = -math.inf, None
    least = max(2, len(y) // 8)
    for field, values in x.items():
        order = np.argsort(values, kind="stable")
        ordered = values[order]
        upto = np.cumsum(y[order], axis=0)
        for i in range(least, len(y) - least + 1):
            if ordered[i - 1] == ordered[i]:
                continue
            below, above = int(np.argmax(upto[i - 1])), int(np.argmax(upto[-1] - upto[i - 1]))
            score = float(upto[i - 1, below] + upto[-1, above] - upto[i - 1, above])
            if score > best + 1e-12:
                best, split = score, (field, float((ordered[i - 1] + ordered[i]) / 2), below, above)
    return split
