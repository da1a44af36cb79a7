"""Invariants: conditions that a policy's directives must satisfy for every view, as short lines of text.

    when battery < 0.3: representation <= detections and rate_hz <= 2
    when target_in_region and peers >= 1: any_link(representation >= detections)
    rate_hz <= fresh.rate_hz

A line is `REQUIREMENT`, or `when CONDITION: REQUIREMENT`; `#` begins a comment. An expression has comparisons,
`and`, `or`, `not`, `+ - * /`, numbers, and the names in `WORDS`. A line that names a property of a link must hold for
each outgoing link. `any_link(…)`, `every_link(…)`, `count_links(…)` and `sum_links(…)` cover all links at once.
`fresh.rate_hz` is what the same policy decides for the same link if every descriptor has age 0.

Python's parser reads the text. An allow-list of its nodes becomes a frozen tree. Nothing is ever executed.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from sortie.policies.contract import PERSON_FLAG, Descriptor, Directive, FleetView, Policy, Representation, TaskPhase
from sortie.scenarios.errors import SortieError
from sortie.scenarios.representation import NAME_OF

Kind = Literal["number", "truth"]


class InvariantError(SortieError):
    """A text that is not an invariant; the message names the line and the part that is wrong."""


# --- the words -----------------------------------------------------------------------------------


class Scope(NamedTuple):
    """The values that an expression is evaluated on: a view, all its directives, and one link if the line needs a link."""

    view: FleetView
    me: Descriptor
    directives: Sequence[Directive]
    fresh: Mapping[int, Directive]
    link: Directive | None = None


class Word(NamedTuple):
    """A name of the language; `of_link` if it needs a link."""

    about: str
    kind: Kind
    of_link: bool
    value: Callable[[Scope], Any]
    raw: Callable[..., Any] | None = None
    """Of a directive's field: from the directive. Of a peer: from the scope and the peer's id."""


def _view_word(about: str, value: Callable[[Scope], Any], kind: Kind = "number") -> Word:
    return Word(about, kind, False, value)


def _decided(about: str, value: Callable[[Directive], Any], kind: Kind = "number") -> Word:
    return Word(about, kind, True, lambda s: value(_link(s)), value)


def _of_peer(about: str, value: Callable[[Scope, int], Any], kind: Kind = "number") -> Word:
    return Word(about, kind, True, lambda s: value(s, _link(s).destination), value)


def _link(scope: Scope) -> Directive:
    assert scope.link is not None, "the parser binds link words to a link"  # noqa: S101
    return scope.link


DECISIONS: dict[str, Word] = {
    "representation": _decided("the rung: none, tracks, detections, features or raw", lambda d: d.representation),
    "rho": _decided("share of the sender's feature cells, 0 … 1", lambda d: d.rho),
    "rate_hz": _decided("rate, Hz", lambda d: d.rate_hz),
    "deadline_s": _decided("deadline, s", lambda d: d.deadline_s),
    "fusion_weight": _decided("weight at the receiver, 0 … 1", lambda d: d.fusion_weight),
    "duty": _decided("share of frames in which perception runs, 0 … 1", lambda d: d.duty_percent / 100),
    "roi": _decided("whether it is confined to a region", lambda d: d.roi is not None, "truth"),
}
"""The fields of a directive, as names of the language."""

WORDS: dict[str, Word] = {
    "battery": _view_word("the ego's state of charge, 0 … 1", lambda s: s.me.battery_soc),
    "cpu": _view_word("the ego's CPU headroom, 0 … 1", lambda s: s.me.cpu_headroom),
    "gpu": _view_word("the ego's GPU headroom, 0 … 1", lambda s: s.me.gpu_headroom),
    "phase": _view_word("the ego's: transit, search, track, returning or landing", lambda s: s.me.task_phase),
    "peers": _view_word("how many peers are attached", lambda s: len(s.view.attached.peers)),
    "region": _view_word("the ego has a region of responsibility", lambda s: s.me.region is not None, "truth"),
    "targets": _view_word("the ego reports priority targets", lambda s: bool(s.me.priority_target_ids), "truth"),
    "target_in_region": _view_word(
        "the ego has a region and reports targets, which are cars",
        lambda s: s.me.region is not None and bool(s.me.priority_target_ids),
        "truth",
    ),
    "human_in_region": _view_word(
        "the ego has a region, and its thermal camera or an attached peer's found a person there",
        lambda s: s.view.human_in_region,
        "truth",
    ),
    "goodput_mbps": _of_peer("to the link's peer, as the ego measured it", lambda s, p: s.me.goodput_to(p)),
    "age_s": _of_peer("age of the peer's descriptor", lambda s, p: s.view.age_s[p]),
    "age_periods": _of_peer("the same in periods", lambda s, p: s.view.age_s[p] / s.view.period_s),
    "peer_battery": _of_peer("the peer's state of charge, 0 … 1", lambda s, p: s.view.descriptors[p].battery_soc),
    "human": _view_word(
        "the ego's own thermal camera found a person in its region",
        lambda s: s.me.novelty_flags & PERSON_FLAG != 0,
        "truth",
    ),
    "peer_human": _of_peer(
        "the peer's thermal camera found a person in the peer's region",
        lambda s, p: s.view.descriptors[p].novelty_flags & PERSON_FLAG != 0,
        "truth",
    ),
    "peer_phase": _of_peer("the peer's phase", lambda s, p: s.view.descriptors[p].task_phase),
    "same_network": _of_peer(
        "the peer has the ego's network, so it can fuse the ego's maps",
        lambda s, p: s.view.shares_features_with(p),
        "truth",
    ),
    **DECISIONS,
}
"""Every name that an invariant may use."""

CONSTANTS: dict[str, int] = {name: int(r) for r, name in NAME_OF.items()} | {
    "transit": TaskPhase.TRANSIT,
    "search": TaskPhase.SEARCH,
    "track": TaskPhase.TRACK,
    "returning": TaskPhase.RETURN,  # `return` is a Python keyword
    "landing": TaskPhase.LANDING,
}
LINK_FUNCTIONS: dict[str, tuple[Kind, Kind]] = {
    "any_link": ("truth", "truth"),
    "every_link": ("truth", "truth"),
    "count_links": ("truth", "number"),
    "sum_links": ("number", "number"),
}
"""Functions over all links: the kind of the argument, and of the result."""


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


Node = Number | Name | Fresh | Binary | Logic | LinksTerm

_COMPARE: dict[str, Callable[[Any, Any], Any]] = {
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
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Invariant:
    """One line: if `when` is true (None: always), `then` must be true."""

    text: str
    when: Node | None
    then: Node

    @property
    def of_link(self) -> bool:
        """Whether it must hold for each link separately."""
        return any(_needs_link(n) for n in (self.when, self.then) if n is not None)

    @property
    def needs_fresh(self) -> bool:
        """Whether it compares with the policy's decision at age 0."""
        return any(isinstance(n, Fresh) for top in (self.when, self.then) if top is not None for n in walk(top))


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
    if isinstance(node, Fresh):
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


def _parse_line(line: str) -> Invariant:
    when = None
    requirement = line
    if line.startswith("when "):
        condition, colon, requirement = line.removeprefix("when ").partition(":")
        if not colon:
            raise InvariantError("a condition ends with a colon, as in `when battery < 0.3: rate_hz <= 2`")
        when = _parse_expression(condition)
    return Invariant(line, when, _parse_expression(requirement))


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
            return Number(value)
        case ast.Name(id=word):
            if word in CONSTANTS:
                return Number(CONSTANTS[word])
            if word in WORDS:
                return Name(word)
            raise InvariantError(f"unknown word {word!r}, known: {', '.join([*WORDS, *CONSTANTS])}")
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
        case Number():
            return "number"
        case Name() | Fresh():
            return WORDS[node.word].kind
        case Binary():
            return "truth" if node.sign in _COMPARE else "number"
        case Logic():
            return "truth"
        case LinksTerm():
            return LINK_FUNCTIONS[node.function][1]


# --- judging -------------------------------------------------------------------------------------


def violations(
    invariant: Invariant, view: FleetView, directives: Sequence[Directive], fresh: Sequence[Directive] = ()
) -> list[Directive | None]:
    """The directives that break an invariant; [None] if they only break it together.

    Args:
        invariant: the line.
        view: the policy's input.
        directives: its output.
        fresh: its output for the same view at age 0, if the invariant needs it.
    """
    me = view.me
    if me is None:
        return []
    scope = Scope(view, me, directives, {d.destination: d for d in fresh})
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
            link = _link(scope)
            known = scope.fresh.get(link.destination, Directive(link.source, link.destination))
            return WORDS[node.word].value(scope._replace(link=known))
        case Logic(word="not"):
            return not evaluate(node.parts[0], scope)
        case Logic():
            values = (evaluate(part, scope) for part in node.parts)
            return all(values) if node.word == "and" else any(values)
        case Binary():
            left, right = evaluate(node.left, scope), evaluate(node.right, scope)
            if node.sign in _COMPARE:
                return _COMPARE[node.sign](left, right)
            if node.sign == "/" and right == 0:
                return float("inf")
            return _ARITHMETIC[node.sign](left, right)
        case LinksTerm():
            links = (evaluate(node.body, scope._replace(link=d)) for d in scope.directives)
            if node.function == "any_link":
                return any(links)
            if node.function == "every_link":
                return all(links)
            return sum(1 if v else 0 for v in links) if node.function == "count_links" else sum(links)


def find_violation(invariants: Iterable[Invariant], policy: Policy, view: FleetView) -> str | None:
    """The first invariant that a policy breaks on a view, as text; None if it keeps all."""
    directives = list(policy(view))
    fresh: list[Directive] | None = None
    for invariant in invariants:
        if invariant.needs_fresh and fresh is None:
            fresh = list(policy(just_heard(view)))
        for broken in violations(invariant, view, directives, fresh or ()):
            where = (
                "the directives break" if broken is None else f"directive {broken.source}→{broken.destination} breaks"
            )
            return f"{where} {invariant.text!r}: {describe_directives(directives if broken is None else [broken])}"
    return None


def just_heard(view: FleetView) -> FleetView:
    """The same view with every age 0."""
    return view._replace(age_s=dict.fromkeys(view.age_s, 0.0))


def describe_directives(directives: Iterable[Directive]) -> str:
    """A short text for each directive."""
    return "; ".join(
        f"→{d.destination} {NAME_OF[Representation(d.representation)]} ρ {d.rho:g} {d.rate_hz:g} Hz "
        f"duty {d.duty_percent} % ({d.reason})"
        for d in directives
    )
