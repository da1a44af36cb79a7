"""The plane's rules on a bus, and when in a frame each drone acts."""

from __future__ import annotations

from sortie.fleet.plane import PlaneRules, equipment_of
from sortie.scenarios.schema import Scenario
from sortie.scenarios.streams import stream
from sortie.sim.engine.sortie import PHASE_SHARE


def phase_of(scenario: Scenario, drone: int) -> float:
    """The drone's moment within each frame, s."""
    return PHASE_SHARE * scenario.frame_s * float(stream(scenario.seed, 0, drone, "phase").random())


def rules_of(scenario: Scenario, begin_s: float, end_s: float) -> PlaneRules:
    """The plane's rules on the bus: samples go whole, descriptors in full."""
    return PlaneRules(
        period_s=scenario.frame_s,
        frames=round((end_s - begin_s) / scenario.frame_s),
        degraded_after_periods=scenario.context.degraded_after_periods,
        detached_after_periods=scenario.context.detached_after_periods,
        dwell_s=scenario.policy.dwell_s,
        hysteresis=scenario.policy.hysteresis,
        compute_delay_s=scenario.perception.compute_delay_s,
        publish_every=scenario.context.publish_every,
        trust=scenario.context.trust,
        roster=scenario.context.roster,
        makes=equipment_of(scenario),
    )
