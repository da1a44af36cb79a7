"""Lines about time: looked for by simulation, proved where the states are few, and shown by a flight where they fail.

A line such as `when human_in_region: within 0.5 s: any_link(representation >= detections)` is about a policy, the staleness
rules and damping together. The search drives them over drawn courses of views (`ClosedLoop`). A course that breaks the line
is made smaller and becomes a scenario in which a drone is shown these views; it counts only if its flight breaks the line
as well. With a scenario, that scenario is flown too, with other seeds and with links that drop.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from sortie.policies.checks import check_directives
from sortie.policies.contract import Directive, FleetView, Policy, PolicyError
from sortie.policies.decision_loop import DecisionLoop
from sortie.policies.plane_rules import PlaneRules
from sortie.policies.verification.enforced import Keeper, Violation
from sortie.policies.verification.invariants.language import Invariant, Recent, just_heard
from sortie.policies.verification.invariants.words import seconds
from sortie.policies.verification.kit.courses import Course, draw_course, shrink_course, values_at
from sortie.policies.verification.kit.views import to_json
from sortie.policies.verification.proof.proof import Outcome
from sortie.policies.verification.subject import constants_of
from sortie.scenarios.plugins.reference import describe_error
from sortie.scenarios.reading.load import loads
from sortie.scenarios.schema import Scenario
from sortie.scenarios.streams import stream
from sortie.sim.check.counterexample import showing, shows_in_flight
from sortie.sim.check.few_states import NotFinite, prove_over_time
from sortie.sim.engine.sortie import run_sortie

COURSES = 400
"""How many courses are tried for each line."""
_LONGEST = 600
"""Decisions of the longest course: as many views as a scenario may show."""


class TimeVerdict(NamedTuple):
    """The verdict on one line about time."""

    name: str
    outcome: Outcome
    what: str
    view: FleetView | None = None
    """Of a line that a course refutes: the view at whose decision it is broken."""
    scenario: Scenario | None = None
    """Of a refuted line: a scenario whose flight breaks it."""


class Subject(NamedTuple):
    """Whose lines are judged."""

    policy: Policy
    name: str
    params: Mapping[str, Any]


def judge_over_time(
    subject: Subject,
    rules: Sequence[Invariant],
    *,
    drones: int,
    scenario: Scenario | None = None,
    courses: int = COURSES,
    flights: int = 0,
) -> list[TimeVerdict]:
    """The verdict on each line about time.

    Args:
        subject: the policy.
        rules: lines about time.
        drones: the largest fleet of courses and proofs; two at least, because one drone has no link.
        scenario: whose dwell time, staleness rules and shield apply, and which is flown too; None takes the defaults.
        courses: how many for each line.
        flights: how many of the scenario.
    """
    base, drones = loads("name: verify") if scenario is None else scenario, max(2, drones)
    plane, flown = PlaneRules.of(base), 0 if scenario is None else flights
    kept = f"{courses} courses of up to {drones} drones{f' and {flown} flights' if flown else ''} keep it"
    kept += f", at a dwell time of {plane.dwell_s:g} s{', with the shield' if plane.shielded else ''}"
    verdicts = []
    for rule in rules:
        found = _search(subject, rule, base, drones, courses) or _fly(subject, rule, base, flown)
        if found is None:
            try:
                covered = prove_over_time(subject.policy, rule, plane, drones)
                found = TimeVerdict(rule.text, "proved", f"{covered}; {kept}")
            except NotFinite as why:
                found = TimeVerdict(rule.text, "tried", f"{kept}; not proved: {why}")
        verdicts.append(found)
    return verdicts


# --- courses -------------------------------------------------------------------------------------


class ClosedLoop:
    """Drone 0's decisions on views, from its policy to its gates, without a clock, a radio or a battery.

    A flight in which a drone is shown the same views (`policy.replays`, `read_by: drone`) enforces the same directives.
    """

    def __init__(self, policy: Policy, rules: Sequence[Invariant], plane: PlaneRules) -> None:
        self._policy, self._keeper = policy, Keeper(rules, plane.dwell_s, plane.shielded)
        self._loop = DecisionLoop(0, plane, self._keeper)

    def step(self, view: FleetView, now_s: float) -> list[Violation]:
        """Decide on one view, and return the lines that the gates now break.

        Raises:
            PolicyError: the policy fails, or returns something else than valid directives.
        """
        view = view.frozen
        decided = self._ask(view)
        fresh = self._ask(just_heard(view)) if self._keeper.needs_fresh else ()
        directives = self._keeper.correct(view, decided, fresh)
        self._loop.decide(view, {d.destination: d for d in directives}, now_s)
        return self._keeper.broken

    def _ask(self, view: FleetView) -> Sequence[Directive]:
        try:
            directives = self._policy(view)
        except PolicyError:
            raise
        except Exception as error:
            raise PolicyError(f"raises {describe_error(error)}") from error
        check_directives(directives, view)
        return tuple(directives)


def first_break(policy: Policy, rule: Invariant, plane: PlaneRules, course: Course) -> tuple[int, str]:
    """How many decisions a course has up to the one at which the gates break a line or the policy fails, and what fails.

    0 where nothing does.
    """
    loop = ClosedLoop(policy, [rule], plane)
    for k, view in enumerate(course.views()):
        at = f"after {k * plane.period_s:.2f} s of a course"
        try:
            broken = loop.step(view, k * plane.period_s)
        except PolicyError as error:
            return k + 1, f"the policy fails {at}: {error}"
        if broken:
            return k + 1, f"broken by {broken[0].cause} {at}: {broken[0].what}"
    return 0, ""


def _search(subject: Subject, rule: Invariant, base: Scenario, drones: int, courses: int) -> TimeVerdict | None:
    """The verdict with a small course, if one breaks the line and its flight does too."""
    plane, policy = PlaneRules.of(base), subject.policy
    spans = [n.span for n in rule.nodes if isinstance(n, Recent)] + ([] if rule.within is None else [rule.within])
    longest_s = max(seconds(span, plane.dwell_s) for span in spans)
    decisions = min(_LONGEST, math.ceil((3 * longest_s + 2 * plane.dwell_s + 1.0) / plane.period_s))
    values, limit = values_at(constants_of(policy, [rule])), plane.detached_after_periods
    for number in range(courses):
        still = Course(2 + number % (drones - 1), decisions, plane.period_s, plane.descriptor_period_s, limit, {})
        course = draw_course(number, still, values)
        if not first_break(policy, rule, plane, course)[0]:
            continue
        course = shrink_course(course, lambda smaller: first_break(policy, rule, plane, smaller)[0])
        _, what = first_break(policy, rule, plane, course)
        if what:  # else it decides otherwise than before
            views = list(course.views())
            scenario = course_scenario(subject, rule, what, base, views)
            if shows_in_flight(scenario):
                return TimeVerdict(rule.text, "refuted", what, views[-1], scenario)
    return None


def course_scenario(
    subject: Subject, rule: Invariant, what: str, base: Scenario, views: Sequence[FleetView]
) -> Scenario:
    """A sortie in which drone 0 reads these views, one a frame, under the dwell time, ages and shield of `base`."""
    settings = {"rate_hz", "publish_every", "degraded_after_periods", "detached_after_periods"}
    context = base.context.model_dump(include=settings)
    policy: dict[str, Any] = base.policy.model_dump(include={"dwell_s", "shield"})
    policy |= {"name": subject.name, "params": dict(subject.params), "invariants": rule.text}
    shown = enumerate(map(to_json, views))
    policy["replays"] = [{"at_s": k * base.frame_s, "drone": 0, "view": v, "read_by": "drone"} for k, v in shown]
    return showing(rule.text, what, views, policy, duration_s=base.frame_s * (len(views) + 0.5), context=context)


# --- flights -------------------------------------------------------------------------------------


def _fly(subject: Subject, rule: Invariant, scenario: Scenario, flights: int) -> TimeVerdict | None:
    """The verdict if the policy fails or breaks the line in a flight of the scenario."""
    for flown in flights_of(subject, rule, scenario, flights):
        try:
            record = run_sortie(flown)
        except PolicyError as error:
            what = f"the policy fails in a flight of {scenario.name}: {error}"
            return TimeVerdict(rule.text, "refuted", what, None, flown)
        if record.totals["invariant_violations"]:
            first = min(record.tables["violations"].to_pylist(), key=lambda row: (row["t_s"], row["drone"]))
            what = f"broken by {first['cause']} at {first['t_s']:.2f} s of a flight of {scenario.name}: {first['text']}"
            return TimeVerdict(rule.text, "refuted", what, None, flown)
    return None


def flights_of(subject: Subject, rule: Invariant, scenario: Scenario, count: int) -> Iterator[Scenario]:
    """The scenario as it is, then with other seeds and with links that drop for a while. The policy decides alone.

    The scenario's own policies (`policy.changes`, those of its makes) and the commands to them do not fly.
    """
    data = scenario.model_dump(mode="json", exclude_unset=True)
    data["policy"] = data.get("policy", {}) | {
        "name": subject.name,
        "params": dict(subject.params),
        "invariants": rule.text,
        "changes": [],
        "commands": [],
        "of_makes": False,
    }
    data["expect"] = [{"metric": "policies.invariant_violations", "equals": 0, "because": rule.text}]
    for number in range(count):
        rng = stream(scenario.seed, number, (), "verify.flights")
        drops = []
        for _ in range(int(rng.integers(1, 4)) if number else 0):
            at_s, lasts_s = rng.uniform(0, scenario.duration_s), rng.uniform(0.2, 4.0)
            drops.append(
                {
                    "kind": "link_drop",
                    "at_s": round(at_s, 2),
                    "until_s": round(at_s + lasts_s, 2),
                    "drone": int(rng.integers(scenario.fleet.drones)),
                    "loss_db": 120,
                }
            )
        events = [*data.get("events", []), *drops]
        yield Scenario.model_validate({**data, "seed": scenario.seed + number, "events": events})
