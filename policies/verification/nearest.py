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
from typing import Any, NamedTuple

from sortie.policies.contract import DIRECTIVE_BOUNDS, Directive, Disc, Representation
from sortie.policies.verification.compiled import Claim, Compare, Context, Part, Rule
from sortie.scenarios.representation import AT_LEVEL, LEVELS

LEAST_RATE_HZ = 2.0
"""The rate of a link that a shield makes carry something, if no line names a rate: the bottom rung of the paper's table."""
MOST = 64
"""How many boxes are tried for one link. If none of them keeps all lines, the link stays as it is."""
_HIGHEST: dict[str, float] = {
    **{name: bound.high for name, bound in DIRECTIVE_BOUNDS.items() if name != "duty_percent"},
    "duty": 1.0,
    "roi": 1.0,
}
_READ: dict[str, Callable[[Directive], Any]] = {
    **{
        word: operator.itemgetter(Directive._fields.index(word))
        for word in ("rho", "rate_hz", "deadline_s", "fusion_weight")
    },
    "representation": lambda d: LEVELS[d.representation],
    "duty": lambda d: d.duty_percent / 100,
    "roi": lambda d: float(d.roi is not None),
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

    __slots__ = ("_bounds", "_checks", "_values", "applies", "limits", "others", "rules", "shared")

    def __init__(
        self,
        rules: Sequence[Rule],
        applies: tuple[bool, ...],
        context: Context,
        some: Directive,
        most: Mapping[str, float] | None = None,
    ) -> None:
        self.rules, self.applies = rules, applies
        self.limits: dict[str, tuple[Limit, ...]] = {w: ((operator.le, high),) for w, high in (most or {}).items()}
        """Of each bounded field."""
        checks, others = [], []
        bounds = [(_READ[w], c, v, -1, w) for w, limits in self.limits.items() for c, v in limits]
        for number, rule in enumerate(rules):
            for part in rule.parts:
                claim = part.bound
                if claim is None or claim.compare is None or claim.value is None:
                    others.append((part.holds, number, part))
                    continue
                word, value = claim.fields[0], claim.value(context, some)
                checks.append((_READ[word], claim.compare, value, number, word))
                self.limits[word] = (*self.limits.get(word, ()), (claim.compare, value))
        self._checks, self._bounds = checks, [*bounds, *checks]
        self.others = tuple(others)
        """The parts that are no bounds of one field, or have another bound for each link."""
        self.shared = not any(part.of_peer or part.of_links for _, _, part in others)
        """Whether equal directives of different links get the same correction."""
        self._values: dict[str, tuple[float, ...]] = {}

    def broken(self, context: Context, link: Directive) -> list[int]:
        """The numbers of the lines that a link breaks."""
        found = [number for read, compare, value, number, _ in self._checks if not compare(read(link), value)]
        found += [number for holds, number, _ in self.others if not holds(context, link)]
        return found

    def clipped(self, link: Directive) -> dict[str, float] | None:
        """The values of the fields that must change for the bounds; None if a field has no value that they allow."""
        wanted: dict[str, float] = {}
        for read, compare, bound, _, word in self._bounds:
            now = read(link)
            if word not in wanted and not compare(now, bound):
                value = self._closest(word, now, ())
                if value is None:
                    return None
                wanted[word] = value
        return wanted

    def moved(self, word: str, now: float, more: Sequence[Limit] = ()) -> float | None:
        """The value nearest to the present one that a field may have; None without any."""
        for compare, value in (*self.limits.get(word, ()), *more):
            if not compare(now, value):
                return self._closest(word, now, more)
        return now

    def _closest(self, word: str, now: float, more: Sequence[Limit]) -> float | None:
        """The same, where the present value is not allowed."""
        if more:
            values = _allowed(word, (*self.limits.get(word, ()), *more))
        elif word in self._values:
            values = self._values[word]
        else:
            values = self._values[word] = _allowed(word, self.limits[word])
        if not values:
            return None
        if now > values[-1]:
            return values[-1]
        return values[0] if now < values[0] else min(values, key=lambda v: abs(v - now))


class _Try(NamedTuple):
    """A box within the box."""

    at_least: tuple[int, Far]
    """How many conditions it makes false, and how far its nearest directive is, or a lower bound of that."""
    number: int
    limits: Mapping[str, tuple[Limit, ...]]
    """Those beside the box's."""
    wanted: Mapping[str, float]
    """The values of fields that are named; other fields may follow them."""
    after: Directive | None = None
    """Its nearest directive, if that is worked out."""
    exempts: Part | None = None
    """The part whose condition is to be made false."""


def nearest(
    before: Directive, box: Box, also: Sequence[Part], context: Context, allowed: Holds, within: Far | None = None
) -> Directive | None:
    """The nearest directive in the box that keeps the parts `also` and is allowed; None if none was found.

    Args:
        before: the directive.
        box: the lines that apply to this link.
        also: parts of a line about all links together.
        context: what all are judged on.
        allowed: which directives may replace others.
        within: only directives nearer than this are wanted.
    """
    wanted = box.clipped(before)
    if wanted is None:
        return None
    parts, count = [*[part for _, _, part in box.others], *also], 0
    queue = [_Try((0, (0, 0.0)), 0, {}, wanted)]
    for _ in range(MOST):
        if not queue:
            return None
        this = heapq.heappop(queue)
        exempted, far = this.at_least
        if within is not None and exempted == 0 and far >= within:
            return None
        if this.after is not None:
            return this.after
        after = _changed(before, this.wanted, context.me.region)
        if after is None:
            continue
        if this.exempts is not None:
            ways = [w for way in this.exempts.exempt for w in _mended(before, way, box, this, context, after)]
        else:
            broken = _broken(box, parts, this, context, before, after)
            if broken is None:
                if allowed(after):
                    if not queue or (queue[0].at_least >= this.at_least and not _follows(before, this.wanted, after)):
                        return after
                    count += 1
                    at = exempted, distance(before, after)
                    heapq.heappush(queue, this._replace(at_least=at, number=count, after=after))
                continue
            if isinstance(broken, Part):
                ways = [w for way in broken.ways for w in _mended(before, way, box, this, context, after)]
                if broken.exempt:
                    count += 1
                    at = exempted + 1, far
                    heapq.heappush(queue, this._replace(at_least=at, number=count, exempts=broken))
            else:
                ways = broken
        for limits, named in ways:
            count += 1
            heapq.heappush(queue, _Try((exempted, _far(before, named)), count, limits, named))
    return None


def _follows(before: Directive, wanted: Mapping[str, float], after: Directive) -> bool:
    """Whether a field changed that was not named."""
    return "representation" in wanted and any(
        word not in wanted and _READ[word](before) != _READ[word](after) for word in ("rho", "rate_hz")
    )


def distance(a: Directive, b: Directive) -> Far:
    """How many fields differ, and by how much in all: a rung counts a quarter, a number its share of its bounds."""
    return _far(a, {word: read(b) for word, read in _READ.items()})


def _far(before: Directive, wanted: Mapping[str, float]) -> Far:
    """The distance to a directive with these values, without what follows from them in other fields."""
    far, changed = 0.0, 0
    for word, value in wanted.items():
        now = _READ[word](before)
        if value != now:
            changed, far = changed + 1, far + abs(value - now) / _HIGHEST[word]
    return changed, far


_Way = tuple[Mapping[str, tuple[Limit, ...]], Mapping[str, float]]
"""Further limits, and the values of fields that are named."""


def _broken(
    box: Box, parts: Sequence[Part], this: _Try, context: Context, before: Directive, after: Directive
) -> Part | list[_Way] | None:
    """The first part that is broken; or, if a field followed another one out of the box, how to put it back."""
    if "representation" in this.wanted:
        for word in ("rho", "rate_hz"):  # these follow the representation
            read = _READ[word]
            now, was = read(after), read(before)
            if now != was and word not in this.wanted and box.moved(word, now, this.limits.get(word, ())) != now:
                # A link that is to carry something keeps a rate; cells stay as near to what they were as may be.
                value = box.moved(word, now if word == "rate_hz" else was, this.limits.get(word, ()))
                return [] if value is None else [(this.limits, {**this.wanted, word: value})]
    return next((part for part in parts if not part.holds(context, after)), None)


def _mended(
    before: Directive, way: Sequence[Claim], box: Box, this: _Try, context: Context, after: Directive
) -> Iterator[_Way]:
    """The limits with which all claims of a way hold; none if another drone or the view decides against it."""
    limits, named, tied = dict(this.limits), dict(this.wanted), None
    for claim in way:
        if claim.value is not None and claim.compare is not None:
            word, limit = claim.fields[0], (claim.compare, claim.value(context, after))
            if limit not in limits.get(word, ()):
                limits[word] = (*limits.get(word, ()), limit)
                now = _READ[word](before)
                value = box.moved(word, now, limits[word])
                if value is None:
                    return
                if value != now or word in named:
                    named[word] = value
        elif not claim.holds(context, after):
            if not claim.fields:
                return
            tied = tied or claim
    if tied is None or limits != this.limits:
        yield limits, named
        return
    allows = {word: (*box.limits.get(word, ()), *limits.get(word, ())) for word in tied.fields}
    values = [(word, _solved(tied, word, allows[word], context, after)) for word in tied.fields]
    if all(value is None for _, value in values):  # one field is not enough
        values = [(word, v) for word in tied.fields for v in _helping(tied, word, allows[word], context, after)]
    for word, value in values:
        if value is not None:
            side = operator.le if value < _READ[word](after) else operator.ge
            yield {**limits, word: (*limits.get(word, ()), (side, value))}, {**named, word: value}


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
    now = _READ[word](after)
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
        if found is not None and value != _READ[word](after) and abs(claim.gap(context, found)) <= gap:
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
    changed: dict[str, Any] = {}
    for word, value in wanted.items():
        if word == "representation":
            changed[word] = AT_LEVEL[value]
        elif word == "duty":
            changed["duty_percent"] = round(value * 100)
        elif word == "roi":
            if value and region is None:
                return None
            changed["roi"] = region if value else None
        else:
            changed[word] = value
    rung = changed.get("representation")
    if rung is not None and rung != before.representation:
        if rung < Representation.CODES and before.rho and "rho" not in changed:
            changed["rho"] = 0.0  # only codes and features have cells
        if rung > before.representation and before.rate_hz <= 0 and "rate_hz" not in changed:
            changed["rate_hz"] = LEAST_RATE_HZ  # a link at 0 Hz carries nothing
    return before._replace(**changed) if changed else before
