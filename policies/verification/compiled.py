"""Invariants as closures, for the shield: built once for each line, and cheap to ask thousands of times a second.

A line is split into its parts joined by `and`. Each part knows which fields of a directive it names, and at which values
of them its truth changes. `evaluate` in `invariants` gives the same answers from the tree.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

from sortie.policies.contract import Descriptor, Directive, FleetView
from sortie.policies.verification.invariants import (
    Binary,
    Fresh,
    Invariant,
    LinksTerm,
    Logic,
    Name,
    Node,
    Number,
    walk,
)
from sortie.policies.verification.words import DECISIONS, WORDS

Ask = Callable[["Context", Directive], Any]
"""The value of an expression in a context, for one link."""
_COMPARE: dict[str, Callable[[Any, Any], Any]] = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge, "==": operator.eq, "!=": operator.ne,
}  # fmt: skip
_ARITHMETIC: dict[str, Callable[[Any, Any], Any]] = {"+": operator.add, "-": operator.sub, "*": operator.mul}


class Context:
    """What lines are judged on. Values that depend on the view or on a peer alone are worked out once."""

    __slots__ = ("directives", "fresh", "known", "me", "view")

    def __init__(
        self, view: FleetView, me: Descriptor, directives: Sequence[Directive], fresh: Mapping[int, Directive]
    ) -> None:
        self.view, self.me, self.directives, self.fresh = view, me, directives, fresh
        self.known: dict[Any, Any] = {}


class Part(NamedTuple):
    """A part of a requirement that must hold by itself."""

    holds: Ask
    fields: frozenset[str]
    """The fields of the link's directive that it names."""
    edges: tuple[tuple[str, Ask], ...]
    """A field, and the value of the other side of a comparison with it."""
    of_peer: bool
    """Whether it depends on the peer otherwise than through the directive."""


class Rule(NamedTuple):
    """One line."""

    invariant: Invariant
    when: Ask | None
    when_of_link: bool
    parts: tuple[Part, ...]
    any_link: tuple[Part, ...]
    """The parts of the body, if the requirement has one `any_link(…)` and else depends on the view alone."""
    when_mixed: bool
    """Whether the condition depends on the link's directive and on its peer as well."""

    def holds(self, context: Context, link: Directive) -> bool:
        """Whether the line holds for a link, or for all of them if it is about all."""
        if self.when is not None and not self.when(context, link):
            return True
        return all(part.holds(context, link) for part in self.parts)


@lru_cache(maxsize=256)
def compiled(invariant: Invariant) -> Rule:
    """A line as closures."""
    when, then = invariant.when, invariant.then
    parts = _conjuncts(then)
    over = [node for node in parts if isinstance(node, LinksTerm) and node.function == "any_link"]
    alone = len(over) == 1 and not any(isinstance(n, LinksTerm) for p in parts if p not in over for n in walk(p))
    named = {n.word for n in walk(when) if isinstance(n, Name)} if when is not None else set()
    peers = any(word not in DECISIONS and word in WORDS and WORDS[word].of_link for word in named)
    return Rule(
        invariant,
        None if when is None else _ask(when),
        when is not None and _is_of_link(when),
        tuple(_part(node) for node in parts),
        tuple(_part(node) for node in _conjuncts(over[0].body)) if alone else (),
        when is not None
        and ((peers and bool(named & DECISIONS.keys())) or any(isinstance(n, Fresh | LinksTerm) for n in walk(when))),
    )


def _conjuncts(node: Node) -> tuple[Node, ...]:
    if isinstance(node, Logic) and node.word == "and":
        return tuple(x for part in node.parts for x in _conjuncts(part))
    return (node,)


def _part(node: Node) -> Part:
    edges = []
    for inner in walk(node):
        if isinstance(inner, Binary) and inner.sign in _COMPARE:
            for side, other in ((inner.left, inner.right), (inner.right, inner.left)):
                if isinstance(side, Name) and side.word in DECISIONS and not isinstance(other, LinksTerm):
                    edges.append((side.word, _ask(other)))
    named = [n.word for n in walk(node) if isinstance(n, Name)]
    fields = frozenset(word for word in named if word in DECISIONS)
    others = any(WORDS[w].of_link for w in named if w not in DECISIONS) or any(
        isinstance(n, Fresh | LinksTerm) for n in walk(node)
    )
    return Part(_ask(node), fields, tuple(edges), others)


def _is_of_link(node: Node) -> bool:
    return any(
        isinstance(n, Fresh | LinksTerm) or (isinstance(n, Name) and n.word in WORDS and WORDS[n.word].of_link)
        for n in walk(node)
    )


def _ask(node: Node) -> Ask:
    match node:
        case Number(value=value):
            return lambda _, __: value
        case Name(word=word):
            return _word(word)
        case Fresh(word=word):
            return _fresh(_word(word))
        case Logic(word=word, parts=parts):
            return _logic(word, tuple(_ask(part) for part in parts))
        case Binary(sign=sign, left=left, right=right):
            return _binary(sign, left, right)
        case LinksTerm(function=function, body=body):
            return _over_links(function, _ask(body))
    raise TypeError(f"not a part of an invariant: {node!r}")


def _word(word: str) -> Ask:
    found = WORDS[word]
    raw = found.raw
    if word in DECISIONS and raw is not None:
        field: Callable[[Directive], Any] = raw
        return lambda _, link: field(link)

    def ask(context: Context, link: Directive) -> Any:
        key = word if raw is None else (word, link.destination)
        known = context.known
        if key not in known:
            known[key] = found.value(context) if raw is None else raw(context, link.destination)  # type: ignore[arg-type]
        return known[key]

    return ask


def _fresh(field: Ask) -> Ask:
    def ask(context: Context, link: Directive) -> Any:
        known = context.fresh.get(link.destination)
        return field(context, Directive(link.source, link.destination) if known is None else known)

    return ask


def _logic(word: str, parts: tuple[Ask, ...]) -> Ask:
    if word == "not":
        (one,) = parts
        return lambda context, link: not one(context, link)
    if word == "and":
        return lambda context, link: all(part(context, link) for part in parts)
    return lambda context, link: any(part(context, link) for part in parts)


def _binary(sign: str, left: Node, right: Node) -> Ask:
    a = _ask(left)
    compare = _COMPARE.get(sign)
    if compare is not None and isinstance(right, Number):
        value = right.value
        return lambda context, link: compare(a(context, link), value)
    b = _ask(right)
    if compare is not None:
        return lambda context, link: compare(a(context, link), b(context, link))
    if sign == "/":

        def divide(context: Context, link: Directive) -> Any:
            below = b(context, link)
            return float("inf") if below == 0 else a(context, link) / below

        return divide
    act = _ARITHMETIC[sign]
    return lambda context, link: act(a(context, link), b(context, link))


def _over_links(function: str, body: Ask) -> Ask:
    if function == "any_link":
        return lambda context, _: any(body(context, d) for d in context.directives)
    if function == "every_link":
        return lambda context, _: all(body(context, d) for d in context.directives)
    if function == "count_links":
        return lambda context, _: sum([1 if body(context, d) else 0 for d in context.directives])
    return lambda context, _: sum([body(context, d) for d in context.directives])
