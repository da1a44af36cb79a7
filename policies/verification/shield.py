"""A shield: wraps a policy so that it keeps its invariants at run time, and reports each intervention.

    decide = shield(worked, parse("when battery < 0.3: rate_hz <= 1"))

A directive that breaks an invariant is replaced by the nearest one that keeps them all. Its reason then begins with
"shield:", so the record shows each intervention and `interventions` counts them. Nearest means: fewest fields changed,
then the smallest change. A step of representation counts as a quarter, a number as a share of its bounds.

In flight the shield acts twice: here, on the policy's output, and at the gate, on what the staleness rules and damping
left of it (`policies.verification.enforced`). There a limit keeps it from giving a link more than its age allows.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from sortie.policies.contract import (
    DIRECTIVE_BOUNDS,
    Directive,
    Disc,
    FleetView,
    Policy,
    Representation,
    check_directives,
)
from sortie.policies.verification.invariants import (
    Binary,
    Invariant,
    InvariantError,
    LinksTerm,
    Name,
    Node,
    Scope,
    evaluate,
    just_heard,
    walk,
)
from sortie.scenarios.representation import NAME_OF

MARK = "shield: "
LEAST_RATE_HZ = 2.0
"""The rate of a link that a shield makes carry something, if no line names a rate: the bottom rung of the paper's table."""
_HIGHEST: dict[str, float] = {
    **{name: bound.high for name, bound in DIRECTIVE_BOUNDS.items() if name != "duty_percent"},
    "duty": 1.0,
    "roi": 1.0,
}
_NOT_SHIELDED = ("sum_links", "count_links", "every_link")


def shield(policy: Policy, invariants: Iterable[Invariant]) -> Policy:
    """A policy that decides as the given one but keeps the invariants. It is as pure; shielding it again changes nothing.

    An invariant may contradict another one, or depend on the view alone. If no change of one link keeps it, the
    directives stay as decided, and each one's reason states it.

    Raises:
        InvariantError: an invariant uses `sum_links` or `count_links`, so it does not determine the link to change; or
            `every_link`, which means the same as its requirement alone.
    """
    return Shielded(policy, check_shieldable(invariants))


class Shielded:
    """A shielded policy."""

    def __init__(self, policy: Policy, rules: tuple[Invariant, ...]) -> None:
        self.policy, self.rules = policy, rules
        self._asks_fresh = any(rule.needs_fresh for rule in rules)
        self.__name__ = f"{getattr(policy, '__name__', 'a policy')}, shielded"

    def __call__(self, view: FleetView, /) -> list[Directive]:
        """The policy's directives, those that break an invariant replaced.

        Raises:
            PolicyError: the policy returned something else than valid directives.
        """
        view = view.frozen  # nothing that the policy does to its view may reach the rules
        decided = self._checked(view)
        fresh = self._checked(just_heard(view)) if self._asks_fresh else ()
        return enforce(self.rules, view, decided, fresh)

    def _checked(self, view: FleetView) -> tuple[Directive, ...]:
        answer = self.policy(view)
        check_directives(answer, view)
        return tuple(answer)


def check_shieldable(invariants: Iterable[Invariant]) -> tuple[Invariant, ...]:
    """Check that a shield can keep these invariants, and return them.

    Raises:
        InvariantError: as `shield` does.
    """
    rules = tuple(invariants)
    for rule in rules:
        for top in (rule.when, rule.then):
            for node in () if top is None else walk(top):
                if isinstance(node, LinksTerm) and node.function in _NOT_SHIELDED:
                    raise InvariantError(
                        f"{rule.text!r}: a shield cannot keep {node.function}(…); `sortie verify` can only prove it"
                    )
    return rules


def interventions(directives: Iterable[Directive]) -> int:
    """How many of a policy's directives a shield replaced."""
    return sum(d.reason.startswith(MARK) for d in directives)


def enforce(
    rules: Sequence[Invariant],
    view: FleetView,
    decided: Sequence[Directive],
    fresh: Sequence[Directive] = (),
    allowed: Callable[[Directive], bool] = lambda _: True,
) -> list[Directive]:
    """The directives; those that break a rule are replaced by the nearest ones that keep all rules.

    Args:
        rules: the invariants.
        view: the policy's input.
        decided: its output.
        fresh: its output at age 0, if a rule needs it.
        allowed: which directives may replace others.
    """
    me, directives = view.me, list(decided)
    if me is None:
        return directives
    of_link = [rule for rule in rules if rule.of_link]
    scope = Scope(view, me, directives, {d.destination: d for d in fresh})
    for k, directive in enumerate(directives):
        broken = [r for r in of_link if not _satisfies(r, scope, directive)]
        if broken:
            directives[k] = _nearest_valid(scope, k, of_link, broken, allowed)
    for rule in rules:
        if not rule.of_link and not _satisfies(rule, scope, None):
            _replace_one_link(scope, directives, rule, of_link, allowed)
    return directives


def _satisfies(rule: Invariant, scope: Scope, link: Directive | None) -> bool:
    here = scope._replace(link=link)
    return (rule.when is not None and not evaluate(rule.when, here)) or bool(evaluate(rule.then, here))


def _nearest_valid(
    scope: Scope,
    k: int,
    rules: Sequence[Invariant],
    broken: Sequence[Invariant],
    allowed: Callable[[Directive], bool],
) -> Directive:
    """The nearest directive for this link that keeps every rule about links."""
    before = scope.directives[k]
    for _, after in _candidates(before, rules, scope):
        if allowed(after) and all(_satisfies(r, scope, after) for r in rules):
            return _replaced(before, after, broken)
    return _not_replaced(before, broken)


def _replace_one_link(
    scope: Scope,
    directives: list[Directive],
    rule: Invariant,
    of_link: Sequence[Invariant],
    allowed: Callable[[Directive], bool],
) -> None:
    """Change one link, by the smallest change of any, so that a rule about all links holds.

    Args:
        scope: has these same directives.
    """
    best: tuple[tuple[int, float], int, Directive] | None = None
    for k, before in enumerate(list(directives)):
        for far, after in _candidates(before, [*of_link, rule], scope):
            if best is not None and far >= best[0]:
                break
            if not allowed(after):
                continue
            directives[k] = after
            if _satisfies(rule, scope, None) and all(_satisfies(r, scope, after) for r in of_link):
                best = (far, k, after)
                break
        directives[k] = before
    if best is None:
        directives[:] = [_not_replaced(d, [rule]) for d in directives]
    else:
        _, k, after = best
        directives[k] = _replaced(directives[k], after, [rule])


def _replaced(before: Directive, after: Directive, broken: Sequence[Invariant]) -> Directive:
    because = "; ".join(rule.text for rule in broken)
    was = f"{NAME_OF[Representation(before.representation)]} at {before.rate_hz:g} Hz"
    return after._replace(reason=f"{MARK}{because} (decided {was}: {before.reason})")


def _not_replaced(before: Directive, broken: Sequence[Invariant]) -> Directive:
    note = f"{MARK}cannot keep {'; '.join(rule.text for rule in broken)} "
    return before if before.reason.startswith(note) else before._replace(reason=f"{note}({before.reason})")


# --- candidates ----------------------------------------------------------------------------------


def _candidates(
    before: Directive, rules: Sequence[Invariant], scope: Scope
) -> Iterator[tuple[tuple[int, float], Directive]]:
    """Directives that differ in the fields that the rules name, nearest first, each with its distance."""
    here = scope._replace(link=before)
    values: dict[str, set[float]] = {}
    for rule in rules:
        for top in (rule.when, rule.then):
            if top is not None:
                _collect_boundaries(top, here, values)
    now = {word: _value(before, word) for word in values}
    steps = {w: sorted(({0.0, _HIGHEST[w]} | values[w]) - {now[w]}) for w in sorted(values)}
    waiting: list[tuple[tuple[int, float], Directive]] = []
    # A change of this many names changes as many fields, or one more where a lower representation loses its budget.
    for changes in range(1, len(steps) + 2):
        for words in itertools.combinations(steps, changes):
            for pick in itertools.product(*(steps[w] for w in words)):
                found = _changed(before, dict(zip(words, pick, strict=True)), scope.me.region)
                if found is not None:
                    waiting.append((_distance(before, found), found))
        near = [w for w in waiting if w[0][0] <= changes]
        waiting = [w for w in waiting if w[0][0] > changes]
        yield from sorted(near, key=lambda w: w[0])


def _collect_boundaries(top: Node, scope: Scope, values: dict[str, set[float]]) -> None:
    """Add to `values`, for each field that is named, the values at which the comparisons with it change their result."""
    for node in walk(top):
        if isinstance(node, Name) and node.word in _HIGHEST:
            values.setdefault(node.word, set())
        if not isinstance(node, Binary) or node.sign not in ("<", "<=", ">", ">=", "==", "!="):
            continue
        for side, other in ((node.left, node.right), (node.right, node.left)):
            if isinstance(side, Name) and side.word in _HIGHEST and not isinstance(other, LinksTerm):
                edge = evaluate(other, scope)
                near = (edge - 1, edge, edge + 1) if side.word == "representation" else _around(edge)
                values.setdefault(side.word, set()).update(v for v in near if 0 <= v <= _HIGHEST[side.word])


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


def _distance(a: Directive, b: Directive) -> tuple[int, float]:
    parts = [abs(_value(a, word) - _value(b, word)) / high for word, high in _HIGHEST.items()]
    return sum(p > 0 for p in parts), sum(parts)
