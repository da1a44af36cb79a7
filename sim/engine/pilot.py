"""A drone's policy in flight, which the mission, the clock or a command may change, and its guard at the gate.

The agent calls its pilot as its policy. The pilot may change to another policy between two decisions; the agent keeps
what a link carries, its dwell time and its last sending time. The pilot replays recorded views where the scenario has
them. As the agent's guard it judges what the gates enforce against the invariants. With a shield it also replaces
directives that break one: the policy's at once, and again what the staleness rules and damping left of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import simpy

from sortie.policies.checks import check_directives, check_reposition
from sortie.policies.contract import (
    PHASE_NAMES,
    PHASE_OF,
    Directive,
    FleetView,
    Policy,
    PolicyError,
    Reposition,
    TaskPhase,
    Viewpoint,
)
from sortie.policies.decision_loop import Guard, Steps
from sortie.policies.registry import describe_error, handshake_bytes, resolve, viewpoint_of
from sortie.policies.verification.enforced import Keeper
from sortie.policies.verification.invariants.language import (
    Invariant,
    InvariantError,
    describe_directives,
    just_heard,
    parse,
    violations,
)
from sortie.policies.verification.kit.age_rule import raised_part
from sortie.policies.verification.kit.views import ViewError, from_json
from sortie.policies.verification.shield import MARK, check_shieldable
from sortie.scenarios.errors import SortieError
from sortie.scenarios.frames import with_frame
from sortie.scenarios.plugins.user_calls import is_guarded
from sortie.scenarios.schema import PolicyChange, PolicySection, Scenario
from sortie.sim.engine.audit import Audit
from sortie.sim.engine.manoeuvres import Planners, Viewpoints
from sortie.sim.engine.world import at
from sortie.sim.results.views import Journal


class NamedPolicy(NamedTuple):
    """A policy and what the audit calls it."""

    name: str
    decide: Policy
    handshake_bytes: int = 0
    """Size of the request or answer that its method sends on every link in every frame, before payloads."""


class Replay(NamedTuple):
    """A view that is shown in place of what a drone heard."""

    at_s: float
    drone: int
    view: FleetView
    to_drone: bool
    """Whether the drone's staleness rules and its guard read it too, not the policy alone."""


class PolicyPlan(NamedTuple):
    """A scenario's policies, resolved and checked before anything flies."""

    first: NamedPolicy
    changes: tuple[tuple[PolicyChange, NamedPolicy], ...] = ()
    commands: tuple[tuple[float, str, tuple[int, ...]], ...] = ()
    rules: tuple[Invariant, ...] = ()
    shielded: bool = False
    replays: tuple[Replay, ...] = ()
    dwell_s: float = 0.0
    """The dwell time, which lines about time may name."""
    of_makes: Mapping[int, NamedPolicy] = {}
    """By drone: the policy of its make, where that has one; it decides in place of `first`."""

    @property
    def policies(self) -> dict[str, NamedPolicy]:
        """Every policy that may decide, by name."""
        return {
            policy.name: policy
            for policy in (self.first, *self.of_makes.values(), *(policy for _, policy in self.changes))
        }

    @property
    def chooses_viewpoints(self) -> bool:
        """Whether any of its policies chooses viewpoints."""
        return any(viewpoint_of(policy.decide) is not None for policy in self.policies.values())


def plan_of(section: PolicySection, first: NamedPolicy | None = None) -> PolicyPlan:
    """The policies of a scenario. `first` replaces them all, but the scenario's invariants and shield still apply.

    Raises:
        PolicyError: an unknown policy or parameter, an invariant that is none, a view that cannot be read.
    """
    changes = () if first is not None else tuple((c, named_policy(c.name, c.params)) for c in section.changes)
    commands = () if first is not None else tuple((c.at_s, c.command, c.drones) for c in section.commands)
    try:
        rules = parse(section.invariants)
        replays = tuple(
            Replay(r.at_s, r.drone, from_json(r.view).frozen, r.read_by == "drone") for r in section.replays
        )
        if section.shield:
            check_shieldable(rules)
    except InvariantError as error:
        raise PolicyError(f"policy.invariants: {error}") from error
    except ViewError as error:
        raise PolicyError(f"policy.replays: {error}") from error
    for k, replay in enumerate(replays):
        if replay.view.ego != replay.drone:
            raise PolicyError(f"policy.replays.{k}.view: its ego is {replay.view.ego}, must be drone {replay.drone}")
    first = first or named_policy(section.name, section.params)
    return PolicyPlan(first, changes, commands, rules, section.shield, replays, section.dwell_s)


def plan_for(scenario: Scenario) -> PolicyPlan:
    """The policies of a scenario and of its makes.

    Raises:
        PolicyError: as `plan_of`.
    """
    makes = scenario.fleet.makes if scenario.policy.of_makes else ()
    own = {i: named_policy(m.policy, m.policy_params) for m in makes if m.policy for i in m.drones}
    return plan_of(scenario.policy)._replace(of_makes=own)


def named_policy(name: str, params: Mapping[str, object]) -> NamedPolicy:
    inside = ", ".join(f"{k}={v}" for k, v in params.items())
    return NamedPolicy(f"{name}({inside})" if inside else name, resolve(name, params), handshake_bytes(name, params))


def ask(policy: NamedPolicy, view: FleetView) -> Sequence[Directive]:
    """A policy's directives for a view, not yet checked against the contract.

    Raises:
        PolicyError: the policy fails, or returns no sequence.
    """
    try:
        answer = policy.decide(view)
    except Exception as error:
        if not is_guarded(policy.decide):  # a built-in one
            raise
        what = ":" if isinstance(error, SortieError) else " raises"
        raise PolicyError(
            f"policy {policy.name!r} on drone {view.ego}{what} {describe_error(error, policy.decide)}"
        ) from error
    if type(answer) is not list and (isinstance(answer, Directive) or not isinstance(answer, Sequence)):
        what = f"returns {type(answer).__name__}, must be a sequence of directives"
        raise PolicyError(f"policy {policy.name!r} on drone {view.ego} {what}")
    return tuple(answer) if type(answer) is list else answer  # a policy that keeps its list cannot change it later


def ask_viewpoint(policy: NamedPolicy, viewpoint: Viewpoint, view: FleetView) -> Reposition | None:
    """The place that a policy's viewpoint chooses; None keeps its slot.

    Raises:
        PolicyError: the function fails, or breaks the contract.
    """
    try:
        asked = viewpoint(view)
    except Exception as error:
        if not is_guarded(policy.decide):
            raise
        what = f"its viewpoint raises {describe_error(error)}"
        raise PolicyError(f"policy {policy.name!r} on drone {view.ego}: {what}") from error
    check_reposition(asked, view)
    return asked


class Pilot:
    """One drone's policy in flight."""

    def __init__(
        self,
        drone: int,
        plan: PolicyPlan,
        audit: Audit,
        viewpoints: Viewpoints | None = None,
        planners: Planners | None = None,
        journal: Journal | None = None,
    ) -> None:
        """Put a pilot together.

        Args:
            drone: whose pilot it is.
            plan: the scenario's policies.
            audit: records what breaks invariants, and who decides.
            viewpoints: takes those that the policy chooses; None where no policy of the plan does.
            planners: have the drone's, which reads its views; None where no drone has one.
            journal: keeps every decision; None keeps none.
        """
        self.drone, self._journal = drone, journal
        self._viewpoints, self._planners = viewpoints, planners
        self.policy = plan.of_makes.get(drone, plan.first)
        self._viewpoint = viewpoint_of(self.policy.decide)
        changes = enumerate(plan.changes)
        self._by_phase = {PHASE_OF[c.phase]: (place, then) for place, (c, then) in changes if c.phase is not None}
        self._place = -1  # in the list of changes, of the last one since the last decision
        self._audit, self._keeper = audit, Keeper(plan.rules, plan.dwell_s, plan.shielded)
        self._phase: TaskPhase | None = None
        self._shown: Replay | None = None
        self._is_shown = any(r.to_drone and r.drone == drone for r in plan.replays)
        self._last_shown: tuple[FleetView, Sequence[Directive]] | None = None
        self._fresh: Sequence[Directive] = ()  # of the latest decision, where an invariant asks for it

    def take_over(self, policy: NamedPolicy, reason: str, place: int) -> None:
        """From the next decision on, `policy` decides; `place` is the change's in the scenario's list."""
        self._place = place
        if policy.name != self.policy.name:
            self._audit.took_over(self.drone, self.policy.name, policy.name, reason)
            self.policy, self._viewpoint = policy, viewpoint_of(policy.decide)
            if self._viewpoint is None and self._viewpoints is not None:
                self._viewpoints.request(self.drone, None)

    @property
    def handshake_bytes(self) -> int:
        """Size of the request or answer that the present policy's method sends on every link, before payloads."""
        return self.policy.handshake_bytes

    def show(self, replay: Replay) -> None:
        """The next decision is made on this view."""
        self._shown = replay

    def read(self, heard: FleetView) -> FleetView:
        """What the drone reads in place of what it heard: a view that the scenario shows it."""
        shown = self._shown
        if shown is None or not shown.to_drone:
            return heard
        self._shown = None
        return shown.view

    def __call__(self, view: FleetView) -> Sequence[Directive]:
        """The present policy's directives; with a shield, those that break an invariant are replaced."""
        if self._by_phase:
            self._follow_phase(view)
        self._place = -1
        decisions = self._audit.decisions
        decisions[self.policy.name] = decisions.get(self.policy.name, 0) + 1
        shown, self._shown = self._shown, None
        read, asked = view if shown is None else shown.view, None
        if self._viewpoint is not None and self._viewpoints is not None:
            asked = ask_viewpoint(self.policy, self._viewpoint, read)
            self._viewpoints.request(self.drone, asked)
        if self._planners is not None:
            self._planners.read(self.drone, read)
        directives = ask(self.policy, read)
        if self._journal is not None:
            self.check(directives, read)  # before its parts are read
            self._journal.decided(self.drone, self.policy.name, read, directives, asked)
        if self._keeper.rules or shown is not None:
            directives = self._within_rules(read, directives)
        if shown is not None:
            self._judge_shown(shown.view, directives)
        return directives

    def check(self, directives: Sequence[Directive], view: FleetView) -> None:
        """Refuse an answer that breaks the contract.

        Raises:
            PolicyError: as `check_directives`, with the policy's name.
        """
        try:
            check_directives(directives, view)
        except PolicyError as error:
            raise PolicyError(f"policy {self.policy.name!r} on drone {self.drone}: {error}") from error

    def _follow_phase(self, view: FleetView) -> None:
        me = view.me
        if me is not None and me.task_phase != self._phase:
            self._phase = me.task_phase
            place, policy = self._by_phase.get(me.task_phase, (-1, self.policy))
            if place > self._place:  # else a later one of the list came with the phase
                self.take_over(policy, f"phase {PHASE_NAMES[TaskPhase(me.task_phase)]}", place)

    def _within_rules(self, view: FleetView, directives: Sequence[Directive]) -> Sequence[Directive]:
        name, keeper = self.policy.name, self._keeper
        self.check(directives, view)  # before the rules read them
        self._fresh = ask(self.policy, just_heard(view)) if keeper.needs_fresh else ()
        directives = keeper.correct(view, directives, self._fresh)
        for d in directives if keeper.shielded else ():
            if d.reason.startswith(MARK):
                self._audit.stepped_in(name, d, "policy")
        return directives

    @property
    def guard(self) -> Guard | None:
        """Has the last word on what the gates enforce; None where there are no invariants."""
        return self._keep_invariants if self._keeper.rules else None

    def _keep_invariants(self, view: FleetView, now_s: float, links: Sequence[Steps]) -> Sequence[Directive]:
        """Judge what the gates are to enforce, and record each intervention and each break."""
        before = self._keeper.replaced
        enforced = self._keeper(view, now_s, links)
        for peer, directive in self._keeper.replaced.items():
            if directive != before.get(peer):
                self._audit.stepped_in(self.policy.name, directive, "gate")
        self._audit.judged(self.drone, self.policy.name, self._keeper.broken)
        return enforced

    def _judge_shown(self, shown: FleetView, directives: Sequence[Directive]) -> None:
        """The invariants; one directive a link; and where ages alone rose since the last view shown, none may have risen."""
        failed = partial(self._audit.failed, self.drone)
        for rule in (r for r in self._keeper.rules if not r.over_time):
            for d in violations(rule, shown, directives, self._fresh):
                failed(
                    -1 if d is None else d.destination,
                    self.policy.name,
                    rule.text,
                    describe_directives(directives if d is None else [d]),
                )
        for peer in set(shown.peers) - {d.destination for d in directives}:
            failed(peer, self.policy.name, "one directive a link", "none for this one")
        before, self._last_shown = self._last_shown, (shown, directives)
        if before is None or before[0].descriptors != shown.descriptors:
            return
        if all(shown.age_s[i] >= age_s for i, age_s in before[0].age_s.items()):
            raised = raised_part(before[1], directives)
            if raised is not None:
                failed(-1, self.policy.name, "age-monotone", raised)


def schedule_policies(env: simpy.Environment, plan: PolicyPlan, pilots: Sequence[Pilot], frame_s: float) -> None:
    """Put changes by time, commands and replays on the clock; each comes before the frame of the same instant, and of
    two changes at one instant the later in the list comes last."""
    due: list[tuple[float, int, Callable[[], None]]] = []
    for place, (change, policy) in enumerate(plan.changes):
        if change.at_s is not None:
            due.append((change.at_s, place, partial(_take_over, pilots, policy, f"time {change.at_s:g} s", place)))
        for at_s, word, drones in plan.commands:
            if change.command == word:
                addressed = [p for p in pilots if not drones or p.drone in drones]
                due.append((at_s, place, partial(_take_over, addressed, policy, f"command {word!r}", place)))
    for at_s, _, act in sorted(due, key=lambda entry: entry[:2]):
        at(env, with_frame(at_s, frame_s), act)
    for replay in plan.replays:
        at(env, replay.at_s, partial(pilots[replay.drone].show, replay))


def _take_over(pilots: Sequence[Pilot], policy: NamedPolicy, reason: str, place: int) -> None:
    for pilot in pilots:
        pilot.take_over(policy, reason, place)
