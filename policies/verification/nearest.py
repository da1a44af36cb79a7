"""The directive nearest to a given one that keeps all lines: the shield's arithmetic.

Lines that bound one field each make a box: for each field, the values that they allow, worked out once for all links to
which the same lines apply. A directive is moved into its box field by field. Where another part is then still broken (it
has an `or`, names several fields, or depends on the peer), each of its ways to hold becomes a smaller box. The nearest box
is tried first, up to `MOST` of them.
"""

from __future__ import annotations

import heapq
import math
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any

from sortie.policies.contract import DIRECTIVE_BOUNDS, Directive, Disc, Representation
from sortie.policies.verification.compiled import READ, Claim, Compare, Context, Part, Rule
from sortie.policies.verification.invariants import Invariant
from sortie.scenarios.representation import AT_LEVEL

LEAST_RATE_HZ = 2.0
"""The rate of a link that a shield makes carry something, if no line names a rate: the bottom rung of the paper's table."""
MOST = 64
"""How many boxes are tried for one link. If none of them keeps all lines, the link stays as it is."""
_HIGHEST: dict[str, float] = {
    **{name: bound.high for name, bound in DIRECTIVE_BOUNDS.items() if name != "duty_percent"},
    "duty": 1.0,
    "roi": 1.0,
}
_FIRST_LEVELS = (0.0, 1.0, 2.0, 3.0, 4.0)
Holds = Callable[[Directive], bool]
Limit = tuple[Compare, float]
"""A comparison that a field must satisfy, and its other side."""
Far = tuple[int, float]
"""How many fields differ, and by how much in all."""


class Box:
    """What some lines together allow.

    Args:
        rules: the lines, all of which apply.
        applies: which of the lines with a condition on the peer these are.
        context: what they are judged on.
        some: any link of the view.
        most: upper bounds of fields, beside those of the lines.
    """

    __slots__ = (
        "_bounded",
        "_checks",
        "_others",
        "applies",
        "broken_by",
        "limits",
        "nearest_to",
        "parts",
        "rules",
        "shared",
    )

    def __init__(
        self,
        rules: Sequence[Rule],
        applies: tuple[bool, ...],
        context: Context,
        some: Directive,
        most: Mapping[str, float] | None = None,
    ) -> None:
        self.rules, self.applies = rules, applies
        limits: dict[str, tuple[Limit, ...]] = {w: ((operator.le, high),) for w, high in (most or {}).items()}
        checks, parts = [], list[tuple[Part, int]]()
        for number, rule in enumerate(rules):
            for part in rule.parts:
                claim = part.bound
                if claim is None or claim.compare is None or claim.value is None:
                    parts.append((part, number))
                    continue
                word, limit = claim.fields[0], (claim.compare, claim.value(context, some))
                checks.append((READ[word], *limit, number))
                limits[word] = (*limits.get(word, ()), limit)
        self._checks = checks
        self.limits = {word: Values(word, limits.get(word, ())) for word in READ}
        """What each field may be."""
        self._bounded = [(word, READ[word], self.limits[word]) for word in limits]
        self.parts = tuple([part for part, _ in parts])
        """The parts that are no bounds of one field, or have another bound for each link."""
        self._others = [(part.holds, number) for part, number in parts]
        self.shared = not any(part.of_peer or part.of_links for part, _ in parts)
        """Whether equal directives of different links get the same correction."""
        self.broken_by: dict[Any, list[Invariant]] = {}
        """The lines that a directive breaks, by its key."""
        self.nearest_to: dict[Any, Directive | None] = {}
        """The directive that replaces another one, by its key."""

    def broken(self, context: Context, link: Directive) -> list[Invariant]:
        """The lines that a link breaks."""
        found = [number for read, compare, value, number in self._checks if not compare(read(link), value)]
        found += [number for holds, number in self._others if not holds(context, link)]
        return [self.rules[i].invariant for i in sorted(set(found))] if found else []

    def clipped(self, link: Directive) -> dict[str, float] | None:
        """The values of the fields that must change for the bounds; None if a field has no value that they allow."""
        wanted: dict[str, float] = {}
        for word, read, values in self._bounded:
            now = read(link)
            value = values.nearest(now)
            if value is None:
                return None
            if value is not now:
                wanted[word] = value
        return wanted

    def key(self, directive: Directive) -> Any:
        """What directives have in common that are corrected alike; None if nothing can be said."""
        if not self.shared:
            return None
        _, _, rung, rho, roi, rate_hz, deadline_s, weight, duty, _ = directive
        for x in (rung, rho, rate_hz, deadline_s, weight, duty):
            if type(x) not in _PLAIN:
                return None
        return rung, rho, id(roi), rate_hz, deadline_s, weight, duty


class Values:
    """What limits allow one field."""

    __slots__ = ("_all", "_more", "limits", "word")

    def __init__(self, word: str, limits: tuple[Limit, ...]) -> None:
        self.word, self.limits = word, limits
        self._all: tuple[float, ...] | None = None
        self._more: dict[Limit, Values] = {}

    def within(self, limit: Limit) -> Values:
        """What these limits and one more allow."""
        if type(limit[1]) not in _PLAIN:
            return self if limit in self.limits else Values(self.word, (*self.limits, limit))
        if limit not in self._more:
            self._more[limit] = self if limit in self.limits else Values(self.word, (*self.limits, limit))
        return self._more[limit]

    def nearest(self, now: float) -> float | None:
        """The value nearest to the present one that the field may have; None without any."""
        for compare, value in self.limits:
            if not compare(now, value):
                break
        else:
            return now
        if self._all is None:
            self._all = _allowed(self.word, self.limits)
        values = self._all
        if not values:
            return None
        if now > values[-1]:
            return values[-1]
        return values[0] if now < values[0] else min(values, key=lambda v: abs(v - now))


_Limits = Mapping[str, Values]
"""What each field may be."""
_Named = Mapping[str, float]
"""The values of fields that are named; other fields may follow them."""
_Try = tuple[int, int, float, int, _Limits, _Named, Directive | None, Part | None]
"""A box within the box: how many conditions it makes false; in how many fields and by how much in all its nearest directive
differs, or lower bounds of that; a number; its limits and named values; its nearest directive, if that is worked out; and the
part whose condition is to be made false."""


def nearest(before: Directive, box: Box, also: Sequence[Part], context: Context, allowed: Holds) -> Directive | None:
    """The nearest directive in the box that keeps the parts `also` and is allowed; None if none was found.

    Args:
        before: the directive.
        box: the lines that apply to this link.
        also: parts of lines about several links.
        context: what all are judged on.
        allowed: which directives may replace others.
    """
    clipped = box.clipped(before)
    if clipped is None:
        return None
    parts, region, number = (*box.parts, *also), context.me.region, 0
    queue: list[_Try] = []
    this: _Try = (0, 0, 0.0, 0, box.limits, clipped, None, None)
    for _ in range(MOST):
        exempted, fields, far, _, limits, named, found, exempts = this
        if found is not None:
            return found
        after = _changed(before, named, region)
        ways: Iterable[_Way] = ()
        if after is None:
            pass
        elif exempts is not None:
            ways = _mended(before, exempts.exempt, limits, named, context, after)
        else:
            broken = _broken(parts, limits, named, context, before, after)
            if isinstance(broken, Part):
                ways = _mended(before, broken.ways, limits, named, context, after)
                if broken.exempt:
                    number += 1
                    heapq.heappush(queue, (exempted + 1, fields, far, number, limits, named, None, broken))
            elif broken is not None:
                ways = broken
            elif allowed(after):
                if not queue or (queue[0][:3] >= this[:3] and not _follows(before, named, after)):
                    return after
                number += 1
                heapq.heappush(queue, (exempted, *distance(before, after), number, limits, named, after, None))
        for tighter, names in ways:
            number += 1
            heapq.heappush(queue, (exempted, *_far(before, names), number, tighter, names, None, None))
        if not queue:
            return None
        this = heapq.heappop(queue)
    return None


def _follows(before: Directive, named: _Named, after: Directive) -> bool:
    """Whether a field changed that was not named."""
    return "representation" in named and any(
        word not in named and READ[word](before) != READ[word](after) for word in ("rho", "rate_hz")
    )


def distance(a: Directive, b: Directive) -> Far:
    """How many fields differ, and by how much in all: a rung counts a quarter, a number its share of its bounds."""
    far, changed = 0.0, 0
    for word, read in READ.items():
        now, then = read(a), read(b)
        if now != then:
            changed, far = changed + 1, far + abs(then - now) / _HIGHEST[word]
    return changed, far


def _far(before: Directive, wanted: Mapping[str, float]) -> Far:
    """The distance to a directive with these values, without what follows from them in other fields."""
    far, changed = 0.0, 0
    for word, value in wanted.items():
        now = READ[word](before)
        if value != now:
            changed, far = changed + 1, far + abs(value - now) / _HIGHEST[word]
    return changed, far


_Way = tuple[_Limits, _Named]


def _broken(
    parts: Sequence[Part], limits: _Limits, named: _Named, context: Context, before: Directive, after: Directive
) -> Part | list[_Way] | None:
    """The first part that is broken; or, if a field followed another one out of the box, how to put it back."""
    if "representation" in named:
        for word in ("rho", "rate_hz"):  # these follow the representation
            read = READ[word]
            now, was = read(after), read(before)
            if now != was and word not in named and limits[word].nearest(now) != now:
                # A link that is to carry something keeps a rate; cells stay as near to what they were as may be.
                value = limits[word].nearest(now if word == "rate_hz" else was)
                return [] if value is None else [(limits, {**named, word: value})]
    for part in parts:
        if not part.holds(context, after):
            return part
    return None


def _mended(
    before: Directive,
    ways: Iterable[Sequence[Claim]],
    within: _Limits,
    names: _Named,
    context: Context,
    after: Directive,
) -> Iterator[_Way]:
    """The limits with which all claims of a way hold; none of a way that another drone or the view decides against."""
    for way in ways:
        limits, named, tied = dict(within), dict(names), None
        for claim in way:
            if claim.value is not None and claim.compare is not None:
                word = claim.fields[0]
                had = limits[word]
                values = limits[word] = had.within((claim.compare, claim.value(context, after)))
                if values is not had:
                    now = READ[word](before)
                    value = values.nearest(now)
                    if value is None:
                        break
                    if value != now or word in named:
                        named[word] = value
            elif not claim.holds(context, after):
                if not claim.fields:
                    break
                tied = tied or claim
        else:
            if tied is None or limits != within:
                yield limits, named
            else:
                yield from _untied(tied, limits, named, context, after)


def _untied(tied: Claim, limits: _Limits, named: _Named, context: Context, after: Directive) -> Iterator[_Way]:
    """The ways to keep a claim about several fields by a change of one of them."""
    allows = {word: limits[word].limits for word in tied.fields}
    values = [(word, _solved(tied, word, allows[word], context, after)) for word in tied.fields]
    if all(value is None for _, value in values):  # one field is not enough
        values = [(word, v) for word in tied.fields for v in _helping(tied, word, allows[word], context, after)]
    for word, value in values:
        if value is not None:
            side = operator.le if value < READ[word](after) else operator.ge
            yield {**limits, word: limits[word].within((side, value))}, {**named, word: value}


def _solved(claim: Claim, word: str, limits: Sequence[Limit], context: Context, after: Directive) -> float | None:
    """The value of one field nearest to the present one at which a claim about several fields holds."""
    high, region = _HIGHEST[word], context.me.region

    def moved(value: float) -> Directive:
        return _changed(after, {word: value}, region) or after

    edges: list[float] = [0.0, high]
    if claim.gap is not None and word != "roi":
        low_gap, high_gap = (claim.gap(context, moved(v)) for v in edges)
        if math.isfinite(low_gap) and math.isfinite(high_gap) and low_gap != high_gap:
            edges.append(-low_gap * high / (high_gap - low_gap))  # exact if the claim is linear in the field
            if claim.gap(context, moved(high / 2)) != (low_gap + high_gap) / 2:
                edges.append(_crossing(lambda v: claim.gap(context, moved(v)), high, low_gap))  # type: ignore[misc]
    now = READ[word](after)
    values = _near(word, edges)
    for compare, value in limits:
        values = [v for v in values if compare(v, value)]
    for value in sorted(values, key=lambda v: abs(v - now)):
        found = _changed(after, {word: value}, region)
        if found is not None and claim.holds(context, found):
            return value
    return None


def _helping(claim: Claim, word: str, limits: Sequence[Limit], context: Context, after: Directive) -> Iterator[float]:
    """The ends of what a field may be that bring the sides of a comparison no further apart; another field may follow.

    In `rate_hz * rho > 1` neither field changes anything while the other one is 0.
    """
    if claim.gap is None:
        return
    values, gap = _allowed_any(word, tuple(limits)), abs(claim.gap(context, after))
    for value in dict.fromkeys((*values[:1], *values[-1:])):
        found = _changed(after, {word: value}, context.me.region)
        if found is not None and value != READ[word](after) and abs(claim.gap(context, found)) <= gap:
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


def _allowed(word: str, limits: tuple[Limit, ...]) -> tuple[float, ...]:
    """Of the values that may be nearest to a forbidden one, those that the limits allow, ascending."""
    plain = all(type(value) in _PLAIN for _, value in limits)
    return _allowed_plain(word, limits) if plain else _allowed_any(word, limits)


def _allowed_any(word: str, limits: tuple[Limit, ...]) -> tuple[float, ...]:
    values = _near(word, (0.0, _HIGHEST[word], *[value for _, value in limits]))
    for compare, value in limits:
        values = [v for v in values if compare(v, value)]
    if not values and word not in ("representation", "roi"):
        edges = sorted(value for _, value in limits if math.isfinite(value))
        between = [(a + b) / 2 for a, b in pairwise(edges)]
        values = [v for v in between if 0 <= v <= _HIGHEST[word] and all(c(v, edge) for c, edge in limits)]
    return tuple(values)


@lru_cache(maxsize=4096)  # lines name few values, and decisions are many
def _allowed_plain(word: str, limits: tuple[Limit, ...]) -> tuple[float, ...]:
    return tuple([float(value) for value in _allowed_any(word, limits)])


_PLAIN = (float, int, Representation)


def _near(word: str, edges: Iterable[float]) -> list[float]:
    """Values at edges and on both sides of them, ascending."""
    if word == "representation":  # uncertain boxes and codes only where a line names them: else a policy chooses them
        return sorted({*_FIRST_LEVELS, *(float(e) for e in edges if e in AT_LEVEL)})
    if word == "roi":
        return [0.0, 1.0]
    found: set[float] = set()
    for edge in edges:
        if word == "duty" and math.isfinite(edge):
            percent = math.floor(edge * 100)
            found.update([p / 100 for p in (percent - 1, percent, percent + 1, percent + 2)])
        elif math.isfinite(edge):
            step = max(abs(edge), 0.01) * 0.01  # large enough to survive the wire's rounding
            found.update((edge - step, edge, edge + step))
    return sorted([v for v in found if 0 <= v <= _HIGHEST[word]])


def _changed(before: Directive, wanted: Mapping[str, float], region: Disc | None) -> Directive | None:
    """The directive with changed fields; None if there is no such directive."""
    if not wanted:
        return before
    fields: list[Any] = list(before)
    for word, value in wanted.items():
        if word == "representation":
            rung = fields[_RUNG] = AT_LEVEL[value]
            if rung != before.representation:
                if rung < Representation.CODES and before.rho and "rho" not in wanted:
                    fields[_RHO] = 0.0  # only codes and features have cells
                if rung > before.representation and before.rate_hz <= 0 and "rate_hz" not in wanted:
                    fields[_RATE_HZ] = LEAST_RATE_HZ  # a link at 0 Hz carries nothing
        elif word == "duty":
            fields[_DUTY] = round(value * 100)
        elif word == "roi":
            if value and region is None:
                return None
            fields[_ROI] = region if value else None
        else:
            fields[_AT[word]] = value
    return Directive._make(fields)


_AT = {word: at for at, word in enumerate(Directive._fields)}
_RUNG, _RHO, _ROI, _RATE_HZ, _DUTY = (_AT[w] for w in ("representation", "rho", "roi", "rate_hz", "duty_percent"))
