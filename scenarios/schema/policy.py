"""`policy`: who decides, when that changes, and what must hold."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from sortie.scenarios.schema.base import DroneId, Params, PhaseName, Section, inconsistent


class PolicyChange(Section):
    at_s: float | None = Field(None, ge=0, description="Takes over at this time …")
    phase: PhaseName | None = Field(None, description="… or whenever a drone's own phase turns to this …")
    command: str | None = Field(None, min_length=1, description="… or on this command; one of the three is given.")
    name: str = Field(min_length=1, description="The policy that takes over, as policy.name.")
    params: Params = Field({}, description="Its keyword arguments.")

    @model_validator(mode="after")
    def _one_trigger(self) -> PolicyChange:
        given = [n for n in ("at_s", "phase", "command") if getattr(self, n) is not None]
        if len(given) != 1:
            raise inconsistent((), " and ".join(given) or "no trigger", "one of at_s, phase and command")
        return self


class PolicyCommand(Section):
    at_s: float = Field(ge=0, description="When the ground gives it.")
    command: str = Field(min_length=1, description="The word that a change of policy.changes waits for.")
    drones: tuple[DroneId, ...] = Field((), description="Whom it reaches; left out, all.")


class ViewReplay(Section):
    at_s: float = Field(ge=0, description="From when the drone's next decision is made on this view.")
    drone: DroneId = Field(description="Whose policy sees it; the view's ego.")
    view: str = Field(min_length=1, description="A fleet view as JSON, as `sortie verify` writes counterexamples.")
    read_by: Literal["policy", "drone"] = Field(
        "policy",
        description="Who reads it: the policy alone, or the drone's staleness rules, damping and invariants too.",
    )


class PolicySection(Section):
    name: str = Field("worked", min_length=1, description="A registered policy, or path/to/file.py:function.")
    params: Params = Field({}, description="Keyword arguments of the policy.")
    dwell_s: float = Field(1.0, ge=0, le=60, description="How long an upgrade must be asked for before it is made.")
    hysteresis: float = Field(
        0.2,
        ge=0,
        le=10,
        description="By which share goodput, charge or headroom must rise before a drone publishes the rise.",
    )
    changes: tuple[PolicyChange, ...] = Field(
        (),
        max_length=100,
        description="Policies that take over in flight; where two do at once, the later in the list.",
    )
    commands: tuple[PolicyCommand, ...] = Field((), max_length=1000, description="Commands from the ground.")
    invariants: str = Field(
        "",
        max_length=10000,
        description="What enforced directives must keep, one line each (policies/verification/invariants/language.py); violations are events.",
    )
    of_makes: bool = Field(
        True,
        description="Whether makes with a policy of their own fly it; false lets this policy decide for all drones.",
    )
    shield: bool = Field(
        False,
        description="Directives that break an invariant are replaced by the nearest that keep it, as far as ages allow.",
    )
    replays: tuple[ViewReplay, ...] = Field(
        (), max_length=600, description="Views that a policy is shown instead of what its drone heard."
    )

    @model_validator(mode="after")
    def _fits_together(self) -> PolicySection:
        known = [c.command for c in self.changes if c.command is not None]
        for i, given in enumerate(self.commands):
            if given.command not in known:
                bound = f"one that a change waits for: {', '.join(known) or 'none does'}"
                raise inconsistent(("commands", i, "command"), repr(given.command), bound)
        if self.shield and not self.invariants.strip():
            raise inconsistent(("invariants",), "missing", "given where there is a shield")
        return self
