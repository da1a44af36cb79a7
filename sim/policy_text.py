"""A policy as people name it, `best-2(received_budget=0.1)`, as the `--set` overrides that make it the scenario's own."""

from __future__ import annotations

from sortie.policies.contract import PolicyError


def policy_overrides(text: str, own: str) -> list[str]:
    """Overrides for a policy; another one than the scenario's `own` starts from its own defaults.

    Raises:
        PolicyError: the bracket is not closed.
    """
    name, bracket, rest = text.partition("(")
    name = name.strip()
    if bracket and not rest.endswith(")"):
        raise PolicyError(f"policy {text!r}: the bracket is not closed, as in best-2(received_budget=0.1)")
    overrides = [f"policy.name={name}"]
    if bracket or name != own:
        overrides.append("policy.params={}")
    if name != own:
        overrides += ["policy.commands=[]", "policy.changes=[]"]  # it flies to the end
        overrides.append("policy.of_makes=false")  # and on every drone
    return overrides + [f"policy.params.{p.strip()}" for p in rest[:-1].split(",") if p.strip()]
