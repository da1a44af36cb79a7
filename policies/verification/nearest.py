"""The directive nearest to a given one that keeps all lines: the shield's arithmetic.

Parts of lines that name one field each are solved field by field: of the values at which their truth changes, the nearest
at which all hold. Only fields that a part ties together are multiplied out, up to `MOST` combinations. The result is
checked against all lines; if fields turn out to depend on each other after all, all named fields are multiplied out.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from sortie.policies.contract import DIRECTIVE_BOUNDS, Directive, Disc, Representation
from sortie.policies.verification.compiled import Context, Part, Rule

LEAST_RATE_HZ = 2.0
"""The rate of a link that a shield makes carry something, if no line names a rate: the bottom rung of the paper's table."""
MOST = 512
"""How many combinations of values are tried for one link. If none of them keeps all lines, the link stays as it is."""
_HIGHEST: dict[str, float] = {
    **{name: bound.high for name, bound in DIRECTIVE_BOUNDS.items() if name != "duty_percent"},
    "duty": 1.0,
    "roi": 1.0,
}
_ROUNDS = 4
Holds = Callable[[Directive], bool]


def nearest(
    before: Directive,
    parts: Sequence[Part],
    of_link: Sequence[Rule],
    context: Context,
    allowed: Holds,
    only_all: Rule | None = None,
) -> Directive | None:
    """The nearest directive that keeps all parts, all rules about links, and is allowed; None if none was found.

    Args:
        before: the directive.
        parts: what must hold, of the rules that apply to this link.
        of_link: the rules about links, of which others may apply to the changed directive.
        context: what they are judged on.
        allowed: which directives may replace others.
        only_all: a rule over all links among the parts, which `allowed` judges.
    """
    needed = [part for part in parts if only_all is None or part not in only_all.parts]

    def keeps(after: Directive) -> bool:
        return (
            allowed(after)
            and all(part.holds(context, after) for part in needed)
            and all(rule.holds(context, after) for rule in of_link)
        )

    if only_all is None:
        found = _by_field(before, needed, of_link, context)
        if found is not None and keeps(found):
            return found
    values = _values(before, [*parts, *(part for rule in of_link for part in rule.parts)], context)
    return next((after for after in _candidates(before, values, context) if keeps(after)), None)


def least_distance(before: Directive, parts: Sequence[Part], context: Context) -> tuple[int, float]:
    """A lower bound of how far the nearest directive is that keeps these parts."""
    broken = {f for part in parts if len(part.fields) == 1 and not part.holds(context, before) for f in part.fields}
    return len(broken), 0.0


def distance(a: Directive, b: Directive) -> tuple[int, float]:
    """How many fields differ, and by how much in all: a rung counts a quarter, a number its share of its bounds."""
    far, changed = 0.0, 0
    for word, high in _HIGHEST.items():
        part = abs(_value(a, word) - _value(b, word)) / high
        changed, far = changed + (part > 0), far + part
    return changed, far


def _values(before: Directive, parts: Sequence[Part], context: Context) -> dict[str, list[float]]:
    """For each field that a part names, the values to try, nearest to the present one first and without it."""
    found: dict[str, set[float]] = {}
    for part in parts:
        for word in part.fields:
            found.setdefault(word, {0.0, _HIGHEST[word]})
        for word, other in part.edges:
            edge = other(context, before)
            near = (edge - 1, edge, edge + 1) if word == "representation" else _around(edge)
            found.setdefault(word, {0.0, _HIGHEST[word]}).update([v for v in near if 0 <= v <= _HIGHEST[word]])
    result = {}
    for word, values in found.items():
        now = _value(before, word)
        result[word] = sorted(values - {now}, key=lambda v: abs(v - now))
    return result


def _by_field(before: Directive, needed: Sequence[Part], of_link: Sequence[Rule], context: Context) -> Directive | None:
    """Each broken field changed by itself; None if parts tie fields together or a field has no value that holds.

    A changed field may bring other lines into force, so this is repeated until nothing is broken.
    """
    wanted: dict[str, float] = {}
    after = before
    for _ in range(_ROUNDS):
        now = after
        others = (r for r in of_link if r.when_of_link and r.when is not None and r.when(context, now))
        parts = list(dict.fromkeys([*needed, *(part for rule in others for part in rule.parts)]))
        broken = [part for part in parts if not part.holds(context, after)]
        if not broken:
            return after
        if any(len(part.fields) != 1 for part in broken):
            return None
        for word in {f for part in broken for f in part.fields}:
            mine = [part for part in parts if part.fields == {word}]
            value = _nearest_value(before, word, mine, context)
            if value is None:
                return None
            wanted[word] = value
        found = _changed(before, wanted, context.me.region)
        if found is None:
            return None
        after = found
    return None


def _nearest_value(before: Directive, word: str, parts: Sequence[Part], context: Context) -> float | None:
    """The value of one field, nearest to the present one, at which all parts hold that name this field alone."""
    for value in _values(before, parts, context).get(word, ()):
        after = _changed(before, {word: value}, context.me.region)
        if after is not None and all(part.holds(context, after) for part in parts):
            return value
    return None


def _candidates(before: Directive, values: Mapping[str, list[float]], context: Context) -> Iterator[Directive]:
    """Directives that differ in the fields of `values`, nearest first, at most `MOST` of them."""
    waiting: list[tuple[tuple[int, float], Directive]] = []
    left, steps = MOST, dict(sorted(values.items()))
    # A change of this many names changes as many fields, or one more where a lower representation loses its budget.
    for changes in range(1, len(steps) + 2):
        for words in itertools.combinations(steps, changes):
            for pick in itertools.islice(itertools.product(*(steps[w] for w in words)), left):
                left -= 1
                found = _changed(before, dict(zip(words, pick, strict=True)), context.me.region)
                if found is not None:
                    waiting.append((distance(before, found), found))
        near = [w for w in waiting if w[0][0] <= changes]
        waiting = [w for w in waiting if w[0][0] > changes]
        yield from (after for _, after in sorted(near, key=lambda w: w[0]))


def _around(edge: float) -> tuple[float, ...]:
    """The edge, and a step to each side that is large enough to survive the wire's rounding."""
    step = max(abs(edge), 0.01) * 0.01
    return (edge - step, edge, edge + step) if math.isfinite(edge) else ()


def _value(d: Directive, word: str) -> float:
    if word == "duty":
        return d.duty_percent / 100
    return float(d.roi is not None) if word == "roi" else float(getattr(d, word))


def _changed(before: Directive, wanted: dict[str, float], region: Disc | None) -> Directive | None:
    """The directive with changed fields; None if there is no such directive."""
    changed: dict[str, Any] = {}
    for word, value in wanted.items():
        if word == "representation":
            if value != int(value):
                return None
            changed[word] = Representation(int(value))
        elif word == "duty":
            changed["duty_percent"] = round(value * 100)
        elif word == "roi":
            if value and region is None:
                return None
            changed["roi"] = region if value else None
        else:
            changed[word] = value
    if changed.get("representation", Representation.FEATURES) < Representation.FEATURES and "rho" not in changed:
        changed["rho"] = 0.0  # only features have cells
    if changed.get("representation", 0) > 0 and before.rate_hz <= 0 and "rate_hz" not in changed:
        changed["rate_hz"] = LEAST_RATE_HZ  # a link at 0 Hz carries nothing
    return before._replace(**changed)
