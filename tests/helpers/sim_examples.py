"""Small sorties that several tests of the room fly."""

from __future__ import annotations

from sortie.scenarios.reading.load import loads
from sortie.scenarios.schema import Scenario

BASE = """
name: example
duration_s: 6
fleet:
  route: {waypoints_m: [[-60, 0], [60, 0]]}
mission:
  target: {waypoints_m: [[-60, -1.75], [200, -1.75]]}
  phases:
    - {at_s: 0, phase: search}
    - {at_s: 3, phase: track, region: {radius_m: 32}}
perception: {detector: none}
policy: {name: worked, params: {rho: 0.25}, dwell_s: 0.3}
"""


PATIENT = ("context.degraded_after_periods=100", "context.detached_after_periods=1000")
"""Links stay fresh however many descriptors are lost: some collide, and a degraded link sends boxes instead of what was
asked. For tests of what is asked."""


def example(*overrides: str, text: str = BASE) -> Scenario:
    """The base scenario with `--set` overrides."""
    return loads(text, overrides=overrides)
