"""What lines that bound one field each allow: for each field of a link, the values that it may have.

Such lines make a box. It is built once for each set of lines that apply, and serves all later decisions.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any

from sortie.policies.contract import Representation
from sortie.policies.verification.brackets import Brackets
from sortie.policies.verification.compiled import Context, Rule, Ways
from sortie.policies.verification.links import AT, DUTY, HIGHEST, LEVEL, ROI, Ceiling, Compare, Limit, Link
from sortie.scenarios.representation import AT_LEVEL

_FIRST_LEVELS = (0.0, 1.0, 2.0, 3.0, 4.0)
_PLAIN = frozenset({float, int, Representation})
Changes = tuple[tuple[int, float], ...]
"""New values of a link's fields, by their places."""
Correction = tuple[str, Changes | None]
"""The lines that a link breaks, and its changes; None for those if nothing keeps the lines."""
Known = dict[Any, Sequence[Correction]]
"""The correction of a link, by its fields; or those of which links in the same brackets take the nearest."""


class Box:
    """What some lines together allow.

    Args:
        rules: the lines, all of which apply.
        sides: the other side of each part that bounds a field, in the order of the lines.
        ceiling: beside the bounds of the lines.
    """

    __slots__ = ("_bounded", "_checks", "_others", "brackets", "known", "parts", "room", "rules", "shared")

    def __init__(self, rules: Sequence[Rule], sides: Sequence[float], ceiling: Ceiling = ()) -> None:
        self.rules = rules
        limits: dict[int, tuple[Limit, ...]] = {at: (limit,) for at, limit in ceiling}
        self._checks: list[tuple[int, Compare, float, int]] = []
        values = iter(sides)
        parts = []
        for number, rule in enumerate(rules):
            for part in rule.parts:
                if part.bound is None or part.bound.compare is None:
                    parts.append((part, number))
                else:
                    (at,), limit = part.bound.fields, (part.bound.compare, next(values))
                    self._checks.append((at, *limit, number))
                    limits[at] = (*limits.get(at, ()), limit)
        self.room = Room([Values(at, limits.get(at, ())) for at in AT.values()])
        self._bounded = [(at, self.room.values[at]) for at in limits]
        self.parts = tuple([part for part, _ in parts])
        """The parts that are no bounds of one field, or have another bound for each link."""
        self._others = [(part.holds, number) for part, number in parts]
        self.shared = not any(part.of_peer or part.of_links for part, _ in parts)
        """Whether equal links to different peers get the same correction."""
        lasts = self.shared and not any(part.of_view for part, _ in parts)
        self.known: tuple[Known, Known] | None = ({}, {}) if lasts else None
        """Where corrections depend on nothing but a link's fields, and on whether its sender has a region: those found so
        far, of senders without and with one. Policies mostly decide what they decided before."""
        self.brackets = Brackets(limits, self.parts) if lasts and _are_plain(sides) else None

    def clipped(self, link: Link) -> dict[int, float | None]:
        """The nearest values of the fields that must change for the bounds; None for a field without an allowed value."""
        wanted: dict[int, float | None] = {}
        for at, values in self._bounded:
            now = link[at]
            for compare, value in values.limits:
                if not compare(now, value):
                    wanted[at] = values.other_than(now)
                    break
        return wanted

    def broken(self, context: Context, link: Link) -> tuple[int, ...]:
        """The numbers of the lines that a link breaks, once for each part that it breaks."""
        found = [number for at, compare, value, number in self._checks if not compare(link[at], value)]
        found += [number for holds, number in self._others if not holds(context, link)]
        return tuple(found)

    def key(self, link: Link) -> tuple[float, ...] | None:
        """What links have in common that are corrected to the same link; None if nothing can be said."""
        return link[:-1] if self.shared and _are_plain(link[:-2]) else None


def box_of(rules: tuple[Rule, ...], sides: tuple[float, ...], ceiling: Ceiling) -> Box:
    """The box of some lines. Equal plain arguments give one object."""
    return _plain_box(rules, sides, ceiling) if _are_plain(sides) else Box(rules, sides, ceiling)


@lru_cache(maxsize=512)
def _plain_box(rules: tuple[Rule, ...], sides: tuple[float, ...], ceiling: Ceiling) -> Box:
    return Box(rules, sides, ceiling)


class Values:
    """What limits allow one field."""

    __slots__ = ("_all", "at", "limits")

    def __init__(self, at: int, limits: tuple[Limit, ...]) -> None:
        self.at, self.limits = at, limits
        self._all: tuple[float, ...] | None = None

    def within(self, limit: Limit) -> Values:
        """What these limits and one more allow."""
        return _plain_within(self, limit) if type(limit[1]) in _PLAIN else _within(self, limit)

    def nearest(self, now: float) -> float | None:
        """The value nearest to the present one that the field may have; None without any."""
        for compare, value in self.limits:
            if not compare(now, value):
                return self.other_than(now)
        return now

    def other_than(self, now: float) -> float | None:
        """The same where the present value is not allowed."""
        if self._all is None:
            self._all = _allowed(self.at, self.limits)
        values = self._all
        if not values:
            return None
        if now > values[-1]:
            return values[-1]
        return values[0] if now < values[0] else min(values, key=lambda v: abs(v - now))


class Room:
    """What each field may be, by its place."""

    __slots__ = ("_ways", "values")

    def __init__(self, values: Sequence[Values]) -> None:
        self.values = values
        self._ways: dict[Ways, list[Way]] = {}

    def within(self, ways: Ways) -> list[Way]:
        """Where each of some alternatives holds too. They are bounds by plain numbers, so this is worked out once."""
        found = self._ways.get(ways)
        if found is None:
            found = self._ways[ways] = [self._narrowed(way) for way in ways.limits or ()]
        return found

    def _narrowed(self, way: Iterable[tuple[int, Limit]]) -> Way:
        narrowed: dict[int, Values] = {}
        for at, limit in way:
            before = narrowed.get(at, self.values[at])
            values = before.within(limit)
            if values is not before:
                narrowed[at] = values
        return self.having(narrowed), tuple(narrowed.items())

    def having(self, narrowed: Mapping[int, Values]) -> Room:
        """The same with other values of some fields."""
        return Room([narrowed.get(at, values) for at, values in enumerate(self.values)]) if narrowed else self


Way = tuple[Room, tuple[tuple[int, Values], ...]]
"""A room within another one, and the fields that are narrower there."""


def _within(values: Values, limit: Limit) -> Values:
    return values if limit in values.limits else Values(values.at, (*values.limits, limit))


_plain_within = lru_cache(maxsize=4096)(_within)


def _are_plain(values: Iterable[object]) -> bool:
    """Whether these are numbers, not symbols of a proof: what depends on them may be kept."""
    return _PLAIN.issuperset(map(type, values))


def _allowed(at: int, limits: tuple[Limit, ...]) -> tuple[float, ...]:
    """Of the values that may be nearest to a forbidden one, those that the limits allow, ascending."""
    plain = _are_plain([value for _, value in limits])
    return _allowed_plain(at, limits) if plain else allowed_any(at, limits)


def allowed_any(at: int, limits: tuple[Limit, ...]) -> tuple[float, ...]:
    """The same for limits that may be symbols of a proof."""
    values = near(at, (0.0, HIGHEST[at], *[value for _, value in limits]))
    for compare, value in limits:
        values = [v for v in values if compare(v, value)]
    if not values and at not in (LEVEL, ROI):
        edges = sorted(value for _, value in limits if math.isfinite(value))
        between = [(a + b) / 2 for a, b in pairwise(edges)]
        values = [v for v in between if 0 <= v <= HIGHEST[at] and all(c(v, edge) for c, edge in limits)]
    return tuple(values)


@lru_cache(maxsize=4096)  # lines name few values, and decisions are many
def _allowed_plain(at: int, limits: tuple[Limit, ...]) -> tuple[float, ...]:
    return tuple([float(value) for value in allowed_any(at, limits)])


def near(at: int, edges: Iterable[float]) -> list[float]:
    """Values at edges and on both sides of them, ascending."""
    if at == LEVEL:  # uncertain boxes and codes only where a line names them: else a policy chooses them
        return sorted({*_FIRST_LEVELS, *(float(e) for e in edges if e in AT_LEVEL)})
    if at == ROI:
        return [0.0, 1.0]
    found: set[float] = set()
    for edge in edges:
        if at == DUTY and math.isfinite(edge):
            percent = math.floor(edge * 100)
            found.update([p / 100 for p in (percent - 1, percent, percent + 1, percent + 2)])
        elif math.isfinite(edge):
            step = max(abs(edge), 0.01) * 0.01  # large enough to survive the wire's rounding
            found.update((edge - step, edge, edge + step))
    return sorted([v for v in found if 0 <= v <= HIGHEST[at]])
