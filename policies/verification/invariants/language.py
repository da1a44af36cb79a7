"""Invariants: conditions that a policy's directives must satisfy for every view, as short lines of text.

    when battery < 0.3: representation <= detections and rate_hz <= 2
    when target_in_region and peers >= 1: any_link(representation >= detections)
    rate_hz <= fresh.rate_hz

A line is `REQUIREMENT`, or `when CONDITION: REQUIREMENT`; `#` begins a comment. An expression has comparisons,
`and`, `or`, `not`, `+ - * /`, numbers, and the names in `words.WORDS`. A line that names a property of a link must hold
for each outgoing link. `any_link(…)`, `every_link(…)`, `count_links(…)` and `sum_links(…)` cover all links at once.
`fresh.rate_hz` is what the same policy decides for the same link if every descriptor has age 0.

Lines about time are judged on what a drone's gates enforce from decision to decision (`past`):

    when human_in_region and peers >= 1: within 0.5 s: any_link(representation >= detections)
    climbs_in(dwell) <= 1

`within 0.5 s: REQUIREMENT` may be broken for up to 0.5 s without a break while the condition holds. `climbs_in(2)` is how
often the link rose in the last 2 s, `switches_in(2)` how often it changed. `dwell` is the flight's dwell time.

Python's parser reads the text. An allow-list of its nodes becomes a frozen tree. Nothing is ever executed.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from sortie.policies.contract import Directive, FleetView, Representation
from sortie.policies.verification.invariants.words import (
    CHANGES,
    CONSTANTS,
    DECISIONS,
    DWELL,
    ELSEWHERE,
    LINK_FUNCTIONS,
    WORDS,
    Counts,
    Kind,
    Scope,
    Span,
    link_of,
)
from sortie.scenarios.errors import SortieError
from sortie.scenarios.plain_sum import plain_sum
from sortie.scenarios.representation import NAME_OF

MOST_LISTED = 40
"""A complaint names so many drones or directives at most."""


class InvariantError(SortieError):
    """A text that is not an invariant; the message names the line and the part that is wrong."""


LEAST_SPAN_S, MOST_SPAN_S = 0.001, 3600.0


# --- the tree ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Number:
    value: float


@dataclass(frozen=True, slots=True)
class Name:
    word: str


@dataclass(frozen=True, slots=True)
class Fresh:
    """The same field, as decided if every descriptor has age 0."""

    word: str


@dataclass(frozen=True, slots=True)
class Binary:
    """A comparison or arithmetic."""

    sign: str
    left: Node
    right: Node


@dataclass(frozen=True, slots=True)
class Logic:
    """`and`, `or`, or `not` (of one part)."""

    word: str
    parts: tuple[Node, ...]


@dataclass(frozen=True, slots=True)
class LinksTerm:
    """A function over all links."""

    function: str
    body: Node


@dataclass(frozen=True, slots=True)
class Recent:
    """How often the link changed in the last time."""

    change: str
    span: Span


Node = Number | Name | Fresh | Binary | Logic | LinksTerm | Recent

COMPARE: dict[str, Callable[[Any, Any], Any]] = {
    "<": lambda a, b: a < b,
    "<=": lambda a, b: a <= b,
    ">": lambda a, b: a > b,
    ">=": lambda a, b: a >= b,
    "==": lambda a, b: a == b,
    "!=": lambda a, b: a != b,
}
_ARITHMETIC: dict[str, Callable[[Any, Any], Any]] = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b,
}
_SIGNS: dict[type[ast.AST], str] = {
    ast.Lt: "<",
    ast.LtE: "<=",
    ast.Gt: ">",
    ast.GtE: ">=",
    ast.Eq: "==",
    ast.NotEq: "!=",
    ast.Add: "+",
    ast.Sub: "-",
    ast.Mult: "*",
    ast.Div: "/",
}


@dataclass(frozen=True, slots=True)
class Invariant:
    """One line: if `when` is true (None: always), `then` must be true."""

    text: str
    when: Node | None
    then: Node
    within: Span | None = None
    """How long `then` may be false without a break while `when` is true; None: not at all."""

    def __hash__(self) -> int:
        return hash(self.text)  # a shield looks its lines up at every decision

    @property
    def nodes(self) -> Iterator[Node]:
        """All parts of the line."""
        for top in (self.when, self.then):
            if top is not None:
                yield from walk(top)

    @property
    def over_time(self) -> bool:
        """Whether it is about more than one decision."""
        return self.within is not None or any(isinstance(n, Recent) for n in self.nodes)

    @property
    def of_link(self) -> bool:
        """Whether it must hold for each link separately."""
        return _is_of_link(self)

    @property
    def over_links(self) -> bool:
        """Whether it has a function over all links."""
        return _is_over_links(self)

    @property
    def when_of_link(self) -> bool:
        """Whether its condition is one of each link."""
        return _is_when_of_link(self)

    @property
    def needs_fresh(self) -> bool:
        """Whether it compares with the policy's decision at age 0."""
        return any(isinstance(n, Fresh) for n in self.nodes)


@lru_cache(maxsize=1024)
def _is_of_link(rule: Invariant) -> bool:
    return any(_needs_link(n) for n in (rule.when, rule.then) if n is not None)


@lru_cache(maxsize=1024)
def _is_over_links(rule: Invariant) -> bool:
    return any(isinstance(n, LinksTerm) for n in rule.nodes)


@lru_cache(maxsize=1024)
def _is_when_of_link(rule: Invariant) -> bool:
    return rule.when is not None and _needs_link(rule.when)


def walk(node: Node) -> Iterator[Node]:
    """The node and all below it."""
    yield node
    for below in _children(node):
        yield from walk(below)


def _children(node: Node) -> tuple[Node, ...]:
    match node:
        case Binary():
            return (node.left, node.right)
        case Logic():
            return node.parts
        case LinksTerm():
            return (node.body,)
        case _:
            return ()


def _needs_link(node: Node) -> bool:
    if isinstance(node, LinksTerm):
        return False  # it binds the link itself
    if isinstance(node, Fresh | Recent):
        return True
    if isinstance(node, Name):
        return node.word in WORDS and WORDS[node.word].of_link
    return any(_needs_link(below) for below in _children(node))


# --- from text -----------------------------------------------------------------------------------


def parse(text: str) -> tuple[Invariant, ...]:
    """The invariants in a text, one on each line.

    Raises:
        InvariantError: naming the line and what is wrong with it.
    """
    found = []
    for number, raw in enumerate(text.splitlines(), 1):
        line = raw.partition("#")[0].strip()
        if not line:
            continue
        try:
            found.append(_parse_line(line))
        except InvariantError as error:
            raise InvariantError(f"line {number}, {line!r}: {error}") from None
    return tuple(found)


@lru_cache(maxsize=256)  # equal lines are one object: a shield looks its lines up at every decision
def _parse_line(line: str) -> Invariant:
    when = None
    requirement = line
    if line.startswith("when "):
        condition, colon, requirement = line.removeprefix("when ").partition(":")
        if not colon:
            raise InvariantError("a condition ends with a colon, as in `when battery < 0.3: rate_hz <= 2`")
        when = _parse_expression(condition)
    within = None
    if re.match(r"\s*within\b", requirement):
        time, colon, requirement = requirement.strip().removeprefix("within").partition(":")
        if not colon or (not time.strip().endswith("s") and time.strip() != DWELL):
            raise InvariantError("a time ends with `s` and a colon, as in `within 0.5 s: representation > none`")
        within = _span(time.strip().removesuffix("s").strip())
    return Invariant(line, when, _parse_expression(requirement), within)


def _span(text: str) -> Span:
    """A time as it is written: `0.5`, or `dwell`."""
    if text == DWELL:
        return DWELL
    if not re.fullmatch(r"\d+(\.\d*)?|\.\d+", text) or not LEAST_SPAN_S <= float(text) <= MOST_SPAN_S:
        raise InvariantError(f"the time {text!r} must be in [{LEAST_SPAN_S:g}, {MOST_SPAN_S:g}] s, or {DWELL}")
    return float(text)


def _parse_expression(text: str) -> Node:
    try:
        tree = ast.parse(text.strip(), mode="eval").body
        node = _to_node(tree)
    except (SyntaxError, RecursionError, ValueError, MemoryError) as error:
        if isinstance(error, InvariantError):
            raise
        raise InvariantError(f"{text.strip()!r:.80} is not an expression") from None
    if _kind(node) != "truth":
        raise InvariantError(f"{text.strip()!r} is a number, must be true or false")
    return node


def _to_node(tree: ast.expr) -> Node:
    """The tree of an expression, by an allow-list: everything else is refused."""
    match tree:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            try:
                number = float(value)
            except OverflowError:
                number = math.inf
            if number == math.inf:
                raise InvariantError("a number is too large for a float")
            return Number(number)
        case ast.Name(id=word):
            if word in CONSTANTS:
                return Number(CONSTANTS[word])
            if word in WORDS:
                return Name(word)
            hint = f" ({ELSEWHERE[word]})" if word in ELSEWHERE else ""
            raise InvariantError(f"unknown word {word!r}{hint}, known: {', '.join([*WORDS, *CONSTANTS, *CHANGES])}")
        case ast.Attribute(value=ast.Name(id="fresh"), attr=word) if word in DECISIONS:
            return Fresh(word)
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return Logic("not", (_to_node_of_kind("truth", operand),))
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return Binary("-", Number(0), _to_node_of_kind("number", operand))
        case ast.BoolOp(op=op, values=values):
            return Logic(
                "and" if isinstance(op, ast.And) else "or", tuple(_to_node_of_kind("truth", v) for v in values)
            )
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _SIGNS:
            return Binary(_SIGNS[type(op)], _to_node_of_kind("number", left), _to_node_of_kind("number", right))
        case ast.Compare(left=first, ops=ops, comparators=rest) if all(type(op) in _SIGNS for op in ops):
            sides = [_to_node_of_kind("number", side) for side in (first, *rest)]
            pairs = [
                Binary(_SIGNS[type(op)], left, right) for op, left, right in zip(ops, sides, sides[1:], strict=False)
            ]
            return pairs[0] if len(pairs) == 1 else Logic("and", tuple(pairs))
        case ast.Call(func=ast.Name(id=change), args=[ast.Name() | ast.Constant() as time], keywords=[]) if (
            change in CHANGES
        ):
            return Recent(change, _span(ast.unparse(time)))
        case ast.Call(func=ast.Name(id=function), args=[body], keywords=[]) if function in LINK_FUNCTIONS:
            inner = _to_node_of_kind(LINK_FUNCTIONS[function][0], body)
            if any(isinstance(n, LinksTerm) for n in walk(inner)):
                raise InvariantError(f"{function}(…) has another function over links inside")
            return LinksTerm(function, inner)
    raise InvariantError(f"{ast.unparse(tree)!r} is not allowed in an invariant")


def _to_node_of_kind(kind: Kind, tree: ast.expr) -> Node:
    node = _to_node(tree)
    if _kind(node) != kind:
        wanted = "a number" if kind == "number" else "true or false"
        raise InvariantError(f"{ast.unparse(tree)!r} must be {wanted}")
    return node


def _kind(node: Node) -> Kind:
    match node:
        case Number() | Recent():
            return "number"
        case Name() | Fresh():
            return WORDS[node.word].kind
        case Binary():
            return "truth" if node.sign in COMPARE else "number"
        case Logic():
            return "truth"
        case LinksTerm():
            return LINK_FUNCTIONS[node.function][1]


# --- judging -------------------------------------------------------------------------------------


def violations(
    invariant: Invariant,
    view: FleetView,
    directives: Sequence[Directive],
    fresh: Sequence[Directive] = (),
    past: Counts | None = None,
) -> list[Directive | None]:
    """The directives that break an invariant; [None] if they only break it together.

    Args:
        invariant: the line.
        view: the policy's input.
        directives: its output.
        fresh: its output for the same view at age 0, if the invariant needs it.
        past: what the links did before, if the invariant counts changes. How long a line is broken is `Past.overdue`'s.
    """
    me = view.me
    if me is None:
        return []
    scope = Scope(view, me, directives, {d.destination: d for d in fresh}, None, past)
    if invariant.when is not None and not invariant.when_of_link and not evaluate(invariant.when, scope):
        return []
    broken: list[Directive | None] = []
    for link in directives if invariant.of_link else (None,):
        here = scope._replace(link=link)
        if (invariant.when is None or evaluate(invariant.when, here)) and not evaluate(invariant.then, here):
            broken.append(link)
    return broken


def evaluate(node: Node, scope: Scope) -> Any:
    """An expression's value; a division by zero is infinite."""
    match node:
        case Number():
            return node.value
        case Name():
            return WORDS[node.word].value(scope)
        case Fresh():
            link = link_of(scope)
            known = scope.fresh.get(link.destination, Directive(link.source, link.destination))
            return WORDS[node.word].value(scope._replace(link=known))
        case Recent():
            if scope.past is None:
                raise InvariantError(f"{node.change}(…) is about time: a single view does not decide it")
            return scope.past.count(node.change, link_of(scope).destination, node.span)
        case Logic(word="not"):
            return not evaluate(node.parts[0], scope)
        case Logic():
            values = (evaluate(part, scope) for part in node.parts)
            return all(values) if node.word == "and" else any(values)
        case Binary():
            left, right = evaluate(node.left, scope), evaluate(node.right, scope)
            if node.sign in COMPARE:
                return COMPARE[node.sign](left, right)
            if node.sign == "/" and right == 0:
                return float("inf")
            return _ARITHMETIC[node.sign](left, right)
        case LinksTerm():
            links = (evaluate(node.body, scope._replace(link=d)) for d in scope.directives)
            if node.function == "any_link":
                return any(links)
            if node.function == "every_link":
                return all(links)
            return sum(1 if v else 0 for v in links) if node.function == "count_links" else plain_sum(links)


def just_heard(view: FleetView) -> FleetView:
    """The same view with every age 0."""
    return view._replace(age_s=dict.fromkeys(view.age_s, 0.0))


def describe_directives(directives: Iterable[Directive]) -> str:
    """A short text for each directive."""
    texts = (
        f"→{d.destination} {NAME_OF[Representation(d.representation)]} ρ {d.rho:g} {d.rate_hz:g} Hz "
        f"duty {d.duty_percent} % ({d.reason})"
        for d in directives
    )
    return listed(texts, "; ")


def listed(items: Iterable[object], between: str = ", ") -> str:
    """Items as text; of more than `MOST_LISTED` the first, and how many more there are.

    Example:
        >>> listed([3, 1, 2])
        '3, 1, 2'
    """
    texts = [str(item) for item in items]
    more = len(texts) - MOST_LISTED
    return between.join(texts[:MOST_LISTED]) + (f" and {more} more" if more > 0 else "")


def by_peer(directives: Iterable[Directive]) -> dict[int, Directive]:
    """Directives by their destinations."""
    return {d.destination: d for d in directives}
