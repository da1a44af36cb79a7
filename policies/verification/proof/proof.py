"""Proofs that a policy keeps its properties on every view of a fleet, or a view on which it does not.

The policy runs on views whose fields are ranges (`sortie.policies.verification.proof.symbols`). Its comparisons divide the
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
| `proved` | every view of fleets of up to so many drones; only of policies in plain Python (`allowed`) |
| `refuted` | a view of plain numbers on which the policy itself was run and failed |
| `tried` | drawn views, some of them at the policy's own constants; none fails |

Drawn views are tried before every proof too, up to the largest fleet that a scenario may have. A proof covers neither
rosters (`context.roster`, and fleets of more than 200 drones), nor another period than the one given, nor another
`detached_after_periods`, nor NaN. Sums and products of inputs are followed over the reals, without rounding; the verdict says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from sortie.policies.contract import DETACHED_AFTER_PERIODS, FleetView, Policy
from sortie.policies.verification.budget import Budget
from sortie.policies.verification.invariants.language import Invariant, InvariantError
from sortie.policies.verification.kit.drawn import TRIED_VIEWS, Drawn
from sortie.policies.verification.kit.single_view import PLANE, Property, check_property, property_of
from sortie.policies.verification.proof.allowed import why_not_provable
from sortie.policies.verification.proof.search import Found, MakePath, Searched, Stopped, search_size
from sortie.policies.verification.proof.solver import solver_paths
from sortie.policies.verification.proof.symbols import Combined, Path, Refused

DRONES = 5
"""The largest fleet that a proof covers if nothing else is asked for."""
PLANE_CELLS, RULE_CELLS = 25_000, 40_000
"""Cells for the search of the plane's properties, and for each invariant, if nothing else is asked for."""
WITH_FAULT_CELLS = 5_000
"""Cells for the whole search once a fault is known: a faulty policy will be searched again."""

Outcome = Literal["proved", "refuted", "tried"]
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


def prove(
    policy: Policy,
    invariants: Sequence[Invariant] = (),
    *,
    max_drones: int = DRONES,
    period_s: float = 0.1,
    cells: int | None = None,
    seed: int = 0,
    views: int = TRIED_VIEWS,
) -> list[ProofVerdict]:
    """Prove or refute the plane's properties and a policy's invariants.

    Args:
        policy: the policy. A proof needs one of Sortie's, or one that `resolve` loaded from a file.
        invariants: what it must keep too.
        max_drones: fleets of 1 to this many drones are searched; each drone multiplies the cells by about ten.
        period_s: the plane's period.
        cells: how many the search of all properties together may visit; None: `PLANE_CELLS`, and `RULE_CELLS` for each
            invariant.
        seed: of the drawn views on which every property is tried first.
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
    budget = Budget(PLANE_CELLS + RULE_CELLS * len(invariants) if cells is None else cells)
    drawn = Drawn(policy, invariants, seed, views).first_faults(properties)
    searched = {prop: Searched(prop.name) for prop in properties}
    for prop, tried in drawn.items():
        if tried.view is not None:
            searched[prop].fault = Found(tried.view, None)
            budget.units = min(budget.units, WITH_FAULT_CELLS)
    coverage = _search(policy, searched, max_drones, period_s, budget)
    verdicts = []
    for prop, found in searched.items():
        fault = found.fault
        if fault is not None:
            said = check_property(prop, policy, fault.view, fault.raised_age_s) or _NOT_REPEATED
            verdicts.append(ProofVerdict(prop.name, "refuted", said, fault.view, fault.raised_age_s))
            continue
        why = found.unclear or coverage.why
        text = f"{drawn[prop].text}; not proved: it {why}" if why else f"{coverage.text(found)}; {drawn[prop].text}"
        verdicts.append(ProofVerdict(prop.name, "tried" if why else "proved", text))
    return verdicts


class _Coverage:
    """What the search of a policy covered."""

    def __init__(self, asked: int, period_s: float) -> None:
        self.asked, self.drones, self.period_s = asked, 0, period_s
        self.exact = True
        self.why = ""
        """Why nothing is proved."""

    def text(self, found: Searched) -> str:
        ended = "" if self.drones == self.asked else f"; the budget ended in fleets of {self.drones + 1}"
        reals = "" if self.exact else ", sums and products without rounding"
        return (
            f"all views of up to {self.drones} drones, at a period of {self.period_s:g} s, detached after "
            f"{DETACHED_AFTER_PERIODS:g} periods, {found.cells} cells{reals}{ended}"
        )


def _search(
    policy: Policy, properties: Mapping[Property, Searched], max_drones: int, period_s: float, budget: Budget
) -> _Coverage:
    """Search fleet by fleet until all is covered, the budget is spent, or the policy cannot be followed."""
    coverage = _Coverage(max_drones, period_s)
    coverage.why = why_not_provable(policy)
    if coverage.why:
        return coverage
    looked_for = [(searched, prop.complaint) for prop, searched in properties.items()]

    def confirm(searched: Searched, fault: Found) -> bool:
        prop = next(p for p, s in properties.items() if s is searched)
        shows = check_property(prop, policy, fault.view, fault.raised_age_s) is not None
        if shows:
            budget.units = min(budget.units, WITH_FAULT_CELLS)
        return shows

    make: MakePath = Path
    try:
        for drones in range(1, max_drones + 1):
            try:
                exact = search_size(policy, looked_for, confirm, drones, period_s, budget, make)
            except Combined as combined:
                make = solver_paths(str(combined))
                exact = search_size(policy, looked_for, confirm, drones, period_s, budget, make)
            coverage.exact = coverage.exact and exact
            coverage.drones = drones
    except Stopped:
        if coverage.drones < min(2, max_drones):
            coverage.why = f"has more cells than the budget of {budget.units:,.0f}"
    except Refused as refused:
        coverage.why = str(refused)
    return coverage
