"""What a scenario names and what is not there: files, models in files and their parameters, and metrics that it expects."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sortie.policies.registry import resolve as resolve_policy
from sortie.scenarios.errors import SortieError
from sortie.scenarios.plugins.reference import installed, is_file, resolve
from sortie.scenarios.reading.files import models_with_params, named_files
from sortie.scenarios.schema import Scenario
from sortie.scenarios.shipped import located
from sortie.sim.folders import RunError
from sortie.sim.policy_text import flown_by
from sortie.sim.results.outcome import kind_at, open_keys


def not_there(scenario: Scenario) -> list[str]:
    """A line for each file that a scenario names and that is missing, for each model that cannot be made, and for each
    expected metric that no outcome has.

    Files of models are loaded, as for a flight; no model is called.
    """
    sections = scenario.model_dump(mode="json", exclude_none=True)
    models = list(models_with_params(sections))
    own = {name.rpartition(":")[0] for _, name, _ in models if is_file(name)}
    missing = [name for name in named_files(sections) if name not in own and not located(Path(name)).exists()]
    lines = [*(f"no file {name}" for name in missing), *_refused(models), *_misspelt(scenario), *_unknown(scenario)]
    return list(dict.fromkeys(lines))


def _refused(models: list[tuple[str, str, dict[str, object]]]) -> Iterator[str]:
    for kind, name, params in models:
        try:
            if kind == "policy":
                resolve_policy(name, params)
            elif is_file(name) or name in installed(kind):
                resolve(kind, name, params)
        except SortieError as error:
            yield str(error)


def _unknown(scenario: Scenario) -> Iterator[str]:
    """Policies that expectations are over and that cannot be made."""
    for i, expectation in enumerate(scenario.expect):
        try:
            if expectation.over is not None:
                flown_by(scenario, expectation.over)
        except SortieError as error:
            yield f"expect.{i}.over: {error}"


def _misspelt(scenario: Scenario) -> Iterator[str]:
    keys = open_keys(
        scenario.fleet.drones,
        len(scenario.mission.phases),
        (),
        traced=scenario.fleet.trace is not None,
        metrics=scenario.metrics,
    )
    for i, expectation in enumerate(scenario.expect):
        if expectation.metric.startswith("policies.decisions."):
            continue  # by the names of policies, which plug-ins choose
        try:
            kind_at(expectation.metric, keys)
        except RunError as error:
            yield f"expect.{i}.metric: {error}"
