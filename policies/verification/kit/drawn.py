"""Drawn views on which every property is tried that no search refuted, up to the largest fleet that a scenario may have.

A view drawn from all numbers rarely has the charge at which a policy has its fault. The numbers in its code are good
guesses, so some views lie at these.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from sortie.policies.contract import FleetView, Policy
from sortie.policies.verification.budget import Budget
from sortie.policies.verification.invariants.language import Invariant
from sortie.policies.verification.kit.single_view import PLANE, Property, RepeatableView, check_property, complaint_of
from sortie.policies.verification.kit.views import LARGEST, LONGEST_S, MAX_DRONES, draw_view, shrink
from sortie.policies.verification.subject import constants_of
from sortie.scenarios.disc import LISTED_IDS
from sortie.scenarios.streams import stream

TRIED_VIEWS = 1000
TRIED_AT_CONSTANTS = 200
"""So many more views at most have numbers of the policy's code and invariants; fleets as large as these numbers come on top."""
TRIED_LISTED = 2
"""So many drawn views have `LISTED_IDS` drones, the most with which descriptors list goodput to everyone."""
TRIED_LARGEST = (0.02, 1.0)
"""Drawn views of the largest fleet, each with the share of the others that the ego hears."""
TRIED_READS = 1_000_000
"""A property is tried on views until its decisions have read so many descriptors."""
LARGE_READS = 500_000
"""Larger fleets than `LISTED_IDS` are not tried where a property would read more descriptors than this on one view."""
DECISION_READS = 20
"""A decision counts as so many descriptors more."""
MOST_SIZES, MOST_LARGE_SIZES = 24, 6
"""So many sizes of fleets are tried, and so many more of those whose drones have rosters, which take long to draw."""
MOVED_SIZES = 3
"""So many more views of each of these sizes have numbers at constants."""
_SHARES = ("battery_soc", "cpu_headroom", "gpu_headroom")
_APART = 1_000_000
"""Views at constants are numbered from here on, so that they are others than the drawn ones."""


class Tried(NamedTuple):
    """What drawn views say about one property."""

    view: FleetView | None
    """The first on which it fails, made smaller."""
    text: str
    """How many were tried."""


class Drawn:
    """Drawn views, and the policy's decision on each, which all properties share."""

    def __init__(self, policy: Policy, rules: Sequence[Invariant], seed: int, count: int) -> None:
        self._policy = policy
        views = [
            *(draw_view(seed, number) for number in range(count)),
            *(_large(seed, count + number, LISTED_IDS) for number in range(TRIED_LISTED if count else 0)),
            *views_at(constants_of(policy, rules), seed, min(count, TRIED_AT_CONSTANTS)),
            *(
                _large(seed, count + TRIED_LISTED + k, LARGEST, heard)
                for k, heard in enumerate(TRIED_LARGEST if count else ())
            ),
        ]
        # large ones by size: where a policy is too slow, it was tried on the smaller ones
        self._views = sorted(views, key=lambda view: max(len(view.descriptors), LISTED_IDS))
        self._answers: dict[int, Any] = {}

    def first_faults(self, properties: Sequence[Property]) -> dict[Property, Tried]:
        """For each property, the first view on which it fails, or how many views keep it."""
        ordered = sorted(properties, key=lambda p: p is PLANE[1])  # raised ages take most decisions
        return {prop: self._first_fault(prop) for prop in ordered}

    def _first_fault(self, prop: Property) -> Tried:
        took, at, budget = 0.0, LISTED_IDS, Budget(TRIED_READS)
        for number, view in enumerate(self._views):
            size, before = len(view.descriptors), budget.used
            if budget.is_spent or took * (size / at) ** 2 > LARGE_READS:
                return Tried(None, f"tried on {number} of {len(self._views)} views")
            shown = RepeatableView(view)
            now = shown.now()

            def decide(other: FleetView, /, now: FleetView = now, number: int = number) -> Any:
                if other is not now:
                    return self._counted(other, budget)
                if number not in self._answers:
                    self._answers[number] = self._counted(now, budget)
                return self._answers[number]

            if complaint_of(prop, decide, shown) is not None:
                if check_property(prop, self._policy, view) is None:
                    return Tried(view.frozen, "")  # it fails only sometimes: it is not the same for the same view
                return Tried(shrink(view, lambda v: not budget.is_spent and self._fails(prop, v, budget)), "")
            if size >= LISTED_IDS:
                took, at = max(took, budget.used - before), size
        return Tried(None, f"tried on {len(self._views)} views of up to {LARGEST if self._views else 0:,} drones")

    def _fails(self, prop: Property, view: FleetView, budget: Budget) -> bool:
        return check_property(prop, lambda v: self._counted(v, budget), view) is not None

    def _counted(self, view: FleetView, budget: Budget) -> Any:
        """The policy's decision, at the cost of the descriptors that it reads."""
        budget.spend(DECISION_READS)
        return self._policy(view._replace(descriptors=MappingProxyType(_Reads(view.descriptors, budget))))


class _Reads(dict[int, Any]):
    """Descriptors that count how often they are read: the same on every machine, and nearly as the time of a decision."""

    def __init__(self, content: Mapping[int, Any], budget: Budget) -> None:
        super().__init__(content)
        self._budget = budget

    def copy(self) -> _Reads:
        return _Reads(self, self._budget)

    def __getitem__(self, key: int) -> Any:
        self._budget.spend()
        return super().__getitem__(key)

    def get(self, key: int, default: Any = None) -> Any:
        self._budget.spend()
        return super().get(key, default)

    def _all(self, name: str) -> Any:
        self._budget.spend(len(self))
        return getattr(dict, name)(self)

    def __iter__(self) -> Any:
        return self._all("__iter__")

    def keys(self) -> Any:
        return self._all("keys")

    def values(self) -> Any:
        return self._all("values")

    def items(self) -> Any:
        return self._all("items")


@lru_cache(maxsize=TRIED_LISTED + len(TRIED_LARGEST))
def _large(seed: int, number: int, drones: int, heard: float | None = None) -> FleetView:
    """A view of a large fleet, frozen: each policy is tried on the same ones."""
    return draw_view(seed, number, drones, heard).frozen


def views_at(constants: Iterable[float], seed: int, count: int) -> Iterator[FleetView]:
    """`count` views with numbers at these constants or one float beside them, then a few of fleets that are as large.

    Args:
        constants: a policy's own.
        seed: of all its views.
        count: how many; 0 for none at all.
    """
    known = sorted(set(constants))
    if not known or not count:
        return
    for number in range(count):
        yield _moved(draw_view(seed, _APART + number), known, stream(seed, number, (), "verify.constants"))
    whole = [int(c) for c in known if c == int(c)]
    # with c peers first: a cut leaves no constant out before others have three sizes
    sizes = list(dict.fromkeys(c + more for more in (1, 2, 0) for c in whole if MAX_DRONES < c + more <= LARGEST))
    listed, large = ([size for size in sizes if (size > LISTED_IDS) == is_large] for is_large in (False, True))
    for number, size in enumerate((*listed[:MOST_SIZES], *large[:MOST_LARGE_SIZES])):
        view = draw_view(seed, _APART + count + number, size, 1.0)
        egos = [c for c in whole if c in view.descriptors and c > MAX_DRONES][:1]
        for of_ego in (view, *(view._replace(ego=ego) for ego in egos if ego != view.ego)):
            yield of_ego
            for k in range(MOVED_SIZES if size <= LISTED_IDS else 0):
                yield _moved(of_ego, known, stream(seed, number, (k,), "verify.sizes"))


def _moved(view: FleetView, constants: Sequence[float], rng: np.random.Generator) -> FleetView:
    """The view with some numbers at constants."""

    def near(low: float, high: float) -> float | None:
        known = [c for c in constants if low <= c <= high]
        if not known or rng.random() < 0.3:
            return None
        c = float(rng.choice(known))
        around = (c, c, math.nextafter(c, -math.inf), math.nextafter(c, math.inf))
        return float(min(max(float(rng.choice(around)), low), high))

    descriptors, ages_s = dict(view.descriptors), dict(view.age_s)
    egos = [int(c) for c in constants if c in descriptors]
    ego = int(rng.choice(egos)) if egos and rng.random() < 0.3 else view.ego
    together = rng.random() < 0.5  # of all drones, or of the ego alone
    for i, d in descriptors.items():
        if i != ego and not together:
            continue
        changed: dict[str, Any] = {field: x for field in _SHARES if (x := near(0, 1)) is not None}
        goodput, age_s, flags = near(0, 1e5), near(0, LONGEST_S), near(0, 255)
        if goodput is not None:
            changed["peer_goodput_mbps"] = (goodput,) * len(d.peer_goodput_mbps)
        if flags is not None and rng.random() < 0.3:
            changed["novelty_flags"] = int(flags)
        if age_s is not None and rng.random() < 0.5:
            ages_s[i] = age_s
        descriptors[i] = d._replace(**changed)
    return view._replace(ego=ego, descriptors=descriptors, age_s=ages_s)
