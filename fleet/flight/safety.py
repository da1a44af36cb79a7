"""The one rule by which drones are granted other ways than planned.

A request is granted only if the rest of the flight is safe with it while all others do as they plan. Less of it is tried
before it is refused. What flies at any time was found safe to the end, so nothing has to be taken back.
"""

from __future__ import annotations

from typing import Protocol, TypeVar

SHARES = (1.0, 0.75, 0.5, 0.25)
"""What is tried of a request before it is refused, the most first."""
INSTANTS_S = 0.1
"""Two ways that both bend are compared at instants so far apart."""
JITTERS = 5.0
"""Places keep so many standard deviations of the pose jitter off the bounds, so that the drones keep them."""

Way = TypeVar("Way")


class Wish(Protocol[Way]):
    """Another way that a drone is to fly, at the moment at which that is decided."""

    def attempt(self, share: float) -> Way | None:
        """The way that a share of the request asks for; None where it changes nothing."""

    def refusal(self, way: Way) -> str:
        """Why a way is not safe; empty where it is."""


def grant(wish: Wish[Way]) -> Way | str | None:
    """What is granted of a request: as much as is safe, or why nothing is; None where there is nothing to change."""
    refused = ""
    for share in SHARES:
        way = wish.attempt(share)
        if way is None:
            break
        refused = wish.refusal(way)
        if not refused:
            return way
    return refused or None
