"""Links that a shield corrects alike, though their numbers differ.

The numbers that lines compare a field with cut its values into brackets. Two values in one bracket compare alike. If they
must change, they change to the same value, because what lines allow lies on one side of them.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise

from sortie.policies.verification.compiled import Context, Part
from sortie.policies.verification.links import AT, RATE_HZ, RHO, Limit, Link

_Marks = tuple[Sequence[float], Sequence[float | None]]
"""The values at which a field's next bracket begins, and each bracket's mark; None where the value itself is the mark."""
_ITSELF: _Marks = (), (None,)


class Brackets:
    """The brackets of each field.

    A field that a line compares with something else than a number counts with its value, unless its limits change it in
    any case.

    Args:
        limits: of each field, by its place.
        parts: the other parts of the lines. They depend on nothing but the link.
    """

    def __init__(self, limits: Mapping[int, Sequence[Limit]], parts: Sequence[Part]) -> None:
        named: dict[int, list[Limit]] = {at: list(limits.get(at, ())) for at in AT.values()}
        exact: set[int] = set()
        self._tied = []
        for part in parts:
            ways = [part.ways] if part.exempt is None else [part.ways, part.exempt]
            for at, limit in [bound for some in ways for way in some.limits or () for bound in way]:
                named[at].append(limit)
            if any(some.limits is None for some in ways):
                self._tied.append(part.holds)
                exact.update([at for some in ways for way in some.claims for claim in way for at in claim.fields])
        self._marks = [
            _marks({*_FOLLOWS.get(at, ()), *[value for _, value in named[at]]}, limits.get(at, ()), at in exact)
            for at in AT.values()
        ]

    def of(self, context: Context, link: Link) -> tuple[float, ...]:
        """What links have in common that break the same lines, and change alike if counts decide (`nearest`)."""
        fields = [
            now if (mark := marks[bisect_right(begins, now)]) is None else mark
            for now, (begins, marks) in zip(link, self._marks, strict=False)
        ]
        return (*fields, *[holds(context, link) for holds in self._tied])


_FOLLOWS = {RHO: (0.0,), RATE_HZ: (0.0,)}
"""Whether these are 0 decides whether they follow the representation (`links.changed`)."""


def _marks(edges: Collection[float], limits: Sequence[Limit], exact: bool) -> _Marks:
    """The brackets of one field: each edge alone, and what lies between edges. Marks are negative, so no value is one."""
    edges = sorted(filter(math.isfinite, edges))
    if not edges:
        return _ITSELF if exact else ((), (-1.0,))
    between = [edges[0] - 1, *[(a + b) / 2 for a, b in pairwise(edges)], edges[-1] + 1]
    samples = [between[0]]
    for edge, after in zip(edges, between[1:], strict=True):
        samples += edge, after
    marks = [
        None if exact and all(compare(sample, value) for compare, value in limits) else -1.0 - n
        for n, sample in enumerate(samples)
    ]
    return [begin for edge in edges for begin in (edge, math.nextafter(edge, math.inf))], marks
