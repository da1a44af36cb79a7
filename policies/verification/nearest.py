"""The link nearest to a given one that keeps all lines: the shield's search.

A link is moved into the box of its lines (`boxes`) field by field. Where another part is then still broken (it has an
`or`, names several fields, or depends on the peer), each of its ways to hold becomes a smaller box. The nearest box is
tried first, up to `MOST` of them.
"""

from __future__ import annotations

import heapq
import math
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from sortie.policies.verification.boxes import Box, Room, Values, allowed_any, near
from sortie.policies.verification.compiled import Claim, Context, Part, Ways
from sortie.policies.verification.links import (
    HIGHEST,
    LEVEL,
    RATE_HZ,
    RHO,
    ROI,
    Far,
    Limit,
    Link,
    changed,
    distance,
    further,
)

MOST = 64
"""How many boxes are tried for one link. If none of them keeps all lines, the link stays as it is."""
_Named = Mapping[int, float]
"""The values of fields that are named, by their places; other fields may follow them."""
_Way = tuple[Room, _Named]
"""A smaller room, and the values that are named beside those before."""
_Try = tuple[int, Far | None, int, Room | None, _Named, Link, _Named, Ways | None]
"""A box within the box: how many conditions it makes false; how far its nearest link is, or a lower bound of that, and None
where nothing else is as good; a number; its room and named values; a link, and the values by which its nearest link differs
from that; and how a condition is to be made false. Without a room it is the link."""


def nearest(
    before: Link,
    box: Box,
    also: tuple[Part, ...],
    context: Context,
    *,
    with_others: bool = False,
) -> tuple[Link | None, list[Link] | None]:
    """The nearest link in the box that keeps the parts `also`, None if none was found; and others that change as many fields.

    All links in the same brackets change to one of these, to the nearest. There is no other one where two boxes to be tried
    never changed equally many fields, so that amounts were not compared. None where not all were found.

    Args:
        before: the link.
        box: the lines that apply to it.
        also: parts of lines about several links.
        context: what all are judged on.
        with_others: look for the others too, if there may be any.
    """
    named: Any = box.clipped(before)
    if None in named.values():
        return None, []
    parts, region, number, by_count = box.parts + also, context.me.region, 0, True
    found: list[Link] = []
    fewest = (0, 0)
    queue: list[_Try] = []
    this: _Try = (0, _HERE, 0, box.room, named, before, named, None)
    for _ in range(MOST):
        exempted, far, _, room, named, base, changes, exempts = this
        after = base if room is None else changed(base, changes, region)
        ways: Sequence[_Way] = ()
        keeps_all = room is None
        if after is None or room is None:
            pass
        elif exempts is not None:
            ways = _mended(before, exempts, room, named, context, after)
        elif (RHO not in named or RATE_HZ not in named) and (back := _put_back(room, named, before, after)) is not None:
            ways = back
        else:
            for part in parts:
                if not part.holds(context, after):
                    ways = _mended(before, part.ways, room, named, context, after)
                    if part.exempt is not None:
                        number += 1
                        far = far or further(_HERE, before, named)
                        heapq.heappush(queue, (exempted + 1, far, number, room, named, after, _NO_CHANGE, part.exempt))
                    break
            else:
                keeps_all = not queue or (queue[0][:2] >= this[:2] and not _follows(before, named, after))
                if not keeps_all:
                    number += 1
                    at = distance(before, after)
                    heapq.heappush(queue, (exempted, at, number, None, named, after, _NO_CHANGE, None))
        if keeps_all and after is not None:
            if by_count or not with_others:
                return after, [] if by_count else None
            fields = exempted, distance(before, after)[0]
            fewest = fewest if found else fields
            if fields == fewest and after not in found:
                found.append(after)
        # The only way is followed at once, without its distance, where all in the queue makes more conditions false.
        only = len(ways) == 1 and (not queue or queue[0][0] > exempted)
        here = None if only or not ways else further(_HERE, before, named)
        for tighter, changes in ways:
            number += 1
            names = {**named, **changes}
            if here is None:
                far = None
            elif len(names) == len(named) + len(changes):
                far = further(here, before, changes)
            else:  # a value takes another one's place
                far = further(_HERE, before, names)
            if after is None or LEVEL in changes:  # other fields may follow, or no longer follow
                this = (exempted, far, number, tighter, names, before, names, None)
            else:
                this = (exempted, far, number, tighter, names, after, changes, None)
            if not only:
                heapq.heappush(queue, this)
        if not only:
            if not queue or (found and _fewest(queue[0]) > fewest):
                return (found[0], found[1:]) if found else (None, [])
            this = heapq.heappop(queue)
            if by_count and queue and _fewest(queue[0]) == _fewest(this):
                by_count = False
    return (found[0] if found else None), ([] if by_count else None)


def _fewest(a_try: _Try) -> tuple[int, int]:
    """How many conditions it makes false, and how many fields change."""
    exempted, far = a_try[:2]
    return exempted, 0 if far is None else far[0]


_HERE: Far = 0, 0.0
_NO_CHANGE: _Named = {}


def _follows(before: Link, named: _Named, after: Link) -> bool:
    """Whether a field changed that was not named."""
    return LEVEL in named and any(at not in named and before[at] != after[at] for at in (RHO, RATE_HZ))


def _put_back(room: Room, named: _Named, before: Link, after: Link) -> Sequence[_Way] | None:
    """How to put back a field that followed the representation out of the box; None if none did."""
    for at in (RHO, RATE_HZ):
        now = after[at]
        if at not in named and now != before[at] and room.values[at].nearest(now) != now:
            # A link that is to carry something keeps a rate; cells stay as near to what they were as may be.
            value = room.values[at].nearest(now if at == RATE_HZ else before[at])
            return () if value is None else ((room, {at: value}),)
    return None


def _mended(before: Link, ways: Ways, room: Room, named: _Named, context: Context, after: Link) -> list[_Way]:
    """The rooms in which all claims of a way hold; none of a way that another drone or the view decides against."""
    found: list[_Way] = []
    if ways.limits is not None:
        for smaller, fields in room.within(ways):
            if (changes := _nearest_in(fields, before, named)) is not None:
                found.append((smaller, changes))
        return found
    for way in ways.claims:
        tighter: dict[int, Values] = {}
        tied = None
        for claim in way:
            if claim.value is not None and claim.compare is not None:
                (at,) = claim.fields
                values = tighter.get(at, room.values[at]).within((claim.compare, claim.value(context, after)))
                if values is not room.values[at]:
                    tighter[at] = values
            elif not claim.holds(context, after):
                if not claim.fields:
                    break
                tied = tied or claim
        else:
            if tied is not None and not tighter:
                found += _untied(tied, room, context, after)
            elif (changes := _nearest_in(tighter.items(), before, named)) is not None:
                found.append((room.having(tighter), changes))
    return found


def _nearest_in(fields: Iterable[tuple[int, Values]], before: Link, named: _Named) -> dict[int, float] | None:
    """The values nearest to those before, of fields that must change or are named; None if a field has none."""
    changes: dict[int, float] = {}
    for at, values in fields:
        now = before[at]
        value = values.nearest(now)
        if value is None:
            return None
        if value != now or at in named:
            changes[at] = value
    return changes


def _untied(tied: Claim, room: Room, context: Context, after: Link) -> Iterator[_Way]:
    """The ways to keep a claim about several fields by a change of one of them."""
    limits = [values.limits for values in room.values]
    changes = [(at, _solved(tied, at, limits[at], context, after)) for at in tied.fields]
    if all(value is None for _, value in changes):  # one field is not enough
        changes = [(at, v) for at in tied.fields for v in _helping(tied, at, limits[at], context, after)]
    for at, value in changes:
        if value is not None:
            side = operator.le if value < after[at] else operator.ge
            yield room.having({at: room.values[at].within((side, value))}), {at: value}


def _solved(claim: Claim, at: int, limits: Sequence[Limit], context: Context, after: Link) -> float | None:
    """The value of one field nearest to the present one at which a claim about several fields holds."""
    high, region = HIGHEST[at], context.me.region

    def moved(value: float) -> Link:
        return changed(after, {at: value}, region) or after

    edges: list[float] = [0.0, high]
    if claim.gap is not None and at != ROI:
        low_gap, high_gap = (claim.gap(context, moved(v)) for v in edges)
        if math.isfinite(low_gap) and math.isfinite(high_gap) and low_gap != high_gap:
            edges.append(-low_gap * high / (high_gap - low_gap))  # exact if the claim is linear in the field
            if claim.gap(context, moved(high / 2)) != (low_gap + high_gap) / 2:
                edges.append(_crossing(lambda v: claim.gap(context, moved(v)), high, low_gap))  # type: ignore[misc]
    now = after[at]
    values = near(at, edges)
    for compare, value in limits:
        values = [v for v in values if compare(v, value)]
    for value in sorted(values, key=lambda v: abs(v - now)):
        found = changed(after, {at: value}, region)
        if found is not None and claim.holds(context, found):
            return value
    return None


def _helping(claim: Claim, at: int, limits: Sequence[Limit], context: Context, after: Link) -> Iterator[float]:
    """The ends of what a field may be that bring the sides of a comparison no further apart; another field may follow.

    In `rate_hz * rho > 1` neither field changes anything while the other one is 0.
    """
    if claim.gap is None:
        return
    values, gap = allowed_any(at, tuple(limits)), abs(claim.gap(context, after))
    for value in dict.fromkeys((*values[:1], *values[-1:])):
        found = changed(after, {at: value}, context.me.region)
        if found is not None and value != after[at] and abs(claim.gap(context, found)) <= gap:
            yield value


def _crossing(gap: Callable[[float], float], high: float, low_gap: float) -> float:
    """Where a gap changes its sign, by halving."""
    low = 0.0
    for _ in range(12):
        middle = (low + high) / 2
        if (gap(middle) < 0) == (low_gap < 0):
            low = middle
        else:
            high = middle
    return low
