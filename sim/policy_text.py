"""A policy as people name it, `best-2(received_budget=0.1)`, as the `--set` overrides that make it the scenario's own."""

from __future__ import annotations

from sortie.policies.contract import PolicyError
from sortie.policies.registry import resolve
from sortie.scenarios.reading.call_text import read_call, split_at_commas
from sortie.scenarios.reading.load import build
from sortie.scenarios.schema import Scenario


def policy_overrides(text: str, own: str) -> list[str]:
    """Overrides for a policy; another one than the scenario's `own` starts from its own defaults.

    Raises:
        PolicyError: as `name_and_params`.
    """
    name, params = name_and_params(text)
    overrides = [f"policy.name={name}"]
    if params is not None or name != own:
        overrides.append("policy.params={}")
    if name != own:
        overrides += ["policy.commands=[]", "policy.changes=[]"]  # it flies to the end
        overrides.append("policy.of_makes=false")  # and on every drone
    return overrides + [f"policy.params.{p}" for p in params or ()]


def flown_by(scenario: Scenario, policy: str) -> Scenario:
    """The same scenario and draws with another policy in it.

    Raises:
        PolicyError, ScenarioError: no such policy, or one of its parameters is wrong.
    """
    sections = scenario.model_dump(mode="json", exclude_none=True)
    flown = build(sections, policy_overrides(policy, scenario.policy.name), scenario.name)
    resolve(flown.policy.name, flown.policy.params)
    return flown


def name_and_params(text: str, kind: str = "policy") -> tuple[str, list[str] | None]:
    """`name(key=value, …)` as the name and its parameters as written; None where there is no bracket.

    Raises:
        PolicyError: a bracket is not closed, or holds something else than `key=value`.
    """
    if split_at_commas(text) is None:
        raise PolicyError(f"{kind} {text!r}: the bracket is not closed, as in best-2(received_budget=0.1)")
    name, params = read_call(text.strip()) or (text.strip(), None)
    for param in params or ():
        if "=" not in param:
            raise PolicyError(f"{kind} {text!r}: {param!r} in the bracket, must be key=value")
    return name, params
