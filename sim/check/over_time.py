"""Lines about time: looked for by simulation, proved where the states are few, and shown by a flight where they fail.

A line such as `when human_in_region: within 0.5 s: any_link(representation >= detections)` is about a policy, the staleness
rules and damping together. The search drives them over drawn courses of views (`closed_loop`), keeps the courses that come
nearest to breaking the line, and changes those. A course that breaks it becomes a scenario in which a drone is shown these
views; it counts only if its flight breaks the line as well. With a scenario, that scenario is flown too, with other seeds
and with links that drop.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice, takewhile
from typing import Any, NamedTuple

from sortie.policies.contract import FleetView, Policy, PolicyError
from sortie.policies.verification.budget import Budget
from sortie.policies.verification.invariants.language import Invariant, Recent
from sortie.policies.verification.invariants.words import DWELL
from sortie.policies.verification.kit.courses import (
    Course,
    Values,
    changed_course,
    draw_course,
    shrink_course,
)
from sortie.policies.verification.kit.views import to_json
from sortie.policies.verification.proof.proof import Outcome
from sortie.policies.verification.proof.search import Stopped
from sortie.policies.verification.subject import constants_of
from sortie.scenarios.reading.load import loads
from sortie.scenarios.schema import Scenario
from sortie.scenarios.streams import stream
from sortie.sim.check.closed_loop import ClosedLoop, PlaneTimes, first_break
from sortie.sim.check.counterexample import shows_in_flight, slug
from sortie.sim.check.few_states import NotFinite, prove_over_time
from sortie.sim.engine.sortie import run_sortie

BUDGET_S = 60.0
"""Processor time for the proofs of all lines about time if nothing else is asked for, and again for courses and flights."""
COURSES = 400
"""How many courses are tried for each line."""
_FROM_BEST = 0.6
"""Share of courses that change one of the best."""
_BEST = 8
_LONGEST = 600
"""Decisions of the longest course: as many views as a scenario may show."""
DROPS = 3


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
    budget_s: float,
    scenario: Scenario | None = None,
    courses: int = COURSES,
    flights: int = 0,
    seed: int = 0,
) -> list[TimeVerdict]:
    """The verdict on each line about time.

    Args:
        subject: the policy.
        rules: lines about time.
        drones: the largest fleet of courses and proofs; two at least, because one drone has no link.
        budget_s: processor time for the proofs of all lines together, and again for all courses and flights.
        scenario: whose dwell time, staleness rules and shield apply, and which is flown too; None takes the defaults.
        courses: how many for each line.
        flights: how many of the scenario.
        seed: of the courses.
    """
    base, drones = loads("name: verify") if scenario is None else scenario, max(2, drones)
    times, proving = PlaneTimes.of(base), Budget(budget_s)
    verdicts = []
    for rule, spent in zip(rules, Budget(budget_s).shares(len(rules)), strict=True):
        found, tried = _search(subject, rule, base, times, drones, courses, spent, seed)
        flown = 0
        if found is None and scenario is not None:
            found, flown = _fly(subject, rule, scenario, flights, spent)
        if found is not None:
            verdicts.append(found)
            continue
        of_all = "" if tried == courses else f" of {courses}"
        said = f"{tried}{of_all} courses of up to {drones} drones" + (
            f" and {flown} flights keep it" if flown else " keep it"
        )
        said += f", at a dwell time of {times.dwell_s:g} s" + (", with the shield" if times.shielded else "")
        try:
            covered = prove_over_time(subject.policy, rule, times, drones, proving)
            verdicts.append(TimeVerdict(rule.text, "proved", f"{covered}; {said}"))
        except NotFinite as why:
            verdicts.append(TimeVerdict(rule.text, "tried", f"{said}; not proved: {why}"))
    return verdicts


# --- courses -------------------------------------------------------------------------------------


def _search(
    subject: Subject,
    rule: Invariant,
    base: Scenario,
    times: PlaneTimes,
    drones: int,
    courses: int,
    budget: Budget,
    seed: int,
) -> tuple[TimeVerdict | None, int]:
    """The verdict if a course breaks the line, and how many courses were tried to their end."""
    decisions = min(_LONGEST, math.ceil((3 * _longest_s(rule, times) + 2 * times.dwell_s + 1.0) / times.frame_s))
    values = Values.of(constants_of(subject.policy, [rule]))
    best: list[tuple[float, int, Course]] = []
    for number in range(courses):
        rng = stream(seed, number, (), "verify.over_time")
        if best and rng.random() < _FROM_BEST:
            course = changed_course(best[int(rng.integers(len(best)))][2], seed, number, values)
        else:
            size, limit = int(rng.integers(2, drones + 1)), times.detached_after_periods
            still = Course(size, decisions, times.frame_s, times.period_s, limit, {}, {})
            course = draw_course(seed, number, still, values)
        pressure = _run(subject.policy, rule, times, course, budget)
        if pressure == math.inf:
            verdict = _refuted(subject, rule, base, times, course, budget)
            if verdict is not None:
                return verdict, number + 1
        if budget.is_spent:
            return None, number
        heapq.heappush(best, (pressure, number, course))
        if len(best) > _BEST:
            heapq.heappop(best)
    return None, courses


def _longest_s(rule: Invariant, times: PlaneTimes) -> float:
    spans = [n.span for n in rule.nodes if isinstance(n, Recent)] + ([] if rule.within is None else [rule.within])
    return max(times.dwell_s if span == DWELL else span for span in spans)


def _views(course: Course, budget: Budget) -> Iterator[FleetView]:
    """The views of a course, as far as the time goes."""
    return takewhile(lambda view: not budget.is_spent, course.views())


def _run(policy: Policy, rule: Invariant, times: PlaneTimes, course: Course, budget: Budget) -> float:
    """How near a course comes to breaking a line; infinite if it does, or if the policy fails."""
    loop, pressure = ClosedLoop(policy, [rule], times), 0.0
    for k, view in enumerate(_views(course, budget)):
        try:
            if loop.step(view, k * times.frame_s):
                return math.inf
        except PolicyError:
            return math.inf
        pressure = max(pressure, loop.past.pressure())
    return pressure


def _refuted(
    subject: Subject, rule: Invariant, base: Scenario, times: PlaneTimes, course: Course, budget: Budget
) -> TimeVerdict | None:
    """The verdict with the smallest course found; None if a flight of it keeps the line."""
    course = shrink_course(course, lambda c: first_break(subject.policy, rule, times, _views(c, budget)) is not None)
    broken = first_break(subject.policy, rule, times, course.views())
    if broken is None:  # it decides otherwise than before
        return None
    views = list(islice(course.views(), broken.decisions))
    scenario = course_scenario(subject, rule, broken.what, base, views)
    shown = shows_in_flight(scenario)
    return TimeVerdict(rule.text, "refuted", broken.what, broken.view, scenario) if shown else None


def course_scenario(
    subject: Subject, rule: Invariant, what: str, base: Scenario, views: Sequence[FleetView]
) -> Scenario:
    """A sortie in which drone 0 reads these views, one a frame, under the dwell time, ages and shield of `base`."""
    period_s = base.frame_s
    return Scenario.model_validate(
        {
            "name": slug(rule.text),
            "description": f"{rule.text}: {what}"[:2000],
            "duration_s": period_s * (len(views) + 0.5),
            "fleet": {"drones": max(len(v.descriptors) for v in views), "formation": {"shape": "grid"}},
            "context": base.context.model_dump(
                include={"rate_hz", "publish_every", "degraded_after_periods", "detached_after_periods"}
            ),
            "perception": {"detector": "none"},
            "policy": {
                "name": subject.name,
                "params": dict(subject.params),
                "dwell_s": base.policy.dwell_s,
                "shield": base.policy.shield,
                "invariants": rule.text,
                "replays": [
                    {"at_s": k * period_s, "drone": 0, "view": to_json(view), "read_by": "drone"}
                    for k, view in enumerate(views)
                ],
            },
            "expect": [{"metric": "policies.invariant_violations", "equals": 0, "because": rule.text}],
        }
    )


# --- flights -------------------------------------------------------------------------------------


def _fly(
    subject: Subject, rule: Invariant, scenario: Scenario, flights: int, budget: Budget
) -> tuple[TimeVerdict | None, int]:
    """The verdict if the policy fails or breaks the line in a flight of the scenario, and how many were flown."""

    def each_second(t_s: float) -> None:
        if budget.is_spent:
            raise Stopped

    for number, flown in enumerate(flights_of(subject, rule, scenario, flights)):
        try:
            record = run_sortie(flown, progress=each_second)
        except Stopped:
            return None, number
        except PolicyError as error:
            what = f"the policy fails in a flight of {scenario.name}: {error}"
            return TimeVerdict(rule.text, "refuted", what, None, flown), number + 1
        if record.totals["invariant_violations"]:
            first = min(record.tables["violations"].to_pylist(), key=lambda row: (row["t_s"], row["drone"]))
            what = f"broken by {first['cause']} at {first['t_s']:.2f} s of a flight of {scenario.name}: {first['text']}"
            return TimeVerdict(rule.text, "refuted", what, None, flown), number + 1
    return None, flights


def flights_of(subject: Subject, rule: Invariant, scenario: Scenario, count: int) -> Iterator[Scenario]:
    """The scenario as it is, then with other seeds and with links that drop for a while. The policy decides alone.

    The scenario's own policies (`policy.changes`, those of its makes) and the commands to them do not fly.
    """
    data = scenario.model_dump(mode="json", exclude_unset=True)
    data["policy"] = data.get("policy", {}) | {
        "name": subject.name, "params": dict(subject.params), "invariants": rule.text,
        "changes": [], "commands": [], "of_makes": False,
    }  # fmt: skip
    data["expect"] = [{"metric": "policies.invariant_violations", "equals": 0, "because": rule.text}]
    for number in range(count):
        rng = stream(scenario.seed, number, (), "verify.flights")
        drops = []
        for _ in range(int(rng.integers(1, DROPS + 1)) if number else 0):
            at_s, lasts_s = rng.uniform(0, scenario.duration_s), rng.uniform(0.2, 4.0)
            drops.append(
                {
                    "kind": "link_drop", "at_s": round(at_s, 2), "until_s": round(at_s + lasts_s, 2),
                    "drone": int(rng.integers(scenario.fleet.drones)), "loss_db": 120,
                }
            )  # fmt: skip
        events = [*data.get("events", []), *drops]
        yield Scenario.model_validate({**data, "seed": scenario.seed + number, "events": events})
