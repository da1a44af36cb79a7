"""The plane's rules on a bus, and what the gates may not break."""

from __future__ import annotations

import simpy

from sortie.fleet.messages.compact import FULL
from sortie.fleet.plane import FleetRules
from sortie.policies.catalogue.baselines import silence
from sortie.policies.decision_loop import Guard
from sortie.policies.verification.invariants.language import parse
from sortie.scenarios.schema import Scenario
from sortie.sim.engine.audit import Audit
from sortie.sim.engine.pilot import NamedPolicy, Pilot, PolicyPlan
from sortie.sim.results.record import Recorder


def rules_of(scenario: Scenario, begin_s: float, end_s: float) -> FleetRules:
    """The plane's rules on the bus: samples go whole, descriptors in full."""
    return FleetRules.of(
        scenario,
        frames=scenario.model_copy(update={"duration_s": end_s - begin_s}).frames,
        hysteresis=0.0,  # replayed values went through the band in the simulated flight
        tile_limit_bytes=None,
        form=FULL,
        maps_bring_looks=False,
    )


def guard_of(scenario: Scenario, drone: int, env: simpy.Environment, recorder: Recorder) -> Guard | None:
    """Judges what the drone's gates enforce, and writes down what breaks the scenario's invariants.

    Invariants about what the policy would decide on fresh descriptors are left to the policy's own process.
    """
    section, make = scenario.policy, scenario.fleet.make_of(drone)
    name = make.policy if make is not None and make.policy and section.of_makes else section.name
    rules = tuple(rule for rule in parse(section.invariants) if not rule.needs_fresh)
    plan = PolicyPlan(NamedPolicy(name, silence), rules=rules, shielded=section.shield, dwell_s=section.dwell_s)
    return Pilot(drone, plan, Audit(env, recorder)).guard
