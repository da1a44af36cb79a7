"""The checks on values in an instrumented policy: results of compiled code, texts, classes and identity.

What would show that a number is a stand-in raises `Refused`: a text with its value, for example. Identity and addresses
raise `Reached`. `call_checks` has the checks on calls and attributes.
"""

from __future__ import annotations

import types
from abc import ABC
from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Callable, Iterable
from enum import Enum, IntEnum, ReprEnum
from typing import Any, Generic, NamedTuple, Protocol

from sortie.policies.contract import Directive
from sortie.policies.verification.outside import Outside
from sortie.policies.verification.pure import home_of
from sortie.policies.verification.symbols import MARK, Ranged, Text
from sortie.policies.verification.watch import WATCH, WATCHED, plain_set, reach, stop, unordered
from sortie.scenarios.plugins.user_code import is_users

STAND_INS = (
    "sortie.policies.verification.symbols",
    "sortie.policies.verification.ranges",
    "sortie.policies.verification.stand_ins",
    "sortie.policies.verification.solver",
)


def is_stand_in(value: object) -> bool:
    return type(value).__module__ in STAND_INS


def checked(found: Any) -> Any:
    """What a call returned, each set as one that watches its order.

    Plain text into which a number was written is refused, because its use is not noticed.
    """
    found = unordered(found)
    parts, met = [found], set[int]()
    while parts:
        part = parts.pop()
        kind = type(part)
        if kind is str and MARK in part:
            stop("uses the text of a number inside other text for more than a reason")
        if kind is set or kind is frozenset:
            stop("makes sets within another object")
        if (kind in _CONTAINERS or isinstance(part, tuple)) and not is_stand_in(part) and id(part) not in met:
            met.add(id(part))
            parts += [x for item in part.items() for x in item] if isinstance(part, dict) else part
    return found


_CONTAINERS = (list, dict, deque, defaultdict, OrderedDict, Counter)


def with_texts(found: Any) -> Any:
    """Directives of Sortie's own policies, with their reasons as texts that can only be reasons."""
    if type(found) is Directive and type(found.reason) is str and MARK in found.reason and WATCH.path is not None:
        return found._replace(reason=Text(WATCH.path, "a number of the view", found.reason))
    if type(found) in (list, tuple) and any(type(part) is Directive for part in found):
        return type(found)(map(with_texts, found))
    return found


def _made(kind: type) -> type:
    """A class of the policy's, if what it is derived from is plain: nothing, a named tuple, an enum, a class like it."""
    for base in kind.__mro__:
        allowed = base in _BASES or (base is int and Enum in kind.__mro__) or (base is tuple and _is_named(kind))
        if not (allowed or is_users(home_of(base))):
            stop(f"derives {kind.__name__} from {base.__name__}")
    return kind


def _is_named(kind: type) -> bool:
    return any(NamedTuple in vars(base).get("__orig_bases__", ()) for base in kind.__mro__)


_BASES = (object, Protocol, Generic, ABC, Enum, IntEnum, ReprEnum)


def cannot_ask(kinds: Any) -> str | None:
    """Why a search cannot ask whether something is an instance of these; None if it can."""
    if isinstance(kinds, tuple):
        return next((why for one in kinds if (why := cannot_ask(one))), None)
    if isinstance(kinds, types.UnionType):
        return cannot_ask(kinds.__args__)
    if kinds in WATCHED or kinds in _ASKED or (isinstance(kinds, type) and _is_own(kinds)):
        return None
    return f"asks whether something is a {getattr(kinds, '__name__', kinds)}"


_ASKED = (bool, int, float, str, bytes, list, tuple, dict, set, frozenset, type(None))


def _is_own(kind: type) -> bool:
    """Whether a class is the policy's or Sortie's, and is asked plainly."""
    home = home_of(kind)
    return (is_users(home) or home.startswith("sortie.")) and not getattr(kind, "_is_protocol", False)


_NUMBERS = (int, float, bool, str, bytes, type(None))


def join(function: Any, parts: list[Any]) -> Any:
    """A text's `join` of these parts."""
    found = next((part for part in parts if type(part) is Text), None)
    if found is not None:
        return Text(found._path, found._axis, "text with a number")
    if any(map(is_stand_in, parts)):
        stop("makes text of what is known as a range alone")
    return checked(function(parts))


def are_plain(values: Iterable[Any]) -> bool:
    """Whether these are numbers and texts of Python's own, which compiled code may read as it likes."""
    return all(type(value) in _NUMBERS or (type(value) in (list, tuple) and are_plain(value)) for value in values)


def _same(a: Any, b: Any) -> bool:
    for one in (a, b):
        if isinstance(one, Outside):
            one._used()
    for one in (a, b):
        if one is None or isinstance(one, bool | Enum | type):
            return a is b
    if is_stand_in(a) or is_stand_in(b) or isinstance(a, _VALUES) or isinstance(b, _VALUES):
        reach("the identity of a value (`is`)")
    stop("asks whether two objects are the same (`is`)")


_VALUES = (int, float, str, bytes, tuple, frozenset)


_LONGEST = 10**600
"""Python's settings decide from where on the text of a number is an error."""


def _is_writable(value: Any) -> bool:
    """Whether the text of an object is the same in every process, in every folder, and in a search."""
    kind = type(value)
    if kind is int:
        return bool(-_LONGEST < value < _LONGEST)
    if kind is dict:
        return all(map(_is_writable, value)) and all(map(_is_writable, value.values()))
    if kind in (list, tuple):
        return all(map(_is_writable, value))
    if isinstance(value, Enum):
        return _is_writable(value._value_)
    return kind in _NUMBERS or isinstance(value, Text | Ranged)


def _text_of(write: Callable[[Any], str]) -> Callable[..., Any]:
    def act(*args: Any, **kwargs: Any) -> Any:
        if len(args) != 1 or kwargs:
            return NotImplemented
        (value,) = args
        if not _is_writable(value):
            stop(f"makes text of a {type(value).__name__}")
        return value._text() if isinstance(value, Text | Ranged) else checked(write(value))

    return act


text_of = _text_of(str)
"""`str`, with a check."""
_WRITES = {-1: lambda value: value, 114: _text_of(repr), 115: text_of}


def _written(value: Any, conversion: int, spec: str) -> Any:
    """A value in an f-string."""
    if isinstance(value, Outside):
        value._used()
    value = _WRITES[conversion](value)
    if is_stand_in(spec) or (is_stand_in(value) and spec[-1:] == "c"):
        stop("lets a number of the view decide the form of a text")
    if not _is_writable(value):
        stop(f"makes text of a {type(value).__name__}")
    if isinstance(value, Text) and spec:  # which may leave nothing of it
        stop("formats a text that has a number of the view")
    return value._text(spec) if isinstance(value, Text | Ranged) else checked(format(value, spec))


def _text(*parts: Any) -> Any:
    """An f-string of its parts."""
    tainted = next((p for p in parts if isinstance(p, Text)), None)
    return (
        "".join(parts)
        if tainted is None
        else Text(tainted._path, tainted._axis, "".join(str.__str__(p) for p in parts))
    )


def _no_text(left: Any) -> Any:
    """What stands before a `%`."""
    if isinstance(left, str | bytes):
        stop("writes text with `%`")
    return left


def _no_set(right: Any) -> Any:
    """What an attribute or an item is changed by in place."""
    if not isinstance(right, int | float):
        stop("changes a part of an object by a set, in place")
    return right


def _operand(held: Any, right: Any) -> Any:
    """What a name is changed by in place."""
    if type(held) in WATCHED and not isinstance(right, set | frozenset):
        stop("changes a set in place by something that is none")
    return plain_set(right)


def _among(left: Any, right: Any) -> bool:
    if isinstance(left, Text) and isinstance(right, str):
        stop("looks for the text of a number in other text")
    if isinstance(right, Outside):
        right._used()
    return left in right


VALUE_CHECKS: dict[str, Any] = {
    "__same__": _same, "__text__": _text, "__written__": _written, "__no_text__": _no_text, "__no_set__": _no_set, "__operand__": _operand,
    "__among__": _among, "__made__": _made,
}  # fmt: skip
"""By the names under which `source_checks` calls them."""
