"""Drawn views on which every property is tried that no search refuted, up to the largest fleet that a scenario may have."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

from sortie.policies.contract import FleetView, Policy
from sortie.policies.verification.courses import constants_of
from sortie.policies.verification.invariants import Invariant
from sortie.policies.verification.own_constants import views_at
from sortie.policies.verification.search import LEAST_VIEWS, Budget, Stopped, drawn_budget
from sortie.policies.verification.single_view import PLANE, Property, RepeatableView, check_property, complaint_of
from sortie.policies.verification.subject import apart
from sortie.policies.verification.views import LARGEST, MAX_DRONES, draw_view, shrink
from sortie.scenarios.disc import LISTED_IDS
from sortie.scenarios.plugins.user_calls import Guarded, TookTooLongError, watched

TRIED_VIEWS = 1000
TRIED_AT_CONSTANTS = 200
"""So many more views at most have numbers of the policy's code and invariants; fleets as large as these numbers come on top."""
TRIED_LISTED = 2
"""So many drawn views have `LISTED_IDS` drones, the most with which descriptors list goodput to everyone."""
TRIED_LARGEST = (0.02, 1.0)
"""Drawn views of the largest fleet, each with the share of the others that the ego hears."""
LARGE_S = 10.0
"""Where the ego has heard more than `LISTED_IDS` drones, a property that takes longer is not judged, and the policy is not refuted."""


class Drawn:
    """Drawn views, and the policy's decision on each, which all properties share."""

    def __init__(self, policy: Policy, rules: Sequence[Invariant], seed: int, count: int) -> None:
        self._policy, self._count = policy, count
        own = list(views_at(constants_of(policy, rules), seed, min(count, TRIED_AT_CONSTANTS)))
        self._own = len(own)
        views = [
            *(draw_view(seed, number) for number in range(count)),
            *(_large(seed, count + number, LISTED_IDS) for number in range(TRIED_LISTED if count else 0)),
            *own,
            *(
                _large(seed, count + TRIED_LISTED + k, LARGEST, heard)
                for k, heard in enumerate(TRIED_LARGEST if count else ())
            ),
        ]
        # large ones by size: where a policy is too slow, it was tried on the smaller ones
        self._views = sorted(views, key=lambda view: max(len(view.descriptors), LISTED_IDS))
        self._answers: dict[int, Any] = {}

    def _text(self, tried: int, why: str = "") -> str:
        """How many views were tried, and why not all, in words."""
        if not self._views:
            return "no drawn views"
        if tried < len(self._views):
            return f"{tried} of {len(self._views)} drawn views keep it{why}"
        own = f", {self._own} at the policy's own constants" if self._own else ""
        return (
            f"{self._count} drawn views of up to {MAX_DRONES} drones{own}, {TRIED_LISTED} of {LISTED_IDS} drones and "
            f"{len(TRIED_LARGEST)} of {LARGEST:,} keep it"
        )

    def first_faults(
        self, properties: Sequence[Property], budget_s: float
    ) -> dict[Property, tuple[FleetView | None, str]]:
        """For each property: the first view on which it fails, made smaller, and no text; or None, and how many views keep it."""
        ordered = sorted(
            properties, key=lambda p: p is PLANE[1]
        )  # raised ages cost most: last, they get what others leave
        shares = drawn_budget(budget_s).shares(len(ordered))
        return {prop: self._first_fault(prop, share) for prop, share in zip(ordered, shares, strict=True)}

    def _first_fault(self, prop: Property, budget: Budget) -> tuple[FleetView | None, str]:
        for number, view in enumerate(self._views):
            has_end = number >= LEAST_VIEWS
            if has_end and budget.is_spent:
                return None, self._text(number)
            shown = RepeatableView(view)
            now = shown.now()

            def ask(other: FleetView, /, has_end: bool = has_end) -> Any:
                if has_end and budget.is_spent:  # a view with many ages takes many decisions
                    raise Stopped
                if len(other.descriptors) <= LISTED_IDS:
                    return self._policy(other)
                try:
                    return apart(self._policy)(other)
                except TookTooLongError as late:  # not to be asked again
                    raise Stopped from late

            def decide(other: FleetView, /, now: FleetView = now, number: int = number, ask: Policy = ask) -> Any:
                if other is not now:
                    return ask(other)
                if number not in self._answers:
                    self._answers[number] = ask(now)
                return self._answers[number]

            def fails(other: FleetView, ask: Policy = ask) -> bool:
                try:
                    return not budget.is_spent and _judged(prop, ask, RepeatableView(other)) is not None
                except Stopped:
                    return False

            try:
                complaint = _judged(prop, decide, shown)
            except Stopped as stopped:
                return None, self._text(number, str(stopped))
            if complaint is not None:
                if check_property(prop, self._policy, view) is None:
                    return view.frozen, ""  # it fails only sometimes: it is not the same for the same view
                return shrink(view, fails), ""
        return None, self._text(len(self._views))


def _judged(prop: Property, policy: Policy, view: RepeatableView) -> str | None:
    """A property's complaint about a policy on a view.

    Raises:
        Stopped: the view is large, and the policy or the property itself takes too long on it.
    """
    drones = len(view.now().descriptors)
    if drones <= LISTED_IDS:
        return complaint_of(prop, policy, view)
    try:
        with watched(LARGE_S):
            found: str | None = Guarded(complaint_of)(prop, policy, view)
            return found
    except TookTooLongError:
        raise Stopped(f"; a view of {drones:,} drones takes more than {LARGE_S:g} s") from None


@lru_cache(maxsize=TRIED_LISTED + len(TRIED_LARGEST))
def _large(seed: int, number: int, drones: int, heard: float | None = None) -> FleetView:
    """A view of a large fleet, frozen: each policy is tried on the same ones."""
    return draw_view(seed, number, drones, heard).frozen
