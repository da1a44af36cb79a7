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
rosters (`context.roster`, and fleets of more than 200 drones), nor another period than the one given, nor another `detached_after_periods`, nor NaN.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from sortie.policies.contract import DETACHED_AFTER_PERIODS, FleetView, Policy
from sortie.policies.verification.advice import advise
from sortie.policies.verification.confine import Reached
from sortie.policies.verification.drawn import TRIED_VIEWS, Drawn
from sortie.policies.verification.invariants import Invariant, InvariantError
from sortie.policies.verification.search import BUDGET_S, Budget, Found, Searched, Stopped, search_size
from sortie.policies.verification.single_view import PLANE, Property, check_property, property_of
from sortie.policies.verification.solver import solver_paths
from sortie.policies.verification.subject import searchable, with_notes
from sortie.policies.verification.symbols import Combined, Refused
from sortie.scenarios.plugins.user_calls import text_of

DRONES = 5
"""The largest fleet that a proof covers if nothing else is asked for."""

Outcome = Literal["proved", "proved over the reals", "refuted", "searched", "drawn"]
PROVED = ("proved", "proved over the reals")
_NOT_REPEATED = "not the same for the same view: it fails on this view only sometimes"


@dataclass(frozen=True, slots=True)
class ProofVerdict:
    """The verdict on one property."""

    name: str
    outcome: Outcome
    what: str
    counterexample: FleetView | None = None
    raised_age_s: Mapping[int, float] | None = None
    """The raised ages of the counterexample, if the property is about raised ages."""


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
        views: how many of them, besides a few of large fleets; 0 for none at all.

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
    tried = Drawn(policy, invariants, seed, views)
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
