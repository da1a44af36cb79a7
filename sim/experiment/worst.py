"""The worst runs of a campaign by one of its metrics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sortie.sim.experiment.rows import read_rows, sign
from sortie.sim.folders import RunError


class Worst(NamedTuple):
    """Some runs of a campaign, the worst first."""

    metric: str
    more_is_worse: bool
    varied: Sequence[str]
    """The fields that the campaign varies."""
    rows: Sequence[dict[str, Any]]
    """The campaign's rows: run, policy, seed, the varied fields and the metrics."""


def worst(
    folder: Path, metric: str, count: int = 10, policy: str | None = None, *, more_is_worse: bool | None = None
) -> Worst:
    """The finished runs with the worst values of a metric; equal values in the order of their runs.

    Args:
        folder: the campaign's folder.
        metric: one of the campaign's metrics.
        count: at most so many.
        policy: runs of this policy alone, as the table names it.
        more_is_worse: None takes what is known of the metric.

    Raises:
        RunError: no campaign there, no such metric or policy, or a metric of which nobody knows what is worse.
    """
    rows = read_rows(folder)
    metrics = list(rows.plan.campaign.metrics)
    if metric not in metrics:
        raise RunError(f"{metric}: no metric of {folder}, must be {', '.join(metrics)}")
    if policy is not None and policy not in rows.plan.policies:
        raise RunError(f"{policy}: no policy of {folder}, must be {', '.join(rows.plan.policies)}")
    if more_is_worse is None:
        if sign(metric) == 0:
            raise RunError(f"{metric}: whether more of it is worse is not known, say --most or --least")
        more_is_worse = sign(metric) < 0
    table = rows.all
    values = np.asarray(table[metric].to_numpy(zero_copy_only=False), float)
    wanted = ~np.isnan(values)
    if policy is not None:
        wanted &= np.array([name == policy for name in table["policy"].to_pylist()])
    chosen = np.flatnonzero(wanted)
    order = chosen[np.argsort(-values[chosen] if more_is_worse else values[chosen], kind="stable")][:count]
    return Worst(metric, more_is_worse, list(rows.plan.campaign.vary), table.take(order).to_pylist())
