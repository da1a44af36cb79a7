"""Figures of one's own: a user's functions compute them from the record of a sortie."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Real
from typing import Protocol

from sortie.scenarios.plugins.reference import PluginError, checked_call, resolve
from sortie.sim.results.record import SortieRecord


class OwnMetric(Protocol):
    """A figure of one's own. Keyword-only arguments are its parameters."""

    def __call__(self, record: SortieRecord) -> float | None:
        """The figure, from `record.tables` (Arrow tables by name) and `record.scenario`; None where there is none."""


def own_metrics(record: SortieRecord) -> Mapping[str, float | None]:
    """What the scenario's metrics come to.

    Raises:
        PluginError: a metric that is not there, fails, or returns something else than a finite number or None.
    """
    found: dict[str, float | None] = {}
    for name, metric in record.scenario.metrics.items():
        value = checked_call("metric", resolve("metric", metric.model, metric.params), record)
        if value is not None and not (isinstance(value, Real) and math.isfinite(value)):
            raise PluginError(f"metric {name} ({metric.model}): returns {value!r:.60}, must be a finite number or None")
        found[name] = None if value is None else float(value)
    return found
