"""Rules that every model from outside must keep, whatever its kind. `sortie.sim.check.kits` has the kinds.

A model is asked cases. It must answer each of them, and a case must get the same answer whatever was asked before. A model
that breaks this gives other records for the same scenario and seed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np

from sortie.policies.verification.kit.conformance import Check
from sortie.scenarios.plugins.reference import PluginError

Rule = Callable[[], str | None]
"""Returns a complaint, or None where the rule is kept."""


@dataclass(frozen=True)
class Subject:
    """A model, loaded and ready to be asked."""

    ask: Callable[[Any], Any]
    """From a case to the answer, by the checks that a flight does.

    Raises:
        PluginError: the answer is none, in one line.
    """
    cases: Mapping[str, Any]
    """By what they are about."""
    rules: Mapping[str, Rule] = field(default_factory=dict)
    """Those of this kind alone."""


def conform(load: Callable[[], Subject]) -> list[Check]:
    """Check a model against the rules of every kind and of its own.

    Args:
        load: loads the model anew.

    Raises:
        PluginError: the model is not there, or does not load.

    Returns:
        One check for each rule, always in the same order. Where a case has no answer, the other rules are not checked.
    """
    subject = load()
    answers: dict[str, Any] = {}
    for name, case in subject.cases.items():
        try:
            answers[name] = plain(subject.ask(case))
        except PluginError as error:
            return [Check("answers", "fails", f"{name}: {error}")]
    checks = [Check("answers", "holds", f"{len(answers)} cases: {', '.join(answers)}")]
    rules: dict[str, Rule] = {
        "same answer again": lambda: _differs(answers, load(), list(answers), "take random numbers from what is given"),
        "no memory": lambda: _differs(answers, subject, [*reversed(answers)], "keep nothing from one call for others"),
        **subject.rules,
    }
    for name, rule in rules.items():
        try:
            complaint = rule()
        except PluginError as error:
            complaint = str(error)
        checks.append(Check(name, "fails" if complaint else "holds", complaint or f"kept in {len(answers)} cases"))
    return checks


def _differs(answers: Mapping[str, Any], subject: Subject, order: Sequence[str], advice: str) -> str | None:
    for name in order:
        if plain(subject.ask(subject.cases[name])) != answers[name]:
            return f"{name}: another answer than the first time; {advice}"
    return None


def plain(value: Any) -> Any:
    """A value as tuples and bytes that can be compared. Objects without values, such as generators, count as equal."""
    if hasattr(value, "detach"):  # a torch tensor
        value = value.detach().numpy()
    if isinstance(value, np.ndarray):
        return value.shape, str(value.dtype), value.tobytes()
    if isinstance(value, Mapping):
        return tuple((key, plain(each)) for key, each in value.items())
    if isinstance(value, list | tuple):
        return tuple(plain(each) for each in value)
    if is_dataclass(value):
        return tuple(plain(getattr(value, each.name)) for each in fields(value))
    return value if isinstance(value, str | int | float | bytes | None) else type(value).__name__
