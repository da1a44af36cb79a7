"""The rules of the context plane that a drone decides by: its periods, the limits of age, and its damping."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Self

from sortie.policies.staleness import LinkHealth, health
from sortie.scenarios.schema import Scenario


@dataclass(frozen=True)
class PlaneRules:
    """The plane's rules, the same for every drone.

    Example:
        >>> PlaneRules(0.1, 100, 3.0, 10.0, dwell_s=1.0, hysteresis=0.0).health(0.5)
        <LinkHealth.DEGRADED: 1>
    """

    period_s: float
    """From one decision to the next: a frame."""
    frames: int
    degraded_after_periods: float
    detached_after_periods: float
    dwell_s: float
    hysteresis: float
    publish_every: int = field(default=1, kw_only=True)
    """Frames from one descriptor to the next. Staleness counts in periods of that length."""
    trust: bool = field(default=False, kw_only=True)
    """Whether drones check the claims of their peers (`sortie.fleet.trust`)."""
    roster: bool = field(default=False, kw_only=True)
    """Whether drones publish which members of the fleet they know (`sortie.policies.contract.Roster`)."""
    shielded: bool = field(default=False, kw_only=True)
    """Whether a shield keeps the scenario's invariants."""

    @classmethod
    def of(cls, scenario: Scenario, **fields: Any) -> Self:
        """The rules of a scenario; `fields` replaces some of them, and adds those of a subclass."""
        context, policy = scenario.context, scenario.policy
        of_scenario = {
            "period_s": scenario.frame_s,
            "frames": scenario.frames,
            "degraded_after_periods": context.degraded_after_periods,
            "detached_after_periods": context.detached_after_periods,
            "dwell_s": policy.dwell_s,
            "hysteresis": policy.hysteresis,
            "publish_every": context.publish_every,
            "trust": context.trust,
            "roster": scenario.publishes_rosters,
            "shielded": policy.shield,
        }
        return cls(**of_scenario | fields)

    @property
    def descriptor_period_s(self) -> float:
        """Time from one descriptor of a drone to its next."""
        return self.period_s * self.publish_every

    @property
    def fresh_s(self) -> float:
        """A descriptor up to this age is fresh."""
        return self.descriptor_period_s * self.degraded_after_periods

    def health(self, age_s: float) -> LinkHealth:
        """Health of the link to a peer whose latest descriptor is this old."""
        return health(age_s, self.descriptor_period_s, self.degraded_after_periods, self.detached_after_periods)
