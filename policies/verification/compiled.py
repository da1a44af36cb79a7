"""Invariants as closures, for the shield: built once for each line, and cheap to ask thousands of times a second.

A line is split into its parts joined by `and`. Each part has its ways to hold: a list of alternatives, each a list of
comparisons that must hold together. `evaluate` in `invariants` gives the same answers from the tree.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
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
from sortie.policies.verification.links import AT, Compare, Limit, Link, as_link
from sortie.policies.verification.words import DECISIONS, WORDS
from sortie.scenarios.plain_sum import plain_sum

Ask = Callable[["Context", Link], Any]
"""The value of an expression in a context, for one link."""
_COMPARE: dict[str, Compare] = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge, "==": operator.eq, "!=": operator.ne,
}  # fmt: skip
_FIELD: dict[str, Callable[[int, float], Ask]] = {
    "<": lambda at, bound: lambda _, link: link[at] < bound,
    "<=": lambda at, bound: lambda _, link: link[at] <= bound,
    ">": lambda at, bound: lambda _, link: link[at] > bound,
    ">=": lambda at, bound: lambda _, link: link[at] >= bound,
    "==": lambda at, bound: lambda _, link: link[at] == bound,
    "!=": lambda at, bound: lambda _, link: link[at] != bound,
}
"""A field compared with a number, asked most often."""
_ARITHMETIC: dict[str, Callable[[Any, Any], Any]] = {"+": operator.add, "-": operator.sub, "*": operator.mul}
_OPPOSITE = {"<": ">=", "<=": ">", ">": "<=", ">=": "<", "==": "!=", "!=": "=="}
_MIRRORED = {"<": ">", "<=": ">=", ">": "<", ">=": "<=", "==": "==", "!=": "!="}
_MOST_WAYS = 64
"""A part with more alternatives is not taken apart: the shield then changes single fields of it."""


class Context:
    """What lines are judged on. Values that depend on the view or on a peer alone are worked out once."""

    __slots__ = ("_witness", "fresh", "known", "links", "me", "view")

    def __init__(self, view: FleetView, me: Descriptor, links: Sequence[Link], fresh: Mapping[int, Link]) -> None:
        self.view, self.me, self.links, self.fresh = view, me, links, fresh
        self.known: dict[Any, Any] = {}
        self._witness: dict[Ask, int | None] = {}

    def having(self, k: int, link: Link) -> Context:
        """The same with another link k."""
        links = (*self.links[:k], link, *self.links[k + 1 :])
        found, mine = Context(self.view, self.me, links, self.fresh), link.destination
        found.known = self.known
        for condition, witness in self._witness.items():
            if witness is None or witness == mine:
                if condition(self, link):
                    found._witness[condition] = mine
                elif witness is None:
                    found._witness[condition] = None
            else:
                found._witness[condition] = witness
        return found

    def others(self, condition: Ask, mine: int) -> bool:
        """Whether a link to another peer than `mine` satisfies a condition."""
        if condition not in self._witness:
            self._witness[condition] = next((x.destination for x in self.links if condition(self, x)), None)
        witness = self._witness[condition]
        if witness != mine:
            return witness is not None
        return any(x.destination != mine and condition(self, x) for x in self.links)


class Claim(NamedTuple):
    """A comparison, or a word that is true or false."""

    holds: Ask
    fields: tuple[int, ...]
    """The places of the fields of the link itself that it depends on."""
    compare: Compare | None = None
    """Of a claim about one field: how the field compares with `value`."""
    value: Ask | None = None
    """Of a claim about one field: the other side, which depends on no field of the link."""
    number: float | None = None
    """The same where it is a plain number."""
    gap: Ask | None = None
    """Of a comparison of several fields: left side less right side."""


@dataclass(frozen=True, eq=False, slots=True)
class Ways:
    """Alternatives: something holds where all claims of one of them hold."""

    claims: tuple[tuple[Claim, ...], ...]
    limits: tuple[tuple[tuple[int, Limit], ...], ...] | None
    """The same as bounds of fields, by their places; None where a claim is more than a field compared with a number."""


class Part(NamedTuple):
    """A part of a requirement that must hold by itself."""

    holds: Ask
    ways: Ways
    """How the requirement holds."""
    exempt: Ways | None
    """How the line's condition on the directive becomes false; None without one."""
    bound: Claim | None
    """The claim about one field that the whole part is, if its other side is the same for all links."""
    of_view: bool
    """Whether it depends on the view, otherwise than through a peer."""
    of_peer: bool
    """Whether it depends on the peer otherwise than through the link's directive."""
    of_links: bool
    """Whether it depends on other links' directives."""


@dataclass(frozen=True, eq=False)
class Rule:
    """One line. A condition that depends on directives is within the parts."""

    invariant: Invariant
    when_of_view: Ask | None
    """What of the condition is the same for all links."""
    when_of_peer: Ask | None
    """What of the condition depends on the link's peer."""
    parts: tuple[Part, ...]
    sides: tuple[Ask, ...]
    """The other side of each part that bounds a field."""
    of_link: bool
    of_links: bool
    """Whether one link alone does not decide it."""

    def holds(self, context: Context, link: Link) -> bool:
        """Whether the line holds for a link, or for all of them if it is about all."""
        for when in (self.when_of_view, self.when_of_peer):
            if when is not None and not when(context, link):
                return True
        return all(part.holds(context, link) for part in self.parts)


@lru_cache(maxsize=256)
def compiled(invariant: Invariant) -> Rule:
    """A line as closures."""
    parts = _conjuncts(invariant.then)
    conditions = () if invariant.when is None else _conjuncts(invariant.when)
    apart = tuple(node for node in conditions if not _depends(node))
    within = tuple(node for node in conditions if _depends(node))
    found = tuple(_part(node, within) for node in parts)
    of_view, of_peer = ([node for node in apart if _is_of_peer(node) == wanted] for wanted in (False, True))
    return Rule(
        invariant,
        _ask(Logic("and", tuple(of_view))) if of_view else None,
        _ask(Logic("and", tuple(of_peer))) if of_peer else None,
        found,
        tuple([part.bound.value for part in found if part.bound is not None and part.bound.value is not None]),
        invariant.of_link,
        not invariant.of_link or any(part.of_links for part in found),
    )


def _conjuncts(node: Node) -> tuple[Node, ...]:
    if isinstance(node, Logic) and node.word == "and":
        return tuple(x for part in node.parts for x in _conjuncts(part))
    return (node,)


def _part(required: Node, conditions: Sequence[Node]) -> Part:
    node = required
    if conditions:
        node = Logic("or", (*[Logic("not", (condition,)) for condition in conditions], required))
    ways = _quick_first(_ways(required, True))
    exempt = _quick_first(way for condition in conditions for way in _ways(condition, False))
    bound = ways.claims[0][0] if len(ways.claims) == 1 and len(ways.claims[0]) == 1 and not exempt.claims else None
    of_view, of_peer = _is_of_view(node), _is_of_peer(node)
    of_links = any(isinstance(n, LinksTerm) for n in walk(node))
    if bound is not None and (bound.value is None or of_peer or of_links):
        bound = None
    return Part(_ask(node), ways, exempt if exempt.claims else None, bound, of_view, of_peer, of_links)


def _quick_first(ways: Iterable[tuple[Claim, ...]]) -> Ways:
    """The claims that a view or another drone decides come first."""
    found = tuple(tuple(sorted(way, key=lambda claim: len(claim.fields))) for way in ways)
    limits = [
        tuple([(c.fields[0], (c.compare, c.number)) for c in way if c.compare is not None and c.number is not None])
        for way in found
    ]
    plain = all(len(bounds) == len(way) for bounds, way in zip(limits, found, strict=True))
    return Ways(found, tuple(limits) if plain else None)


def _ways(node: Node, wanted: bool) -> tuple[tuple[Claim, ...], ...]:
    """The alternatives under which a node is true, or false if that is wanted."""
    if isinstance(node, Logic):
        if node.word == "not":
            return _ways(node.parts[0], not wanted)
        below = [_ways(part, wanted) for part in node.parts]
        if (node.word == "or") == wanted:
            return tuple(way for ways in below for way in ways)
        found: tuple[tuple[Claim, ...], ...] = ((),)
        for ways in below:
            found = tuple((*a, *b) for a in found for b in ways)
            if len(found) > _MOST_WAYS:
                return ((_claim_of(node, wanted),),)
        return found
    if isinstance(node, LinksTerm) and node.function == "any_link":
        others = _other_links(_ask(node.body))
        if wanted:
            return ((Claim(others, ()),), *_ways(node.body, True))
        return tuple((Claim(_not(others), ()), *way) for way in _ways(node.body, False))
    if isinstance(node, Binary) and node.sign == ("!=" if wanted else "=="):
        sides = (Binary(sign, node.left, node.right) for sign in ("<", ">"))  # the nearest on each side
        return tuple((_claim_of(side, True),) for side in sides)
    return ((_claim_of(node, wanted),),)


def _claim_of(node: Node, wanted: bool) -> Claim:
    fields = tuple(dict.fromkeys(AT[n.word] for n in walk(node) if isinstance(n, Name) and n.word in DECISIONS))
    if isinstance(node, Name):
        holds = _ask(node) if wanted else _not(_ask(node))
        if not fields:
            return Claim(holds, ())
        return Claim(holds, fields, operator.eq, lambda _, __: float(wanted), float(wanted))
    if isinstance(node, Binary) and node.sign in _COMPARE and not any(isinstance(n, LinksTerm) for n in walk(node)):
        sign = node.sign if wanted else _OPPOSITE[node.sign]
        holds = _binary(sign, node.left, node.right)
        for side, other, how in ((node.left, node.right, sign), (node.right, node.left, _MIRRORED[sign])):
            if isinstance(side, Name) and fields == (AT.get(side.word),) and not _depends(other):
                number = other.value if isinstance(other, Number) else None
                return Claim(holds, fields, _COMPARE[how], _ask(other), number)
        return Claim(holds, fields, gap=_binary("-", node.left, node.right))
    return Claim(_ask(node) if wanted else _not(_ask(node)), fields)


def _not(ask: Ask) -> Ask:
    return lambda context, link: not ask(context, link)


def _of_peer(word: str) -> bool:
    return word not in DECISIONS and word in WORDS and WORDS[word].of_link


def _is_of_view(node: Node) -> bool:
    return any(isinstance(n, Name) and n.word not in DECISIONS and not _of_peer(n.word) for n in walk(node))


def _is_of_peer(node: Node) -> bool:
    return any(isinstance(n, Fresh) or (isinstance(n, Name) and _of_peer(n.word)) for n in walk(node))


def _depends(node: Node) -> bool:
    """Whether it depends on directives that may change."""
    return any(isinstance(n, LinksTerm) or (isinstance(n, Name) and n.word in DECISIONS) for n in walk(node))


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
    if word in DECISIONS:
        at = AT[word]
        return lambda _, link: link[at]
    found = WORDS[word]
    if found.raw is not None:
        of_peer = found.raw
        return lambda context, link: of_peer(context, link.destination)

    def ask(context: Context, _: Link) -> Any:
        known = context.known
        if word not in known:
            known[word] = found.value(context)  # type: ignore[arg-type]
        return known[word]

    return ask


def _fresh(field: Ask) -> Ask:
    def ask(context: Context, link: Link) -> Any:
        known = context.fresh.get(link.destination)
        return field(context, as_link(Directive(-1, link.destination)) if known is None else known)

    return ask


def _logic(word: str, parts: tuple[Ask, ...]) -> Ask:
    if word == "not":
        (one,) = parts
        return lambda context, link: not one(context, link)
    if len(parts) == 1:
        return parts[0]
    if len(parts) == 2:
        a, b = parts
        if word == "and":
            return lambda context, link: a(context, link) and b(context, link)
        return lambda context, link: a(context, link) or b(context, link)
    if word == "and":
        return lambda context, link: all(part(context, link) for part in parts)
    return lambda context, link: any(part(context, link) for part in parts)


def _binary(sign: str, left: Node, right: Node) -> Ask:
    compare = _COMPARE.get(sign)
    if sign in _FIELD and isinstance(left, Name) and left.word in DECISIONS and isinstance(right, Number):
        return _FIELD[sign](AT[left.word], right.value)
    a = _ask(left)
    if compare is not None and isinstance(right, Number):
        value = right.value
        return lambda context, link: compare(a(context, link), value)
    b = _ask(right)
    if compare is not None:
        return lambda context, link: compare(a(context, link), b(context, link))
    if sign == "/":

        def divide(context: Context, link: Link) -> Any:
            below = b(context, link)
            return float("inf") if below == 0 else a(context, link) / below

        return divide
    act = _ARITHMETIC[sign]
    return lambda context, link: act(a(context, link), b(context, link))


def _over_links(function: str, body: Ask) -> Ask:
    # The link may be another one than is listed: one that is tried in its place.
    if function == "any_link":
        others = _other_links(body)
        return lambda context, link: body(context, link) or others(context, link)
    if function == "every_link":
        return lambda context, _: all(body(context, d) for d in context.links)
    if function == "count_links":
        return lambda context, _: sum([1 if body(context, d) else 0 for d in context.links])
    return lambda context, _: plain_sum([body(context, d) for d in context.links])


def _other_links(body: Ask) -> Ask:
    """Whether one of the other links satisfies a condition."""
    return lambda context, link: context.others(body, link.destination)
