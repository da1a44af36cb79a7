"""The checks on values in an instrumented policy: results of compiled code, texts, classes and identity.

What would show that a number is a stand-in raises `Refused`: a text with its value, for example. Identity and addresses
raise `Reached`. `call_checks` has the checks on calls and attributes.
"""

from __future__ import annotations

import types
from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Callable
from enum import Enum
from typing import Any

from sortie.policies.verification.outside import Outside
from sortie.policies.verification.pure import home_of
from sortie.policies.verification.symbols import MARK, Ranged, Text
from sortie.policies.verification.watch import Unordered, UnorderedFrozen, reach, stop, unordered
from sortie.scenarios.plugins.user_code import PREFIX, is_users

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

    Plain text into which a number was written is refused, because its use is not noticed. So is text with an address, or with
    the name of the policy's module, which depends on where its file lies.
    """
    found = unordered(found)
    parts, met = [found], set[int]()
    while parts:
        part = parts.pop()
        kind = type(part)
        if kind is str and MARK in part:
            stop("uses the text of a number inside other text for more than a reason")
        if kind is str and (" at 0x" in part or PREFIX in part):
            reach(f"the address in {part!r}" if PREFIX not in part else "the place of its file")
        if kind is set or kind is frozenset:
            stop("makes sets within another object")
        if kind in _CONTAINERS and id(part) not in met:
            met.add(id(part))
            parts += [x for item in part.items() for x in item] if isinstance(part, dict) else part
    return found


_CONTAINERS = (list, tuple, dict, deque, defaultdict, OrderedDict, Counter)
_BASES = ("builtins.object", "builtins.tuple", "builtins.int", "builtins.str", "typing.Protocol", "typing.Generic", "abc.ABC",
    "enum.Enum", "enum.IntEnum", "enum.StrEnum", "enum.ReprEnum")  # fmt: skip


def _made(kind: type) -> type:
    """A class of the policy's, if what it is derived from is plain: nothing, a named tuple, an enum, a class like it."""
    for base in kind.__mro__:
        if not is_users(home_of(base)) and f"{base.__module__}.{base.__qualname__}" not in _BASES:
            stop(f"derives {kind.__name__} from {base.__name__}")
    return kind


def cannot_ask(kinds: Any) -> str | None:
    """Why a search cannot ask whether something is an instance of these; None if it can."""
    if isinstance(kinds, tuple):
        return next((why for one in kinds if (why := cannot_ask(one))), None)
    if isinstance(kinds, types.UnionType):
        return cannot_ask(kinds.__args__)
    if kinds in (Unordered, UnorderedFrozen) or kinds in _ASKED or (isinstance(kinds, type) and _is_own(kinds)):
        return None
    return f"asks whether something is a {getattr(kinds, '__name__', kinds)}"


_ASKED = (bool, int, float, str, bytes, list, tuple, dict, set, frozenset, type(None))


def _is_own(kind: type) -> bool:
    """Whether a class is the policy's or Sortie's, and is asked plainly."""
    home = home_of(kind)
    return (is_users(home) or home.startswith("sortie.")) and not getattr(kind, "_is_protocol", False)


def may_hold_stand_in(value: Any) -> bool:
    if type(value) in (list, tuple):
        return any(map(may_hold_stand_in, value))
    return is_stand_in(value) or isinstance(value, types.GeneratorType | map | filter)


def stands_for_text(function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """A method of a plain text that is given the text of a range, or something that may yield one."""
    if function.__name__ != "join" or len(args) != 1 or kwargs:
        stop(f"gives the text of a number to str.{function.__name__}")
    parts = args[0] if isinstance(args[0], Text) else list(args[0])
    found = next((part for part in parts if is_stand_in(part)), None)
    if found is None:
        return checked(function(parts))
    if isinstance(found, Text):
        return Text(found._path, found._axis, "text with a number")
    return stop("makes text of what is known as a range alone")


def _same(a: Any, b: Any) -> bool:
    for one in (a, b):
        if isinstance(one, Outside):
            one._used()
    for one in (a, b):
        if one is None or isinstance(one, bool | Enum | type):
            return a is b
    if is_stand_in(a) or is_stand_in(b) or isinstance(a, _VALUES) or isinstance(b, _VALUES):
        reach("the identity of a value (`is`)")
    return a is b


_VALUES = (int, float, str, bytes, tuple, frozenset)


def _text_of(write: Callable[[Any], str]) -> Callable[..., Any]:
    def act(*args: Any, **kwargs: Any) -> Any:
        if len(args) != 1 or kwargs:
            return NotImplemented
        return args[0]._text() if isinstance(args[0], Text | Ranged) else checked(write(args[0]))

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


def _among(left: Any, right: Any) -> bool:
    if isinstance(left, Text) and isinstance(right, str):
        stop("looks for the text of a number in other text")
    if isinstance(right, Outside):
        right._used()
    return left in right


VALUE_CHECKS: dict[str, Any] = {
    "__same__": _same, "__text__": _text, "__written__": _written, "__no_text__": _no_text, "__no_set__": _no_set,
    "__among__": _among, "__made__": _made,
}  # fmt: skip
"""By the names under which `source_checks` calls them."""
