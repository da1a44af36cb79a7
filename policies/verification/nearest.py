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

from sortie.policies.verification.boxes import Box, Limit, Values, allowed_any, near
from sortie.policies.verification.compiled import Claim, Context, Part
from sortie.policies.verification.links import HIGHEST, LEVEL, RATE_HZ, RHO, ROI, Far, Link, changed, distance, further

MOST = 64
"""How many boxes are tried for one link. If none of them keeps all lines, the link stays as it is."""
_Limits = Sequence[Values]
"""What each field may be, by its place."""
_Named = Mapping[int, float]
"""The values of fields that are named, by their places; other fields may follow them."""
_Way = tuple[_Limits, _Named]
"""Tighter limits, and the values that are named beside those before."""
_Try = tuple[int, Far | None, int, _Limits, _Named, Link, _Named, Part | None]
"""A box within the box: how many conditions it makes false; how far its nearest link is, or a lower bound of that, and None
where nothing else is as good; a number; its limits and named values; a link, and the values by which its nearest link differs
from that; and the part whose condition is to be made false."""


def nearest(
    before: Link,
    box: Box,
    also: tuple[Part, ...],
    context: Context,
    allowed: Callable[[Link], bool],
) -> Link | None:
    """The nearest link in the box that keeps the parts `also` and is allowed; None if none was found.

    Args:
        before: the link.
        box: the lines that apply to it.
        also: parts of lines about several links.
        context: what all are judged on.
        allowed: which links may replace others.
    """
    named: Any = box.clipped(before)
    if None in named.values():
        return None
    parts, region, number = box.parts + also, context.me.region, 0
    queue: list[_Try] = []
    this: _Try = (0, _HERE, 0, box.limits, named, before, named, None)
    for _ in range(MOST):
        exempted, far, _, limits, named, base, changes, exempts = this
        if not limits:
            return base
        after = changed(base, changes, region)
        ways: Sequence[_Way] = ()
        if after is None:
            pass
        elif exempts is not None:
            ways = _mended(before, exempts.exempt, limits, named, context, after)
        elif LEVEL in named and (back := _put_back(limits, named, before, after)) is not None:
            ways = back
        elif (broken := _first_broken(parts, context, after)) is not None:
            ways = _mended(before, broken.ways, limits, named, context, after)
            if broken.exempt:
                number += 1
                far = far or further(_HERE, before, named)
                heapq.heappush(queue, (exempted + 1, far, number, limits, named, after, _NO_CHANGE, broken))
        elif allowed(after):
            if not queue or (queue[0][:2] >= this[:2] and not _follows(before, named, after)):
                return after
            number += 1
            found = distance(before, after)
            heapq.heappush(queue, (exempted, found, number, (), named, after, _NO_CHANGE, None))
        # The only way is followed at once, without its distance, where all in the queue makes more conditions false.
        only = len(ways) == 1 and (not queue or queue[0][0] > exempted)
        for tighter, changes in ways:
            number += 1
            names = {**named, **changes}
            far = None if only else further(_HERE, before, names)
            if after is None or LEVEL in changes:  # other fields may follow, or no longer follow
                this = (exempted, far, number, tighter, names, before, names, None)
            else:
                this = (exempted, far, number, tighter, names, after, changes, None)
            if not only:
                heapq.heappush(queue, this)
        if not only:
            if not queue:
                return None
            this = heapq.heappop(queue)
    return None


_HERE: Far = 0, 0.0
_NO_CHANGE: _Named = {}


def _follows(before: Link, named: _Named, after: Link) -> bool:
    """Whether a field changed that was not named."""
    return LEVEL in named and any(at not in named and before[at] != after[at] for at in (RHO, RATE_HZ))


def _put_back(limits: _Limits, named: _Named, before: Link, after: Link) -> Sequence[_Way] | None:
    """How to put back a field that followed the representation out of the box; None if none did."""
    for at in (RHO, RATE_HZ):
        now = after[at]
        if at not in named and now != before[at] and limits[at].nearest(now) != now:
            # A link that is to carry something keeps a rate; cells stay as near to what they were as may be.
            value = limits[at].nearest(now if at == RATE_HZ else before[at])
            return () if value is None else ((limits, {at: value}),)
    return None


def _first_broken(parts: Iterable[Part], context: Context, link: Link) -> Part | None:
    for part in parts:
        if not part.holds(context, link):
            return part
    return None


def _mended(
    before: Link,
    ways: Iterable[Sequence[Claim]],
    within: _Limits,
    named: _Named,
    context: Context,
    after: Link,
) -> list[_Way]:
    """The limits with which all claims of a way hold; none of a way that another drone or the view decides against."""
    found: list[_Way] = []
    changes: dict[int, float]
    for way in ways:
        limits, changes, tied = list(within), {}, None
        for claim in way:
            if claim.value is not None and claim.compare is not None:
                (at,) = claim.fields
                values = limits[at].within((claim.compare, claim.value(context, after)))
                if values is not limits[at]:
                    limits[at], now = values, before[at]
                    value = values.nearest(now)
                    if value is None:
                        break
                    if value != now or at in named or at in changes:
                        changes[at] = value
            elif not claim.holds(context, after):
                if not claim.fields:
                    break
                tied = tied or claim
        else:
            if tied is None or limits != within:
                found.append((limits, changes))
            else:
                found += _untied(tied, limits, context, after)
    return found


def _untied(tied: Claim, limits: _Limits, context: Context, after: Link) -> Iterator[_Way]:
    """The ways to keep a claim about several fields by a change of one of them."""
    values = [(at, _solved(tied, at, limits[at].limits, context, after)) for at in tied.fields]
    if all(value is None for _, value in values):  # one field is not enough
        values = [(at, v) for at in tied.fields for v in _helping(tied, at, limits[at].limits, context, after)]
    for at, value in values:
        if value is not None:
            tighter, side = list(limits), operator.le if value < after[at] else operator.ge
            tighter[at] = limits[at].within((side, value))
            yield tighter, {at: value}


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
