"""Figures of one's own: a user's functions compute them from the record of a sortie."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Real
from typing import Protocol

import numpy as np

from sortie.scenarios.plugins.reference import PluginError, checked_call, real_array, resolve
from sortie.scenarios.schema import Scenario
from sortie.sim.results.record import SortieRecord


class OwnMetric(Protocol):
    """A figure of one's own. Keyword-only arguments are its parameters."""

    def __call__(self, record: SortieRecord) -> float | None:
        """The figure, from `record.tables` (Arrow tables by name) and `record.scenario`; None where there is none."""


def loaded(scenario: Scenario) -> Mapping[str, OwnMetric]:
    """The scenario's metrics by name, loaded before the flight, so that one that is missing is told at once.

    Raises:
        PluginError: a metric that is not there, does not load, or has no such parameter.
    """
    return {name: resolve("metric", metric.model, metric.params) for name, metric in scenario.metrics.items()}


def own_metrics(metrics: Mapping[str, OwnMetric], record: SortieRecord) -> Mapping[str, float | None]:
    """What metrics come to. Errors as for `own_metric`."""
    models = record.scenario.metrics
    return {name: own_metric(f"{name} ({models[name].model})", metric, record) for name, metric in metrics.items()}


def own_metric(name: str, metric: OwnMetric, record: SortieRecord) -> float | None:
    """What one metric comes to.

    Raises:
        PluginError: it fails, or returns something else than a finite number or None.
    """
    value = checked_call("metric", metric, record)
    if value is None:
        return None
    found = real_array(value) if isinstance(value, Real) else None
    if found is None or not np.isfinite(found):
        raise PluginError(f"metric {name}: returns {value!r:.60}, must be a finite number or None")
    return float(found)
