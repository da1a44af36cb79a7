"""Drawn views on which every property is tried that no search refuted, up to the largest fleet that a scenario may have.

A view drawn from all numbers rarely has the charge at which a policy has its fault. The numbers in its code are good
guesses, so some views lie at these.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
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
LEAST_S = 8.0
"""The least processor time for all properties together."""
LARGE_S = 5.0
"""Larger fleets than `LISTED_IDS` are not tried where a property would take more processor time than this."""
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

    def first_faults(self, properties: Sequence[Property], budget_s: float) -> dict[Property, Tried]:
        """For each property, the first view on which it fails, or how many views keep it."""
        ordered = sorted(properties, key=lambda p: p is PLANE[1])  # raised ages cost most: they get what others leave
        shares = Budget(max(LEAST_S, budget_s)).shares(len(ordered))
        return {prop: self._first_fault(prop, share) for prop, share in zip(ordered, shares, strict=True)}

    def _first_fault(self, prop: Property, budget: Budget) -> Tried:
        took_s, at = 0.0, LISTED_IDS
        for number, view in enumerate(self._views):
            size = len(view.descriptors)
            if budget.is_spent or took_s * (size / at) ** 2 > LARGE_S:
                return Tried(None, f"tried on {number} of {len(self._views)} views")
            shown, spent = RepeatableView(view), Budget(LARGE_S)
            now = shown.now()

            def decide(other: FleetView, /, now: FleetView = now, number: int = number) -> Any:
                if other is not now:
                    return self._policy(other)
                if number not in self._answers:
                    self._answers[number] = self._policy(now)
                return self._answers[number]

            if complaint_of(prop, decide, shown) is not None:
                if check_property(prop, self._policy, view) is None:
                    return Tried(view.frozen, "")  # it fails only sometimes: it is not the same for the same view
                return Tried(shrink(view, lambda v: not budget.is_spent and self._fails(prop, v)), "")
            if size >= LISTED_IDS:
                took_s, at = max(took_s, spent.used_s), size
        return Tried(None, f"tried on {len(self._views)} views of up to {LARGEST if self._views else 0:,} drones")

    def _fails(self, prop: Property, view: FleetView) -> bool:
        return check_property(prop, self._policy, view) is not None


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
