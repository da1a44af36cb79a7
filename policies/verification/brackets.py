"""Links that a shield corrects alike, though their numbers differ.

The numbers that lines compare a field with divide its values into brackets. Values in one bracket compare alike. If they
must change, they change to the same value, because what lines allow lies on one side of them.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence

from sortie.policies.verification.compiled import Context, Part
from sortie.policies.verification.links import AT, RATE_HZ, RHO, Limit, Link


class Brackets:
    """The brackets of each field.

    A field that a line compares with something else than a number counts with its value too, unless its limits change it
    in any case.

    Args:
        limits: of each field, by its place.
        parts: the other parts of the lines. They depend on nothing but the link.
    """

    def __init__(self, limits: Mapping[int, Sequence[Limit]], parts: Sequence[Part]) -> None:
        edges = {at: {value for _, value in limits.get(at, ())} for at in AT.values()}
        for at in (RHO, RATE_HZ):  # whether they are 0 decides whether they follow the representation (`links.changed`)
            edges[at].add(0.0)
        exact: set[int] = set()
        self._tied = []
        for part in parts:
            ways = [part.ways] if part.exempt is None else [part.ways, part.exempt]
            for at, (_, value) in [bound for some in ways for way in some.limits or () for bound in way]:
                edges[at].add(value)
            if any(some.limits is None for some in ways):
                self._tied.append(part.holds)
                exact.update([at for some in ways for way in some.claims for claim in way for at in claim.fields])
        self._begins = [_begins(edges[at]) for at in AT.values()]
        """Where each bracket of a field begins but the first one."""
        self._exact = [(at, _allowed(self._begins[at], limits.get(at, ()))) for at in sorted(exact)]

    def of(self, context: Context, link: Link) -> tuple[object, ...]:
        """What links have in common that break the same lines, and take the nearest of the same corrections (`nearest`)."""
        places = tuple(map(bisect_right, self._begins, link))
        if not self._tied:
            return (places,)
        values = [link[at] for at, allowed in self._exact if allowed[places[at]]]
        return places, *values, *[holds(context, link) for holds in self._tied]


def _begins(edges: Iterable[float]) -> list[float]:
    """Each edge is a bracket of its own, between those below and above it."""
    return [begin for edge in sorted(filter(math.isfinite, edges)) for begin in (edge, math.nextafter(edge, math.inf))]


def _allowed(begins: Sequence[float], limits: Sequence[Limit]) -> list[bool]:
    """Whether the limits allow the values of each bracket."""
    samples = [math.nextafter(begins[0], -math.inf) if begins else 0.0, *begins]
    return [all(compare(sample, value) for compare, value in limits) for sample in samples]
