"""The properties that a single view decides: the plane's two, and those that invariants state."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from sortie.policies.checks import check_directives, find_wrong_type
from sortie.policies.contract import Directive, FleetView, Policy, PolicyError
from sortie.policies.verification.invariants.language import (
    Invariant,
    describe_directives,
    just_heard,
    listed,
    violations,
)
from sortie.policies.verification.kit.age_rule import older_views, raised_part, without_detached

ONE_BY_ONE = 8
"""Ages are raised drone by drone in views of up to so many; in larger ones of all drones at once."""


@dataclass(frozen=True, slots=True)
class Property:
    """A property to prove: a function that returns a complaint about a policy on a view, or None."""

    name: str
    complaint: Callable[[Policy, Any], str | None]


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
        """The view with some raises of its ages: of each drone by itself and of all at once; above `ONE_BY_ONE`, of all at once alone."""
        if self._raised is not None:
            yield self._plain._replace(age_s=dict(self._raised)).frozen
        for older in older_views(self._plain, one_by_one=len(self._plain.age_s) <= ONE_BY_ONE):
            yield older.frozen


def missing_links(directives: Iterable[Directive], view: FleetView) -> str | None:
    """A complaint if the directives are not exactly one for each peer."""
    decided, peers = sorted(d.destination for d in directives), list(view.peers)
    return None if decided == peers else f"directives for [{listed(decided)}], must be for each of [{listed(peers)}]"


def keeps_contract(policy: Policy, view: Any) -> str | None:
    """Bounds, and one directive per link."""
    directives = policy(view.now())
    try:
        check_directives(directives, view.now())
    except PolicyError as error:
        return str(error)
    return missing_links(directives, view.now())


def only_falls_with_age(policy: Policy, view: Any) -> str | None:
    """Raising any ages raises no directive's representation, budget or rate.

    A peer that is detached has left the fleet, and its place may go to others: no directive may be higher than it was with
    that peer and than it is without.
    """
    before = policy(view.now())
    for older in view.older():
        after = policy(older)
        if raised_part(before, after) is None:  # mostly, and then a third decision changes nothing
            continue
        raised = raised_part(before, after, policy(without_detached(view.now(), older)))
        if raised is not None:
            ages = listed(f"{i}: {a!r}" for i, a in sorted(older.age_s.items()))
            return f"with ages raised to {ages} s, {raised}"
    return None


def property_of(invariant: Invariant) -> Property:
    """An invariant as a property to prove."""

    def complaint(policy: Policy, view: Any) -> str | None:
        directives = policy(view.now())
        fresh = policy(view.just_heard()) if invariant.needs_fresh else ()
        for broken in violations(invariant, view.now(), directives, fresh):
            return f"decided {describe_directives(directives if broken is None else [broken])}"
        return None

    return Property(invariant.text, complaint)


PLANE: tuple[Property, ...] = (
    Property("contract: bounds, one directive per link", keeps_contract),
    Property("age-monotone: older descriptors raise no representation, budget or rate", only_falls_with_age),
)
"""The properties that every policy must have, besides its invariants."""


def check_property(
    prop: Property, policy: Policy, view: FleetView, raised: Mapping[int, float] | None = None
) -> str | None:
    """The complaint of a property about a policy on one plain view. An exception is a complaint."""
    repeatable = RepeatableView(view, raised)
    try:
        return prop.complaint(policy, repeatable)
    except Exception as error:
        return _invalid_directive(policy, repeatable.now()) or f"raises {type(error).__name__}: {error}"


def _invalid_directive(policy: Policy, view: FleetView) -> str | None:
    """The first invalid directive in the policy's output, as text; None if that is not the cause of an exception."""
    try:
        answer = policy(view)
        if type(answer) not in (list, tuple):
            return f"a policy returns a list or a tuple of directives, got {type(answer).__name__}"
        return next((wrong for d in answer if (wrong := find_wrong_type(d)) is not None), None)
    except Exception:
        return None
