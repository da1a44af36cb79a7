"""Notes of what a policy computes, made alike on stand-ins and on real objects, so that the two can be compared.

The answer alone does not show every difference. A policy may compute otherwise on real objects and use it in a few views
only, such as `differs and 0.4 < charge < 0.4000001`. So the value of each expression is noted, in the order in which Python
works them out: names, calls, comparisons, operators, attributes, items, and whatever decides what runs next.
"""

from __future__ import annotations

import ast
import builtins
import types
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import Any

from sortie.policies.verification.symbols import Ranged
from sortie.scenarios.plugins.user_code import load

NOTED = "__noted__"
"""The name under which a noted source calls `noted`."""


class Notes(ast.NodeTransformer):
    """Puts the notes into a source."""

    def visit(self, node: ast.AST) -> Any:
        """The node, with the notes in it."""
        skipped = _SKIPPED.get(type(node), ())
        for name, part in ast.iter_fields(node):
            if name in skipped:
                continue
            if isinstance(part, list):
                part[:] = [self.visit(x) if isinstance(x, ast.AST) else x for x in part]
            elif isinstance(part, ast.AST):
                setattr(node, name, self.visit(part))
        match node:
            case ast.Call(func=func):
                node.func = _without(func)
                return _noted(node)
            case ast.BoolOp(values=values):
                node.values = list(map(_noted, values))
            case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test) | ast.Assert(test=test):
                node.test = _noted(test)
            case ast.comprehension(ifs=tests):
                node.ifs = list(map(_noted, tests))
            case ast.match_case(guard=ast.expr() as guard):
                node.guard = _noted(guard)
            case ast.Compare() | ast.BinOp() | ast.UnaryOp():
                return _noted(node)
            case ast.Name(ctx=ast.Load()) | ast.Subscript(ctx=ast.Load()) | ast.Attribute(ctx=ast.Load()):
                return _noted(node)
        return node


_SKIPPED: dict[type[ast.AST], tuple[str, ...]] = {
    ast.FunctionDef: ("returns",), ast.arg: ("annotation",), ast.AnnAssign: ("annotation",), ast.ExceptHandler: ("type",),
    ast.match_case: ("pattern",),
}  # fmt: skip
"""Parts of a source that must stay as they are."""


def _noted(node: ast.expr) -> ast.expr:
    return ast.copy_location(ast.Call(ast.Name(NOTED, ast.Load()), [_without(node)], []), node)


def _without(node: ast.expr) -> ast.expr:
    """An expression without the note on itself."""
    is_noted = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == NOTED
    return node.args[0] if is_noted else node  # type: ignore[attr-defined]


class _Log:
    """The notes of the decision that runs now."""

    notes: list[Any] | None = None


@contextmanager
def taking_notes() -> Iterator[list[Any]]:
    """The notes of what runs within."""
    before, _Log.notes = _Log.notes, []
    try:
        yield _Log.notes
    finally:
        _Log.notes = before


def noted(value: Any) -> Any:
    """Note a value, and return it."""
    if _Log.notes is not None:
        _Log.notes.append(_shown(value))
    return value


_VALUES = frozenset({int, bool, float, str, bytes, type(None)})
_SIZED = (list, tuple, dict, set, frozenset)
_DEPTH = 4
"""So far within one another, the contents of lists, tuples and dictionaries are compared."""
_ANY = object()
"""The note of an object of which nothing is compared."""


def _shown(value: Any, depth: int = _DEPTH) -> Any:
    """What is compared of an object. Nothing that may change, or that lives longer for it."""
    kind = type(value)
    if kind in _VALUES or issubclass(kind, Ranged):
        return value
    if issubclass(kind, Enum):
        return kind.__qualname__, value._name_
    if depth and (kind is list or kind is tuple):
        return _Inside((kind.__name__, *[_shown(x, depth - 1) for x in value]))
    if depth and kind is dict:
        return _Inside(("dict", *[_shown(x, depth - 1) for item in value.items() for x in item]))
    for sized in _SIZED:
        if issubclass(kind, sized):
            return sized.__name__, sized.__len__(value)
    return _ANY


class _Inside(tuple[Any, ...]):
    """The note of a collection: its kind, and the notes of what is in it."""

    __slots__ = ()


def are_alike(notes: list[Any], real: list[Any], values: Mapping[str, float]) -> bool:
    """Whether the notes on stand-ins are those on real objects, where the inputs have these values."""
    return len(notes) == len(real) and all(_is_alike(a, b, values) for a, b in zip(notes, real, strict=True))


def _is_alike(note: Any, real: Any, values: Mapping[str, float]) -> bool:
    if note is _ANY or real is _ANY:
        return True
    if type(note) is _Inside and type(real) is _Inside:
        return len(note) == len(real) and all(_is_alike(a, b, values) for a, b in zip(note, real, strict=True))
    value = note._value_in(values) if isinstance(note, Ranged) else note
    return type(value) is type(real) and (value == real or (value != value and real != real))


def load_with_notes(path: Path) -> types.ModuleType:
    """A user's file, loaded as a new module that runs as Python runs it and makes notes.

    Raises:
        Exception: what the file raises.
    """

    def compiled(source: bytes, file: str) -> types.CodeType:
        tree = ast.fix_missing_locations(Notes().visit(ast.parse(source, file)))
        code: types.CodeType = compile(tree, file, "exec", dont_inherit=True)
        return code

    return load(path, compiled, lambda find: vars(builtins) | {"__import__": find, NOTED: noted})
