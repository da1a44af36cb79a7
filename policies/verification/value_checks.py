"""The checks on values in an instrumented policy: results of compiled code, texts, classes, identity, and caught errors.

What would show that a number is a stand-in raises `Refused`: a text with its value, for example. Identity and addresses
raise `Reached`. `call_checks` has the checks on calls and attributes.
"""

from __future__ import annotations

import dis
import re
import sys
import types
from abc import ABCMeta
from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Callable, Iterator
from enum import Enum
from string import Formatter
from typing import Any

from sortie.policies.verification.outside import Outside
from sortie.policies.verification.pure import foreign_method, home_of
from sortie.policies.verification.symbols import MARK, Ranged, Text
from sortie.policies.verification.watch import WATCH, reach, stop, unordered
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

    Plain text into which a number was written is refused, because its use is not noticed. So is text with an address.
    """
    found = unordered(found)
    parts, met = [found], set[int]()
    while parts:
        part = parts.pop()
        kind = type(part)
        if kind is str and MARK in part:
            stop("uses the text of a number inside other text for more than a reason")
        if (kind is str and " at 0x" in part) or (kind is bytes and b" at 0x" in part):
            reach(f"the address in {part!r}")
        if kind is set or kind is frozenset:
            stop("makes sets within another object")
        if isinstance(part, type) and part is found:
            _made(part)
        if kind in _CONTAINERS and id(part) not in met:
            met.add(id(part))
            parts += [x for item in part.items() for x in item] if isinstance(part, dict) else part
    return found


_CONTAINERS = (list, tuple, dict, deque, defaultdict, OrderedDict, Counter)


_ASKS_KINDS = {"__subclasshook__", "__subclasscheck__", "__length_hint__"}
"""Methods that are given the class of a stand-in, or from which compiled code takes no stand-in and hides the error."""


def _made(kind: Any) -> Any:
    """A class as it is, if all that Python calls by its special names is the policy's own code."""
    if isinstance(kind, type) and is_users(home_of(kind)) and (name := foreign_method(kind)) is not None:
        stop(f"has compiled code as {name} of {kind.__name__}")
    if is_users(home_of(kind)):
        for name in _ASKS_KINDS & vars(kind).keys():
            if getattr(vars(kind)[name], "__module__", None) != "typing":
                stop(f"has {name} in {kind.__name__}")
        for name, value in vars(kind).items():
            if name[:2] == "__" and _is_lambda(getattr(value, "__func__", value)):
                stop(f"has a lambda as {name} of {kind.__name__}")
        if getattr(kind, "_is_runtime_protocol", False):
            stop(f"has the protocol {kind.__name__}, which instances are checked against")
    return kind


def _is_lambda(value: Any) -> bool:
    """Whether this is the policy's own `lambda`, which does not note the errors that leave it (`passed`)."""
    return (
        type(value) is types.FunctionType
        and value.__code__.co_name == "<lambda>"
        and is_users(str(value.__globals__.get("__name__")))
    )


_STAND_IN_NAMES = re.compile(
    r"\b(Ranged|Solved|Text|Flags|TargetIds|Space|Unsearchable|InAnyOrder|DescriptorOfRanges|ViewOfRanges|Unordered\w*"
    r"|Written|Outside|Unknown|_sum)\b|<locals>"
)
"""In the text of an error that real objects raise with another text."""


def _present_errors() -> Iterator[BaseException]:
    """The error that is handled now; of a group, each of its errors."""
    parts: list[Any] = [sys.exc_info()[1]]
    while parts:
        error = parts.pop()
        if isinstance(error, BaseExceptionGroup):
            parts += error.exceptions
        elif error is not None:
            yield error


def _origin(error: BaseException) -> types.TracebackType | None:
    """Where an error was raised."""
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    return last


def _home(origin: types.TracebackType | None) -> str:
    return "" if origin is None else str(origin.tb_frame.f_globals.get("__name__"))


def _shown() -> None:
    """A policy can look at the present error."""
    for error in _present_errors():
        if _home(_origin(error)) in STAND_INS or any(type(a) is str and _STAND_IN_NAMES.search(a) for a in error.args):
            stop("looks at an error whose text is another one in flight")


DOUBTFUL = (TypeError, AttributeError, SystemError)
"""Kinds of errors that compiled code raises of a stand-in although it would take the real object."""
_ALIKE = re.compile(
    r"'(?P<kind>\w+)' object (is not (iterable|subscriptable|callable)|does not support item (assignment|deletion))"
    r"|cannot unpack non-iterable NoneType object|object of type 'NoneType' has no len\(\)"
    r"|argument of type 'NoneType' is not iterable|bad operand type for .+: 'NoneType'"
    r"|unsupported operand type\(s\) for .+: ('NoneType' and '\w+'|'\w+' and 'NoneType')"
    r"|'[<>]=?' not supported between instances of ('NoneType' and '\w+'|'\w+' and 'NoneType')"
)
"""Texts of errors that real objects raise as well, unless `kind` is a stand-in's."""
_RAISES = dis.opmap["RAISE_VARARGS"]
_SETS = (dis.opmap["STORE_ATTR"], dis.opmap["DELETE_ATTR"])
_PLAIN_OWNERS = (type(None), int, float, str, bytes, tuple, list, dict, types.MappingProxyType, types.ModuleType)


def passed() -> None:
    """An error is caught, or leaves a function, whose caller may catch it."""
    WATCH.doubtful += [e for e in _present_errors() if isinstance(e, DOUBTFUL) and not _is_alike(e)]


def _is_alike(error: BaseException) -> bool:
    """Whether real objects raise this error as well."""
    origin = _origin(error)
    if origin is not None and is_users(_home(origin)):
        step = origin.tb_frame.f_code.co_code[origin.tb_lasti]
        if step == _RAISES or (step in _SETS and isinstance(error, AttributeError)):  # the second: see `_own`
            return True
    if isinstance(error, AttributeError):
        owner = error.obj
        known = type(owner) in _PLAIN_OWNERS or is_users(home_of(owner if isinstance(owner, type) else type(owner)))
        # A view and a descriptor are of classes of their own, with the fields of the real ones.
        lacks = issubclass(type(owner), tuple) and not hasattr(owner.__class__, str(error.name))
        return error.name is not None and (known or lacks)
    text = _ALIKE.fullmatch(str(error.args[0])) if type(error) is TypeError and error.args else None
    return text is not None and not _STAND_IN_NAMES.search(text["kind"] or "")


def _raised(kinds: Any) -> Any:
    """What is raised, or what an `except` names: as it is, if it is not outside."""
    for kind in kinds if type(kinds) is tuple else (kinds,):
        if isinstance(kind, Outside):
            kind._used()
        if type(kind) is tuple:
            _raised(kind)
    return kinds


def cannot_ask(kind: Any) -> str | None:
    """Why a search cannot ask whether a stand-in is an instance of this: its answer depends on more than `__class__`."""
    if isinstance(kind, tuple):
        return next((why for one in kind if (why := cannot_ask(one))), None)
    if isinstance(kind, types.UnionType):
        return cannot_ask(kind.__args__)
    if isinstance(kind, type):
        home, how = home_of(kind), type(kind)
        asks_plainly = how.__instancecheck__ is type.__instancecheck__ or (how is ABCMeta and is_users(home))
        if asks_plainly or home in ("numbers", "collections.abc"):
            return None
    return f"asks whether something is a {getattr(kind, '__name__', kind)}"


def _subject(value: Any) -> Any:
    """What a pattern of a mapping is matched with."""
    parts, met = [value], set[int]()
    while parts:
        part = parts.pop()
        if isinstance(part, Outside):
            part._used()
        if type(part) in (list, tuple, dict) and id(part) not in met:
            met.add(id(part))
            parts += part.values() if type(part) is dict else part
    return value


def _kinds(*kinds: Any) -> None:
    """The classes of a pattern."""
    for kind in kinds:
        if isinstance(kind, Outside):
            kind._used()
        if (why := cannot_ask(kind)) is not None:
            stop(why)


def _caught() -> None:
    passed()
    error = sys.exc_info()[1]
    if isinstance(error, BaseExceptionGroup):
        error = error.subgroup((RecursionError, MemoryError))
    if isinstance(error, RecursionError | MemoryError | BaseExceptionGroup):
        stop("goes on after the end of the stack or of the memory")


def may_hold_stand_in(value: Any) -> bool:
    if type(value) in (list, tuple):
        return any(map(may_hold_stand_in, value))
    return is_stand_in(value) or isinstance(value, types.GeneratorType | map | filter)


def stands_for_text(function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """A method of a plain text that is given the text of a range, or something that may yield one."""
    if function.__name__ not in ("join", "format", "format_map"):
        stop(f"gives the text of a number to str.{function.__name__}")
    if function.__name__ == "join" and len(args) == 1:
        parts = args[0] if isinstance(args[0], Text) else list(args[0])
        args = (parts,)
    else:
        parts = [*args, *kwargs.values()]
        if any(isinstance(part, types.GeneratorType | map | filter) for part in parts):
            stop("makes text of an iterator")
    found = next((part for part in parts if is_stand_in(part)), None)
    if found is None:
        return checked(function(*args, **kwargs))
    if isinstance(found, Text | Ranged):
        if function.__name__ == "format":  # what is wrong with a number of this type must raise
            if _takes_apart(function.__self__):
                stop(FORM_BY_VALUE)
            function(*map(_example, args), **{name: _example(value) for name, value in kwargs.items()})
        return Text(found._path, found._axis, "text with a number")
    return stop("makes text of what is known as a range alone")


FORM_BY_VALUE = "lets a number of the view decide the form of a text"
"""By a width that is a value, a part of a value, or a character: whether that is possible depends on the number."""
_PERCENT_APART = re.compile(r"%(\([^)]*\))?[^a-zA-Z%(]*(\*|[hlL]?c)")
"""In a template without its `%%`, which stand for themselves."""


def _takes_apart(template: str) -> bool:
    """Whether a template of `str.format` does more than write its values."""
    fields = [(name or "", spec or "") for _, name, spec, _ in Formatter().parse(template)]
    return any("." in name or "[" in name or "{" in spec or spec[-1:] == "c" for name, spec in fields)


def _same(a: Any, b: Any) -> bool:
    for one in (a, b):
        if isinstance(one, Outside):
            one._used()
    for one in (a, b):
        if one is None or one is NotImplemented or one is Ellipsis or isinstance(one, bool | Enum | type):
            return a is b
    if is_stand_in(a) or is_stand_in(b) or isinstance(a, _VALUES) or isinstance(b, _VALUES):
        reach("the identity of a value (`is`)")
    return a is b


_VALUES = (int, float, str, bytes, tuple, frozenset)


def _example(value: Any) -> Any:
    return value._example() if isinstance(value, Text | Ranged) else value


def _text_of(write: Callable[[Any], str]) -> Callable[..., Any]:
    def act(*args: Any, **kwargs: Any) -> Any:
        if len(args) != 1 or kwargs:
            return NotImplemented
        return args[0]._text() if isinstance(args[0], Text | Ranged) else checked(write(args[0]))

    return act


def _format(value: Any, spec: Any = "", /) -> Any:
    if is_stand_in(spec) or (is_stand_in(value) and spec[-1:] == "c"):
        stop(FORM_BY_VALUE)
    return value._text(spec) if isinstance(value, Text | Ranged) else checked(format(value, spec))


MAKES_TEXT: dict[Any, Callable[..., Any]] = {
    str: _text_of(str), repr: _text_of(repr), ascii: _text_of(ascii), format: _format,
}  # fmt: skip
"""Builtins that make text, each with the function that takes its place."""
_WRITES = {-1: lambda value: value, 97: MAKES_TEXT[ascii], 114: MAKES_TEXT[repr], 115: MAKES_TEXT[str]}


def _written(value: Any, conversion: int, spec: str) -> Any:
    if isinstance(value, Outside):
        value._used()
    return _format(_WRITES[conversion](value), spec)


def _text(*parts: Any) -> Any:
    tainted = next((p for p in parts if isinstance(p, Text)), None)
    return (
        "".join(parts)
        if tainted is None
        else Text(tainted._path, tainted._axis, "".join(str.__str__(p) for p in parts))
    )


def _percent(left: Any, right: Any) -> Any:
    parts = right if type(right) is tuple else (right,)
    if type(left) in (str, bytes) and any(map(may_hold_stand_in, parts)):
        found = next((p for p in parts if isinstance(p, Text | Ranged)), None)
        if _PERCENT_APART.search(repr(left).replace("%%", "")) and not all(
            isinstance(p, float) for p in parts
        ):  # floats raise TypeError
            stop(FORM_BY_VALUE)
        left % (tuple(map(_example, right)) if type(right) is tuple else _example(right))
        return stop("makes text of a range") if found is None else Text(found._path, found._axis, "text with a number")
    return checked(left % right)


def _among(left: Any, right: Any) -> bool:
    if isinstance(left, Text) and isinstance(right, str):
        stop("looks for the text of a number in other text")
    if isinstance(right, Outside):
        right._used()
    return left in right


VALUE_CHECKS: dict[str, Any] = {
    "__same__": _same, "__text__": _text, "__written__": _written, "__percent__": _percent, "__among__": _among,
    "__caught__": _caught, "__shown__": _shown, "__made__": _made, "__raised__": _raised, "__kinds__": _kinds, "__subject__": _subject,
    "__passed__": passed, "__doubtful__": DOUBTFUL,
}  # fmt: skip
"""By the names under which `source_checks` calls them."""
