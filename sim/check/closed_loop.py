"""One drone's decisions on a course of views, from its policy to its gates, without a clock, a radio or a battery.

The same functions act as in `fleet.agent` and `sim.engine.pilot`: the policy, its shield, the staleness rules, damping, and
the shield at the gate. A flight in which a drone is shown the same views (`policy.replays`, `read_by: drone`) enforces the
same directives; a test compares the two.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from sortie.fleet.staleness import CEILING, cap_by_age, health
from sortie.policies.checks import check_directives
from sortie.policies.contract import Directive, FleetView, Policy, PolicyError, nothing
from sortie.policies.damping import DampedLink, damp
from sortie.policies.verification.enforced import Steps, Violation, effective, judge, put_right
from sortie.policies.verification.invariants.language import Invariant, just_heard
from sortie.policies.verification.invariants.past import Past
from sortie.policies.verification.shield import enforce
from sortie.scenarios.plugins.reference import describe_error
from sortie.scenarios.schema import Scenario


@dataclass(frozen=True)
class PlaneTimes:
    """What lies between a policy and the gates of its drone."""

    frame_s: float
    """Between two decisions."""
    period_s: float
    dwell_s: float
    degraded_after_periods: float
    detached_after_periods: float
    shielded: bool
    has_rosters: bool = False

    @classmethod
    def of(cls, scenario: Scenario) -> PlaneTimes:
        """As a scenario has it."""
        context, policy = scenario.context, scenario.policy
        return cls(
            scenario.frame_s,
            scenario.frame_s * context.publish_every,
            policy.dwell_s,
            context.degraded_after_periods,
            context.detached_after_periods,
            policy.shield,
            context.roster,
        )


class ClosedLoop:
    """One drone."""

    def __init__(self, policy: Policy, rules: Sequence[Invariant], times: PlaneTimes) -> None:
        self._policy, self._rules, self._times = policy, tuple(rules), times
        self._asks_fresh = any(rule.needs_fresh for rule in rules)
        self._links: dict[int, DampedLink] = {}
        self.past = Past(self._rules, times.dwell_s)
        self.enforced: list[Directive] = []
        """What its gates hold, by ascending peer, before the wire rounds it."""

    def step(self, view: FleetView, now_s: float) -> list[Violation]:
        """Decide on one view, and return the lines that the gates now break.

        Raises:
            PolicyError: the policy fails, or returns something else than valid directives.
        """
        view, times, me = view.frozen, self._times, view.ego
        decided = self._ask(view)
        fresh = self._ask(just_heard(view)) if self._asks_fresh else ()
        if times.shielded:
            decided = enforce(self._rules, view, decided, fresh)
        fidelity = {
            peer: health(age_s, times.period_s, times.degraded_after_periods, times.detached_after_periods)
            for peer, age_s in view.age_s.items()
            if peer != me
        }

        asked_of, steps = {d.destination: d for d in decided}, []
        for peer in fidelity:
            asked = asked_of.get(peer) or nothing(me, peer, "the policy gave no directive")
            link = self._links.get(peer) or DampedLink(nothing(me, peer, ""))
            by_age = cap_by_age(asked, fidelity[peer], view.age_s[peer])
            link = self._links[peer] = damp(link, by_age, now_s, times.dwell_s)
            steps.append(Steps(asked, by_age, link.enforced))
        damped = [s.damped for s in steps]
        ceilings = {peer: CEILING[link] for peer, link in fidelity.items()}
        self.enforced = put_right(self._rules, view, damped, fresh, ceilings) if times.shielded else damped
        self.past.note(now_s, [effective(d) for d in self.enforced])
        return judge(self._rules, view, steps, self.enforced, fresh, self.past)

    def _ask(self, view: FleetView) -> Sequence[Directive]:
        try:
            directives = self._policy(view)
        except PolicyError:
            raise
        except Exception as error:
            raise PolicyError(f"raises {describe_error(error)}") from error
        check_directives(directives, view)
        return tuple(directives)


class Break(NamedTuple):
    """Where a course fails."""

    decisions: int
    """How many were made, the failing one with them."""
    view: FleetView
    what: str


def first_break(policy: Policy, rule: Invariant, times: PlaneTimes, views: Iterable[FleetView]) -> Break | None:
    """The decision of a course at which the gates break a line or the policy fails; None if there is none."""
    loop = ClosedLoop(policy, [rule], times)
    for k, view in enumerate(views):
        at = f"after {k * times.frame_s:.2f} s of a course"
        try:
            broken = loop.step(view, k * times.frame_s)
        except PolicyError as error:
            return Break(k + 1, view, f"the policy fails {at}: {error}")
        if broken:
            return Break(k + 1, view, f"broken by {broken[0].cause} {at}: {broken[0].what}")
    return None
