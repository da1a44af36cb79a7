"""The search behind the proofs: every cell of views of every fleet up to a size, each replayed on plain objects.

For each roster, ego and subset of drones heard, the policy runs once in each cell into which its own comparisons divide
the inputs. Each property then divides that cell further. The policy decides on a plain view of every cell too, and must
decide the same there; otherwise nothing is proved.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from sortie.policies.contract import Directive, Disc, FleetView, Policy
from sortie.policies.verification.budget import Budget
from sortie.policies.verification.proof.ranges import FleetOfRanges
from sortie.policies.verification.proof.symbols import Combined, Path, Ranged, Refused, explore
from sortie.policies.verification.subject import function_of
from sortie.scenarios.plugins.user_calls import Guarded

MakePath = Callable[[Sequence[int]], Path]
QUESTION = 5
"""A question to the solver counts as so many cells."""


class Found(NamedTuple):
    """A cell in which a property fails."""

    view: FleetView
    raised_age_s: Mapping[int, float] | None


class Searched:
    """What a search of a property has found so far."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.cells = 0
        self.fault: Found | None = None
        self.unclear = ""
        """Why nothing is proved although no fault was confirmed."""


class Stopped(Exception):
    """The budget ended the search."""


Complaint = Callable[[Policy, Any], str | None]
"""A property: from a policy and a view that can be had again to what is wrong."""


def search_size(
    policy: Policy,
    properties: Sequence[tuple[Searched, Complaint]],
    confirm: Callable[[Searched, Found], bool],
    drones: int,
    period_s: float,
    budget: Budget,
    make: MakePath = Path,
) -> bool:
    """Search all views of fleets of one size.

    Args:
        policy: the policy; it runs on stand-ins, and on a plain view of each cell.
        properties: what to look for; those with a fault are left out.
        confirm: whether a cell's plain view shows the fault as well.
        drones: the size.
        period_s: the plane's period.
        budget: in cells; a run of the policy counts as one, too.
        make: makes the paths; left out, ranges of single inputs.

    Returns:
        Whether every run was exact; False where sums and products of inputs were followed over the reals.

    Raises:
        Refused: the policy cannot be followed.
        Stopped: the budget is spent.
    """
    exact = True
    for ego, heard in rosters(drones):

        def run(path: Path, ego: int = ego, heard: tuple[int, ...] = heard) -> Run:
            return Run(policy, FleetOfRanges(path, drones, ego, heard, period_s))

        for path, found in explore(run, make):
            found.compare()
            budget.spend(1 + QUESTION * path.questions)
            for searched, complaint in properties:
                if searched.fault is None and not searched.unclear:
                    _search_cell(path, found, searched, complaint, confirm, budget)
            exact = exact and path.exact  # a property's own sums and products count too
            if all(searched.fault is not None or searched.unclear for searched, _ in properties):
                return exact
            if budget.is_spent:
                raise Stopped
    return exact


def _search_cell(
    path: Path,
    found: Run,
    searched: Searched,
    complaint: Complaint,
    confirm: Callable[[Searched, Found], bool],
    budget: Budget,
) -> None:
    """Divide a cell further by a property's own comparisons."""

    def act() -> str | None:
        found.system.is_older = False
        try:
            return complaint(found.decide, found)
        except Exception as error:
            return f"raises {type(error).__name__}"

    asked = path.questions
    try:
        for wrong in path.within(act):
            searched.cells += 1
            budget.spend(1 + QUESTION * (path.questions - asked))
            asked = path.questions
            if wrong is not None:
                fault = Found(found.system.example(), found.system.raised_example())
                if confirm(searched, fault):
                    searched.fault = fault
                else:
                    searched.unclear = f"the search finds a fault that no plain view shows ({wrong})"
                return
            if budget.is_spent:
                raise Stopped
    except Combined:
        raise
    except Refused as refused:
        searched.unclear = str(refused)


class Run:
    """One run of the policy, and the views that properties ask for."""

    def __init__(self, policy: Policy, system: FleetOfRanges) -> None:
        self._policy, self.system = policy, system
        self._is_users = isinstance(function_of(policy), Guarded)
        self._view = system.view()
        self.answer: Any = None
        self.error: Exception | None = None
        try:
            self.answer = self._ask(self._view)
        except Exception as error:  # the policy's fault or the stand-ins': the plain view decides
            self.error = error

    def _ask(self, view: FleetView) -> Any:
        """What the policy decides. Only a user's may depend on the order of drones; the kit tests it of Sortie's own."""
        self.system.shows_order = self._is_users
        try:
            with self.system.ranked():
                return self._policy(view)
        finally:
            self.system.shows_order = False

    def now(self) -> FleetView:
        """The view itself."""
        return self._view

    def just_heard(self) -> FleetView:
        """The view with every age 0."""
        return self.system.just_heard()

    def older(self) -> Iterator[FleetView]:
        """The view with any raise of its ages."""
        yield self.system.older_view()

    def decide(self, view: FleetView, /) -> Any:
        """What the policy decided on the view itself, or decides on another one."""
        if view is not self._view:
            return self._ask(view)
        if self.error is not None:
            raise self.error
        return self.answer

    def compare(self) -> None:
        """Let the plain policy decide on a plain view of the cell, at its corners as often as inside.

        Raises:
            Refused: it decides otherwise.
        """
        values: dict[str, float] = {}
        draw = random.Random(f"{len(self.system.path.taken)} {self.system.path.taken}")  # noqa: S311

        def choose(axis: str, low: float, high: float) -> float:
            has_middle = low < high and not isinstance(low, int)
            values[axis] = draw.choice((low, high, low / 2 + high / 2) if has_middle else (low, high))
            return values[axis]

        view = self.system.path.corner(self.system, choose)
        if view is None:
            self.system.path.refuse("compares sums or products so closely that floats show no example")
        try:
            real = self._ask(view)
        except Exception as error:
            if self.error is None or type(error) is not type(self.error):
                self.system.path.refuse(f"raises {type(error).__name__} on real objects alone")
            return
        if self.error is not None:
            self.system.path.refuse(f"raises {type(self.error).__name__} on stand-ins alone")
        if _plain(self.answer, values) != _plain(real, values):
            self.system.path.refuse("decides otherwise on real objects than on the stand-ins of the search")


def _plain(answer: Any, values: Mapping[str, float]) -> Any:
    """An answer with the values of a plain view, without reasons."""
    if type(answer) not in (list, tuple):
        return type(answer)
    return [_fields(d, values) if isinstance(d, Directive) else repr(type(d)) for d in answer]


def _fields(directive: Directive, values: Mapping[str, float]) -> tuple[Any, ...]:
    found: list[Any] = [type(directive).__name__]
    for value in tuple.__iter__(directive):
        parts = tuple.__iter__(value) if isinstance(value, Disc) else (value,)
        found += [p._value_in(values) if isinstance(p, Ranged) else p for p in parts]
    return tuple(found[:-1])  # without the reason


def rosters(drones: int) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Every ego of a fleet, with every subset of drones heard."""
    for ego in range(drones):
        others = [i for i in range(drones) if i != ego]
        for k in range(drones):
            for peers in itertools.combinations(others, k):
                yield ego, tuple(sorted((ego, *peers)))
