"""Proofs that a policy keeps its properties on every view of a fleet, or a view on which it does not.

The policy runs on views whose fields are ranges (`sortie.policies.verification.symbols`). Its comparisons divide the
ranges into cells. The search visits every cell, for every roster up to `max_drones`, every ego, every subset of peers
heard, and

| field | searched over |
|---|---|
| charge and headrooms | every float of 0 … 1 |
| goodput | every float of 0 … 10⁵ Mb/s |
| ages | every float of 0 … 3600 s |
| phase, region | all five; none, or any disc |
| novelty flags, target ids | every byte; how many, 0 … 16 |
| positions, footprints | every order of the peers by `peers_by_overlap`, through which alone they may be read |

A policy that uses anything else (the coverage grid's cells, a clock, a comparison of two goodputs) cannot be proved. It
is then tested on drawn views; if none breaks it, the verdict is "not proved". A counterexample is a view of plain
numbers on which the policy itself was run again and failed.

The proof does not cover fleets larger than `max_drones`, another period than the one given, and NaN. It does not notice
two things: a comparison of text in which a number stands among other text (`f"charge {soc:.2f}" == "charge 0.12"`:
Python makes plain text of it), and a policy that inspects its input with `is`, `id`, or code that is not Python. For the
text of a number alone, `isinstance` and `type`, the policy gets the same result as in flight, or it is not proved.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from sortie.policies.contract import FleetView, Policy, PolicyError, check_directives, find_wrong_type
from sortie.policies.verification.confine import uses_builtin
from sortie.policies.verification.conformance import missing_links, older_views, raised_part, without_detached
from sortie.policies.verification.invariants import Invariant, describe_directives, just_heard, violations
from sortie.policies.verification.ranges import FleetOfRanges
from sortie.policies.verification.symbols import Path, Refused, explore
from sortie.policies.verification.views import draw_views, shrink

MAX_DRONES = 4
MAX_CELLS = 200_000
TRIED_VIEWS = 1000

Outcome = Literal["proved", "refuted", "not proved"]


@dataclass(frozen=True, slots=True)
class Property:
    """A property to prove: a function that returns a complaint about a policy on a view, or None."""

    name: str
    complaint: Callable[[Policy, RepeatableView], str | None]


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
    """Produces views with the same inputs any number of times: as they are, at age 0, or older."""

    def __init__(
        self,
        plain: FleetView | None = None,
        system: FleetOfRanges | None = None,
        raised: Mapping[int, float] | None = None,
    ) -> None:
        self._plain, self._system, self._raised = plain, system, raised

    def now(self) -> FleetView:
        """The view itself, each time with new mappings."""
        if self._system is not None:
            return self._system.view()
        assert self._plain is not None  # noqa: S101
        return self._plain._replace(descriptors=dict(self._plain.descriptors), age_s=dict(self._plain.age_s))

    def just_heard(self) -> FleetView:
        """The view with every age 0."""
        return just_heard(self.now())

    def older(self) -> Iterator[FleetView]:
        """The view with raised ages: any raise in a search, a few of them for a plain view."""
        if self._system is not None:
            yield self._system.older_view()
            return
        if self._raised is not None:
            yield self.now()._replace(age_s=dict(self._raised))
        yield from (older for _, _, older in older_views(self.now()))


# --- properties ----------------------------------------------------------------------------------


def keeps_contract(policy: Policy, view: RepeatableView) -> str | None:
    """Bounds, and one directive per link."""
    directives = list(policy(view.now()))
    try:
        check_directives(directives, view.now())
    except PolicyError as error:
        return str(error)
    return missing_links(directives, view.now())


def only_falls_with_age(policy: Policy, view: RepeatableView) -> str | None:
    """Raising any ages raises no directive's representation, budget or rate (`conformance.age_monotone`)."""
    before = list(policy(view.now()))
    for older in view.older():
        after = policy(older)
        if raised_part(before, after) is None:
            continue
        raised = raised_part(before, after, policy(without_detached(view.now(), older)))
        if raised is not None:
            ages = ", ".join(f"{i}: {a!r}" for i, a in older.age_s.items())
            return f"with ages raised to {ages} s, {raised}"
    return None


def property_of(invariant: Invariant) -> Property:
    """An invariant as a property to prove."""

    def complaint(policy: Policy, view: RepeatableView) -> str | None:
        directives = list(policy(view.now()))
        fresh = list(policy(view.just_heard())) if invariant.needs_fresh else []
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
    max_drones: int = MAX_DRONES,
    period_s: float = 0.1,
    max_cells: int = MAX_CELLS,
    seed: int = 0,
) -> list[ProofVerdict]:
    """Prove or refute the plane's properties and a policy's invariants.

    Args:
        policy: the policy.
        invariants: what it must keep too.
        max_drones: rosters of 1 to this many drones are searched; each drone multiplies the cells by about ten.
        period_s: the plane's period.
        max_cells: a search that would visit more cells stops: not proved.
        seed: of the drawn views on which a property that cannot be proved is tested.

    Returns:
        One verdict for each property, the plane's first.
    """
    properties = [*PLANE, *(property_of(i) for i in invariants)]
    return [_verdict(policy, p, max_drones, period_s, max_cells, seed) for p in properties]


def _verdict(
    policy: Policy, prop: Property, max_drones: int, period_s: float, max_cells: int, seed: int
) -> ProofVerdict:
    def fails(view: FleetView) -> bool:
        return check_property(prop, policy, view) is not None

    try:
        cells, system = _search(policy, prop, max_drones, period_s, max_cells)
    except Refused as refused:
        reason = str(refused)
    else:
        if system is not None:
            found = system.example()
            raised = system.raised_example()
            confirmed = check_property(prop, policy, found, raised)
            if confirmed is not None:
                return ProofVerdict(prop.name, "refuted", confirmed, found, raised)
            reason = "the search finds a fault that no plain view shows"
        elif uses_builtin(policy, type):
            reason = "uses type(…), which gives another type in the search"
        else:
            return ProofVerdict(prop.name, "proved", f"{cells} cells, fleets of 1 to {max_drones}")
    for view in draw_views(seed, TRIED_VIEWS):
        if fails(view):
            small = shrink(view, fails)
            return ProofVerdict(prop.name, "refuted", check_property(prop, policy, small) or "", small)
    return ProofVerdict(prop.name, "not proved", f"{reason}; {TRIED_VIEWS} drawn views keep it")


def check_property(
    prop: Property, policy: Policy, view: FleetView, raised: Mapping[int, float] | None = None
) -> str | None:
    """The complaint of a property about a policy on one plain view. An exception is a complaint."""
    try:
        return prop.complaint(policy, RepeatableView(plain=view, raised=raised))
    except Exception as error:
        return _invalid_directive(policy, view) or f"raises {type(error).__name__}: {error}"


def _invalid_directive(policy: Policy, view: FleetView) -> str | None:
    """The first invalid directive in the policy's output, as text; None if that is not the cause of an exception."""
    try:
        return next((wrong for d in policy(view) if (wrong := find_wrong_type(d)) is not None), None)
    except Exception:
        return None


def _search(
    policy: Policy, prop: Property, max_drones: int, period_s: float, max_cells: int
) -> tuple[int, FleetOfRanges | None]:
    """The number of cells visited, and the first cell on which the property fails."""
    cells = 0
    for drones, ego, heard in _rosters(max_drones):

        def run(
            path: Path, drones: int = drones, ego: int = ego, heard: tuple[int, ...] = heard
        ) -> tuple[str | None, FleetOfRanges]:
            system = FleetOfRanges(path, drones, ego, heard, period_s)
            try:
                return prop.complaint(policy, RepeatableView(system=system)), system
            except Exception as error:  # the policy's fault or the ranges': the run on a plain view decides
                return f"raises {type(error).__name__}", system

        for _, (complaint, system) in explore(run):
            cells += 1
            if complaint is not None:
                return cells, system
            if cells >= max_cells:
                raise Refused(f"more than {max_cells} cells")
    return cells, None


def _rosters(max_drones: int) -> Iterator[tuple[int, int, tuple[int, ...]]]:
    """Every fleet size, ego and subset of drones heard (always with the ego), small fleets first."""
    for drones in range(1, max_drones + 1):
        for ego in range(drones):
            others = [i for i in range(drones) if i != ego]
            for k in range(drones):
                for peers in itertools.combinations(others, k):
                    yield drones, ego, tuple(sorted((ego, *peers)))
