"""The models from outside that a scenario names, found and with their parameters bound."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sortie.scenarios.plugins.reference import resolve
from sortie.scenarios.reading.files import builtin
from sortie.scenarios.schema import Scenario


def of_radio(scenario: Scenario) -> dict[str, Callable[..., Any]]:
    """Settings of the air that are models from outside.

    Raises:
        PluginError: a model that is not there, does not load, or has no such parameter.
    """
    found = {}
    for name in ("path_loss", "link"):
        reference, params = getattr(scenario.radio, name), getattr(scenario.radio, f"{name}_params")
        if reference is not None and reference not in builtin(f"radio.{name}"):
            found[name] = resolve(name, reference, params)
    return found
