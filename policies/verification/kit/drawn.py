"""Drawn views on which every property is tried that no search refuted, up to the largest fleet that a scenario may have.

A view drawn from all numbers rarely has the charge at which a policy has its fault. The numbers in its code are good
guesses, so some views lie at these, and some fleets are as large as these.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache, partial
from types import FrameType
from typing import Any, NamedTuple

from sortie.policies.contract import FleetView, Policy
from sortie.policies.verification.invariants.language import Invariant
from sortie.policies.verification.kit.single_view import Property, check_property
from sortie.policies.verification.kit.tried import try_views
from sortie.policies.verification.kit.views import LARGEST, MAX_DRONES, draw_view, draw_views, move_to_constants
from sortie.policies.verification.subject import constants_of
from sortie.scenarios.disc import LISTED_IDS

TRIED_VIEWS = 1200
LARGE_FLEETS = ((LISTED_IDS, None), (LISTED_IDS, None), (LARGEST, 0.02), (LARGEST, 1.0))
"""Drawn views of large fleets: how many drones, and the share of the others that the ego hears. `LISTED_IDS` is the most
with which descriptors list goodput to everyone."""
MOST_SIZES, MOST_LARGE_SIZES = 24, 6
"""So many sizes of fleets at constants are tried, and so many more of those whose drones have rosters."""
LARGE_STEPS = 1_000_000
"""Lines of Python that one decision on each view of more than `MAX_DRONES` drones may take together. A policy that takes more
is tried on the smaller ones of them."""


class Found(NamedTuple):
    """What drawn views say about one property."""

    view: FleetView | None
    """One on which it fails, made smaller; None if there is none."""
    text: str
    """On how many views it was tried."""


class Drawn:
    """Views drawn for a policy, on which its properties are tried."""

    def __init__(self, policy: Policy, rules: Sequence[Invariant], seed: int, count: int) -> None:
        self._policy = policy
        constants = constants_of(policy, rules)
        self._views = list(draw_views(seed, count, constants))
        if count:
            self._views += _affordable(policy, [*_large(seed), *views_at_sizes(constants, seed)])

    def first_faults(self, properties: Sequence[Property]) -> dict[Property, Found]:
        """For each property, a view on which it fails, or how many views keep it."""
        complaints = {prop: partial(check_property, prop, self._policy) for prop in properties}
        largest = max((len(view.descriptors) for view in self._views), default=0)
        return {
            prop: Found(tried.view, f"tried on {tried.judged} views of up to {largest:,} drones")
            for prop, tried in try_views(complaints, self._views).items()
        }


@lru_cache(maxsize=1)
def _large(seed: int) -> tuple[FleetView, ...]:
    """Views of large fleets, frozen: each policy is tried on the same ones."""
    return tuple(draw_view(seed, -number, *fleet).frozen for number, fleet in enumerate(LARGE_FLEETS, 1))


def views_at_sizes(constants: Iterable[float], seed: int) -> Iterator[FleetView]:
    """Views of fleets that are as large as constants, with and without numbers at these; of the larger ones one of each size.

    Args:
        constants: a policy's own.
        seed: of all its views.
    """
    known = sorted(set(constants))
    whole = [int(c) for c in known if c == int(c)]
    # with c peers first: a cut leaves no constant out before others have three sizes
    sizes = list(dict.fromkeys(c + more for more in (1, 2, 0) for c in whole if MAX_DRONES < c + more <= LARGEST))
    listed, large = ([size for size in sizes if (size > LISTED_IDS) == is_large] for is_large in (False, True))
    for size in (*listed[:MOST_SIZES], *large[:MOST_LARGE_SIZES]):
        view = draw_view(seed, -size, size, 1.0)
        yield view
        for number in range(2 if size <= LISTED_IDS else 0):
            yield move_to_constants(view, known, f"{seed} {size} {number}")


def _affordable(policy: Policy, views: Sequence[FleetView]) -> list[FleetView]:
    """The smallest of large views, as many as a policy decides on in `LARGE_STEPS`: the same ones on every machine."""
    _steps_of(policy, draw_view(seed=0, number=0))  # what a policy does at its first decision alone is not counted
    small, twice = (_steps_of(policy, _whole_fleet(drones)) for drones in (LISTED_IDS // 2, LISTED_IDS))
    doublings = max(1.0, math.log2(twice / small) if small else 1.0)
    left, affordable = float(LARGE_STEPS), []
    for view in sorted(views, key=lambda view: len(view.descriptors)):
        left -= twice * (len(view.descriptors) / LISTED_IDS) ** doublings
        if left < 0:
            break
        affordable.append(view)
    return affordable


@lru_cache(maxsize=2)
def _whole_fleet(drones: int) -> FleetView:
    return draw_view(0, -drones, drones, 1.0).frozen


def _steps_of(policy: Policy, view: FleetView) -> int:
    """How many lines of Python a decision runs; to sort the peers counts as a line for every four of them."""
    count, sorts = 0, FleetView.peers.fget.__code__  # type: ignore[attr-defined]

    def follow(frame: FrameType, event: str, argument: object) -> Any:
        nonlocal count
        count += event == "line"
        if event == "call" and frame.f_code is sorts:
            count += len(view.descriptors) // 4
        return follow

    before = sys.gettrace()
    sys.settrace(follow)
    try:
        policy(view)
    except Exception:  # noqa: S110  # a rule says so
        pass
    finally:
        sys.settrace(before)
    return count
