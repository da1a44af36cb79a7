"""Proofs that a policy keeps its properties on every view of a fleet, or a view on which it does not.

The policy runs on views whose fields are ranges (`sortie.policies.verification.symbols`). Its comparisons divide the
ranges into cells. The search visits every cell, for every roster up to `max_drones`, every ego, every subset of peers
heard, every order of the drones in the view, and

| field | searched over |
|---|---|
| charge and headrooms | every float of 0 … 1 |
| goodput | every float of 0 … 10⁵ Mb/s |
| ages | every float of 0 … 2³² s, as far apart as two stamps can be |
| phase, region | all five; none, or any disc within 100 km, however small |
| novelty flags, target ids | every byte; how many, 0 … 16 |
| positions, footprints | every order of the peers by `peers_by_overlap`, through which alone they may be read |

| verdict | what was covered |
|---|---|
| `proved` | every view of fleets of up to so many drones, float by float |
| `proved over the reals` | the same, but sums and products of inputs were followed without rounding |
| `refuted` | a view of plain numbers on which the policy itself was run and failed |
| `searched` | cells that the time allowed, or of a policy that cannot be proved; none fails |
| `drawn` | random views alone, because the policy cannot be followed; none fails |

Drawn views are tried after every proof too, up to the largest fleet that a scenario may have. A proof covers neither
rosters (`context.roster`), nor another period than the one given, nor another `detached_after_periods`, nor NaN.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from sortie.policies.checks import check_directives, find_inexact, find_wrong_type
from sortie.policies.contract import DETACHED_AFTER_PERIODS, Directive, FleetView, Policy, PolicyError
from sortie.policies.verification.advice import advise
from sortie.policies.verification.age_rule import older_views, raised_part, without_detached
from sortie.policies.verification.confine import Reached
from sortie.policies.verification.courses import constants_of
from sortie.policies.verification.invariants import (
    Invariant,
    InvariantError,
    describe_directives,
    just_heard,
    violations,
)
from sortie.policies.verification.own_constants import views_at
from sortie.policies.verification.policy_rules import missing_links
from sortie.policies.verification.search import (
    BUDGET_S,
    LEAST_VIEWS,
    Budget,
    Found,
    Searched,
    Stopped,
    drawn_budget,
    search_size,
)
from sortie.policies.verification.solver import solver_paths
from sortie.policies.verification.subject import searchable, with_notes
from sortie.policies.verification.symbols import Combined, Refused
from sortie.policies.verification.views import LARGEST, MAX_DRONES, draw_view, shrink
from sortie.scenarios.plugins.user_calls import text_of

DRONES = 5
"""The largest fleet that a proof covers if nothing else is asked for."""
TRIED_VIEWS = 1000
TRIED_AT_CONSTANTS = 200
"""At most so many views more have the numbers of the policy's own code."""
TRIED_LARGE = 2
"""Drawn views of the largest fleet that a scenario may have."""

Outcome = Literal["proved", "proved over the reals", "refuted", "searched", "drawn"]
PROVED = ("proved", "proved over the reals")
_NOT_REPEATED = "not the same for the same view: it fails on this view only sometimes"


@dataclass(frozen=True, slots=True)
class Property:
    """A property to prove: a function that returns a complaint about a policy on a view, or None."""

    name: str
    complaint: Callable[[Policy, Any], str | None]


@dataclass(frozen=True, slots=True)
class ProofVerdict:
    """The verdict on one property."""

    name: str
    outcome: Outcome
    what: str
    counterexample: FleetView | None = None
    raised_age_s: Mapping[int, float] | None = None
    """The raised ages of the counterexample, if the property is about raised ages."""


class RepeatableView:
    """Produces a plain view any number of times: as it is, at age 0, or older."""

    def __init__(self, plain: FleetView, raised: Mapping[int, float] | None = None) -> None:
        self._plain, self._raised = plain.frozen, raised

    def now(self) -> FleetView:
        """The view itself, which can only be read."""
        return self._plain

    def just_heard(self) -> FleetView:
        """The view with every age 0."""
        return just_heard(self._plain).frozen

    def older(self) -> Iterator[FleetView]:
        """The view with raised ages, a few of all raises; in a large fleet of all drones at once alone."""
        if self._raised is not None:
            yield self._plain._replace(age_s=dict(self._raised)).frozen
        for who, _, older in older_views(self._plain):
            if len(self._plain.age_s) <= MAX_DRONES or len(who) == len(self._plain.age_s):
                yield older.frozen


# --- properties ----------------------------------------------------------------------------------


def keeps_contract(policy: Policy, view: Any) -> str | None:
    """Bounds, and one directive per link."""
    directives = policy(view.now())
    try:
        check_directives(directives, view.now())
    except PolicyError as error:
        return str(error)
    return missing_links(directives, view.now())


def only_falls_with_age(policy: Policy, view: Any) -> str | None:
    """Raising any ages raises no directive's representation, budget or rate (`policy_rules.age_monotone`)."""
    before = _exactly(policy(view.now()))
    for older in view.older():
        after = policy(older)
        if raised_part(before, after) is None:
            continue
        raised = raised_part(before, after, policy(without_detached(view.now(), older)))
        if raised is not None:
            ages = ", ".join(f"{i}: {a!r}" for i, a in sorted(older.age_s.items()))
            return f"with ages raised to {ages} s, {raised}"
    return None


def _exactly(answer: Any) -> list[Directive]:
    """An answer whose directives cannot read differently than they are.

    Raises:
        PolicyError: it is no list or tuple of exactly `Directive`, or a field is of a type of the policy's own.
    """
    wrong = find_inexact(answer)
    if wrong is not None:
        raise PolicyError(wrong)
    return list(answer)


def property_of(invariant: Invariant) -> Property:
    """An invariant as a property to prove."""

    def complaint(policy: Policy, view: Any) -> str | None:
        directives = _exactly(policy(view.now()))
        fresh = _exactly(policy(view.just_heard())) if invariant.needs_fresh else []
        for broken in violations(invariant, view.now(), directives, fresh):
            return f"decided {describe_directives(directives if broken is None else [broken])}"
        return None

    return Property(invariant.text, complaint)


PLANE: tuple[Property, ...] = (
    Property("contract: bounds, one directive per link", keeps_contract),
    Property("age-monotone: older descriptors raise no representation, budget or rate", only_falls_with_age),
)
"""The properties that every policy must have, besides its invariants."""


# --- proving -------------------------------------------------------------------------------------


def prove(
    policy: Policy,
    invariants: Sequence[Invariant] = (),
    *,
    max_drones: int = DRONES,
    period_s: float = 0.1,
    budget_s: float = BUDGET_S,
    seed: int = 0,
    views: int = TRIED_VIEWS,
) -> list[ProofVerdict]:
    """Prove or refute the plane's properties and a policy's invariants.

    Args:
        policy: the policy. A proof needs one of Sortie's, or one that `resolve` loaded from a file.
        invariants: what it must keep too.
        max_drones: fleets of 1 to this many drones are searched; each drone multiplies the cells by about ten.
        period_s: the plane's period.
        budget_s: wall-clock time for the search of all properties together. What it did not reach is not proved. Drawn
            views of all properties get as much again, and at least `search.LEAST_DRAWN_S`.
        seed: of the drawn views on which every property is tried that no search refuted.
        views: how many of them, besides a few of the largest fleet; 0 for none at all.

    Returns:
        One verdict for each property, the plane's first.

    Raises:
        InvariantError: a line is about time, which no single view decides (`sortie.sim.check.over_time` does).
    """
    for rule in invariants:
        if rule.over_time:
            raise InvariantError(f"{rule.text!r} is about time: a single view does not decide it")
    properties = [*PLANE, *(property_of(i) for i in invariants)]
    searched = [Searched(p.name) for p in properties]
    coverage = _search(policy, list(zip(searched, properties, strict=True)), max_drones, period_s, Budget(budget_s))
    tried = _Drawn(policy, invariants, seed, views)
    drawn = tried.first_faults([p for f, p in zip(searched, properties, strict=True) if f.fault is None], budget_s)
    verdicts = []
    for found, prop in zip(searched, properties, strict=True):
        if found.fault is not None:
            said = check_property(prop, policy, found.fault.view, found.fault.raised_age_s) or _NOT_REPEATED
            verdicts.append(ProofVerdict(prop.name, "refuted", said, found.fault.view, found.fault.raised_age_s))
            continue
        view, keep_it = drawn[prop]
        if view is not None:
            verdicts.append(
                ProofVerdict(prop.name, "refuted", check_property(prop, policy, view) or _NOT_REPEATED, view)
            )
            continue
        outcome, text = coverage.verdict(found)
        verdicts.append(ProofVerdict(prop.name, outcome, f"{text}; {keep_it}"))
    return verdicts


class _Coverage:
    """What the search of a policy covered."""

    def __init__(self, asked: int, period_s: float, budget: Budget) -> None:
        self.asked, self.drones, self.period_s, self.budget = asked, 0, period_s, budget
        self.exact = True
        self.cannot = ""
        """Why no search can follow the policy."""
        self.unsound = ""
        """Why a complete search proves nothing."""
        self.stopped = False

    def verdict(self, found: Searched) -> tuple[Outcome, str]:
        why = found.unclear or self.cannot
        if why:
            return "drawn", advise(why)
        if self.unsound:
            return "searched", f"{found.cells} cells; it {self.unsound}"
        spent = f"the time of {self.budget.budget_s:g} s ended in fleets of {self.drones + 1}" if self.stopped else ""
        if self.drones < min(2, self.asked):
            return "searched", f"{found.cells} cells; {spent}"
        gone = f"detached after {DETACHED_AFTER_PERIODS:g} periods"
        cells = (
            f"all views of up to {self.drones} drones, at a period of {self.period_s:g} s, {gone}, {found.cells} cells"
        )
        cells += f"; {spent}" if spent else ""
        return ("proved" if self.exact else "proved over the reals"), cells


def _search(
    policy: Policy, properties: list[tuple[Searched, Property]], max_drones: int, period_s: float, budget: Budget
) -> _Coverage:
    """Search fleet by fleet until all is covered, the time is over, or the policy cannot be followed."""
    coverage = _Coverage(max_drones, period_s, budget)

    def confirm(searched: Searched, fault: Found) -> bool:
        prop = next(p for s, p in properties if s is searched)
        return check_property(prop, policy, fault.view, fault.raised_age_s) is not None

    looked_for = [(s, p.complaint) for s, p in properties]
    make = None
    try:
        follows, coverage.unsound = searchable(policy)
        plain = with_notes(policy)
        for drones in range(1, max_drones + 1):
            try:
                exact = search_size(follows, plain, looked_for, confirm, drones, period_s, budget, make)
            except Combined as combined:
                make = solver_paths(str(combined))
                exact = search_size(follows, plain, looked_for, confirm, drones, period_s, budget, make)
            coverage.exact = coverage.exact and exact
            coverage.drones = drones
    except Stopped:
        coverage.stopped = True
    except (Refused, Reached) as refused:
        coverage.cannot = str(refused)
    except Exception as error:  # its file does not load with the checks
        coverage.cannot = f"raises {type(error).__name__}: {text_of(error, str)}"
    return coverage


class _Drawn:
    """Drawn views and what the policy decides on them, each decision made once."""

    def __init__(self, policy: Policy, rules: Sequence[Invariant], seed: int, count: int) -> None:
        self._policy, self._count = policy, count
        self._large = TRIED_LARGE if count else 0
        self._views = [
            *(draw_view(seed, number) for number in range(count)),
            *(draw_view(seed, count + number, LARGEST) for number in range(self._large)),
        ]
        own = list(views_at(constants_of(policy, rules), seed, min(count, TRIED_AT_CONSTANTS)))
        self._own = len(own)
        self._views += own
        self._answers: dict[int, Any] = {}

    def _text(self, tried: int) -> str:
        """How many views were tried, in words."""
        if tried < len(self._views):
            return f"{tried} of {len(self._views)} drawn views keep it"
        own = f", {self._own} at the policy's own constants" if self._own else ""
        return f"{self._count} drawn views of up to {MAX_DRONES} drones{own} and {self._large} views of {LARGEST} drones keep it"

    def first_faults(
        self, properties: Sequence[Property], budget_s: float
    ) -> dict[Property, tuple[FleetView | None, str]]:
        """Of each property the first view on which it fails, made smaller, or None, and how many views keep it, in words."""
        ordered = sorted(
            properties, key=lambda p: p is PLANE[1]
        )  # raised ages cost most: last, they get what others leave
        shares = drawn_budget(budget_s).shares(len(ordered))
        return {prop: self._first_fault(prop, share) for prop, share in zip(ordered, shares, strict=True)}

    def _first_fault(self, prop: Property, budget: Budget) -> tuple[FleetView | None, str]:
        for number, view in enumerate(self._views):
            if number >= LEAST_VIEWS and budget.is_spent:
                return None, self._text(number)
            shown = RepeatableView(view)
            now = shown.now()

            has_end = number >= LEAST_VIEWS
            cut = list[FleetView]()  # a view with many ages takes many decisions

            def ask(other: FleetView, /, has_end: bool = has_end, cut: list[FleetView] = cut) -> Any:
                if has_end and budget.is_spent:
                    cut.append(other)
                    raise Stopped
                return self._policy(other)

            def fails(other: FleetView, ask: Policy = ask, cut: list[FleetView] = cut) -> bool:
                return not budget.is_spent and check_property(prop, ask, other) is not None and not cut

            def decide(other: FleetView, /, now: FleetView = now, number: int = number, ask: Policy = ask) -> Any:
                if other is not now:
                    return ask(other)
                if number not in self._answers:
                    self._answers[number] = ask(now)
                return self._answers[number]

            complaint = _complaint(prop, decide, shown)
            if cut:
                return None, self._text(number)
            if complaint is not None:
                if check_property(prop, self._policy, view) is None:
                    return view.frozen, ""  # it fails only sometimes: it is not the same for the same view
                return shrink(view, fails), ""
        return None, self._text(len(self._views))


def check_property(
    prop: Property, policy: Policy, view: FleetView, raised: Mapping[int, float] | None = None
) -> str | None:
    """The complaint of a property about a policy on one plain view. An exception is a complaint."""
    return _complaint(prop, policy, RepeatableView(view, raised))


def _complaint(prop: Property, policy: Policy, view: RepeatableView) -> str | None:
    try:
        return prop.complaint(policy, view)
    except Exception as error:
        return _invalid_directive(policy, view.now()) or f"raises {type(error).__name__}: {text_of(error, str)}"


def _invalid_directive(policy: Policy, view: FleetView) -> str | None:
    """The first invalid directive in the policy's output, as text; None if that is not the cause of an exception."""
    try:
        answer = policy(view)
        if type(answer) not in (list, tuple):  # others may never end
            return find_inexact(answer)
        return next((wrong for d in answer if (wrong := find_wrong_type(d)) is not None), None)
    except Exception:
        return None
