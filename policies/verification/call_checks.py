"""The checks in an instrumented policy: at each place where plain Python would answer for a stand-in without asking it.

They let pure code through. Clocks, dice, files, identity and hashes raise `Reached`. What a search cannot follow raises
`Refused`. `instrument` puts them into the policy's source.
"""

from __future__ import annotations

import functools
import math
import re
import sys
import types
from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Callable
from enum import Enum
from string import Formatter
from typing import Any

from sortie.policies.verification.outside import Outside, Unknown
from sortie.policies.verification.pure import (
    IMPURE,
    PURE_MODULES,
    calls_others,
    cannot_call,
    foreign_method,
    home_of,
    is_others,
    is_own_cache,
    is_trusted,
    may_write,
    reads_stored_text,
    takes_ranges,
)
from sortie.policies.verification.stand_ins import FOR_USER
from sortie.policies.verification.symbols import MARK, Ranged, Text
from sortie.policies.verification.watch import (
    WATCH,
    Unordered,
    UnorderedFrozen,
    ordered_for,
    reach,
    stop,
    unordered,
)
from sortie.scenarios.plugins.user_code import is_users

STAND_INS = (
    "sortie.policies.verification.symbols",
    "sortie.policies.verification.ranges",
    "sortie.policies.verification.stand_ins",
    "sortie.policies.verification.solver",
)


def _is_stand_in(value: object) -> bool:
    return type(value).__module__ in STAND_INS


def _called(function: Any, /, *args: Any, **kwargs: Any) -> Any:
    """A call of the policy's code."""
    if isinstance(function, Outside):
        function._used()
    if isinstance(function, Written):
        function = function._write
    why = cannot_call(function)
    if why is not None:
        reach(why[1:]) if why.startswith("!") else stop(why)
    if type(function) is types.FunctionType and is_users(function.__module__):
        return function(*args, **kwargs)
    return on_behalf_of_the_policy(function, args, kwargs)


def on_behalf_of_the_policy(function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Call something that is not the policy's own code, with arguments that it treats as it would treat real ones."""
    for value in (*args, *kwargs.values()):
        if isinstance(value, Outside):
            value._used()
        if not callable(value) or function in (isinstance, issubclass):
            continue
        if (why := cannot_call(value)) is not None:
            reach(why[1:]) if why.startswith("!") else stop(why)
        if (
            value is type
            or calls_others(value)
            or is_own_cache(value)
            or (may_write(value) and function is not functools.partial)
            or (reads_stored_text(value) and not (value is int and function is map and len(args) == 2))
        ):
            stop(f"hands on {getattr(value, '__qualname__', value)}")
    args, kwargs = ordered_for(function, args, kwargs)
    if calls_others(function) or "key" in kwargs:
        args = tuple([WRITTEN["str"] if value is str else value for value in args])
        kwargs = {name: WRITTEN["str"] if value is str else value for name, value in kwargs.items()}
    owner = getattr(function, "__self__", None)
    has_text = any(map(_has_text, (*args, *kwargs.values())))
    reads = reads_stored_text(function) and function is not int and type(owner) is not str  # of which below
    if has_text and (reads or not takes_ranges(function)):
        stop(f"gives a range to {getattr(function, '__qualname__', function)}")
    if function in (functools.wraps, functools.update_wrapper) and any(map(_is_compiled, (*args, *kwargs.values()))):
        stop("takes over the name of a function that is not its own")
    if may_write(function):
        _writes(function, args, kwargs)
    if has_text and function is int and len(args) + len(kwargs) > 1:
        stop("reads a number in the text of a range")
    if function in (isinstance, issubclass) and len(args) == 2 and (why := _cannot_ask(args[1])):
        stop(why)
    special = _SPECIAL.get(function) if isinstance(function, type | types.BuiltinFunctionType) else None
    if special is not None and (found := special(*args, **kwargs)) is not NotImplemented:
        return found
    if type(owner) is str and (has_text or function.__name__ in ("format", "format_map")):
        return _stands_for_text(function, args, kwargs)
    return _checked(function(*args, **kwargs))


def _writes(function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
    """Refuse a call by which something else than the policy's own gets attributes, which last until the next decision."""
    while isinstance(function, functools.partial):
        function, args, kwargs = function.func, (*function.args, *args), {**function.keywords, **kwargs}
    given = (*args, *kwargs.values())
    if function is functools.update_wrapper:
        usual = {"assigned": functools.WRAPPER_ASSIGNMENTS, "updated": functools.WRAPPER_UPDATES}
        wrapped = kwargs.get("wrapped", args[-1] if args else None)
        if len(args) > 2 or any(kwargs.get(n, of) is not of for n, of in usual.items()) or not callable(wrapped):
            stop("takes over other attributes than those of a function")
        given = (args[0] if args else kwargs.get("wrapper"),)
    for value in given:
        if is_others(value):
            stop(
                f"gives {getattr(value, '__name__', type(value).__name__)}, which is not its own, to {function.__qualname__}"
            )


def _checked(found: Any) -> Any:
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


def _made(kind: Any) -> Any:
    """A class as it is, if all that Python calls by its special names is the policy's own code."""
    if isinstance(kind, type) and is_users(home_of(kind)) and (name := foreign_method(kind)) is not None:
        stop(f"has compiled code as {name} of {kind.__name__}")
    return kind


_STAND_IN_NAMES = re.compile(
    r"\b(Ranged|Solved|Text|Flags|TargetIds|Space|Unsearchable|InAnyOrder|DescriptorOfRanges|ViewOfRanges|Unordered\w*"
    r"|Written|Outside|Unknown|_sum)\b|<locals>"
)
"""In the text of an error that real objects raise with another text."""


def _shown() -> None:
    """A policy can look at the present error."""
    parts: list[Any] = [sys.exc_info()[1]]
    while parts:
        error = parts.pop()
        if isinstance(error, BaseExceptionGroup):
            parts += error.exceptions
        elif error is not None:
            last = error.__traceback__
            while last is not None and last.tb_next is not None:
                last = last.tb_next
            home = "" if last is None else last.tb_frame.f_globals.get("__name__")
            if home in STAND_INS or any(type(a) is str and _STAND_IN_NAMES.search(a) for a in error.args):
                stop("looks at an error whose text is another one in flight")


def _caught() -> None:
    error = sys.exc_info()[1]
    if isinstance(error, BaseExceptionGroup):
        error = error.subgroup((RecursionError, MemoryError))
    if isinstance(error, RecursionError | MemoryError | BaseExceptionGroup):
        stop("goes on after the end of the stack or of the memory")


assert on_behalf_of_the_policy.__name__ == FOR_USER  # noqa: S101


def _is_compiled(value: Any) -> bool:
    """Whether this is a function whose name or kind may be another than that of the real one."""
    return callable(value) and not isinstance(value, type | types.FunctionType) and not _is_users_own(value)


def _cannot_ask(kinds: Any) -> str | None:
    """Why a search cannot ask whether something is an instance of these."""
    if isinstance(kinds, tuple):
        return next((why for kind in kinds if (why := _cannot_ask(kind))), None)
    if isinstance(kinds, types.UnionType) or getattr(kinds, "__module__", "") in ("numbers", "collections.abc"):
        return None
    return cannot_call(kinds)


def _has_text(value: Any) -> bool:
    if type(value) in (list, tuple):
        return any(map(_has_text, value))
    return _is_stand_in(value) or isinstance(value, types.GeneratorType | map | filter)


def _stands_for_text(function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
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
    found = next((part for part in parts if _is_stand_in(part)), None)
    if found is None:
        return _checked(function(*args, **kwargs))
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
        if one is None or one is NotImplemented or one is Ellipsis or isinstance(one, bool | Enum | type):
            return a is b
    if _is_stand_in(a) or _is_stand_in(b) or isinstance(a, _VALUES) or isinstance(b, _VALUES):
        reach("the identity of a value (`is`)")
    return a is b


_VALUES = (int, float, str, bytes, tuple, frozenset)


def _example(value: Any) -> Any:
    return value._example() if isinstance(value, Text | Ranged) else value


def _text_of(write: Callable[[Any], str]) -> Callable[..., Any]:
    def act(*args: Any, **kwargs: Any) -> Any:
        if len(args) != 1 or kwargs:
            return NotImplemented
        return args[0]._text() if isinstance(args[0], Text | Ranged) else _checked(write(args[0]))

    return act


def _format(value: Any, spec: Any = "", /) -> Any:
    if _is_stand_in(spec) or (_is_stand_in(value) and spec[-1:] == "c"):
        stop(FORM_BY_VALUE)
    return value._text(spec) if isinstance(value, Text | Ranged) else _checked(format(value, spec))


_WRITES = {-1: lambda value: value, 97: _text_of(ascii), 114: _text_of(repr), 115: _text_of(str)}


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
    if type(left) in (str, bytes) and any(map(_has_text, parts)):
        found = next((p for p in parts if isinstance(p, Text | Ranged)), None)
        if _PERCENT_APART.search(repr(left).replace("%%", "")) and not all(
            isinstance(p, float) for p in parts
        ):  # floats raise TypeError
            stop(FORM_BY_VALUE)
        left % (tuple(map(_example, right)) if type(right) is tuple else _example(right))
        return stop("makes text of a range") if found is None else Text(found._path, found._axis, "text with a number")
    return _checked(left % right)


def _among(left: Any, right: Any) -> bool:
    if isinstance(left, Text) and isinstance(right, str):
        stop("looks for the text of a number in other text")
    if isinstance(right, Outside):
        right._used()
    return left in right


def _own(owner: Any, name: str) -> Any:
    """What an attribute may be assigned to: an object of the policy's own classes."""
    if isinstance(owner, type) or not is_users(home_of(type(owner))):
        if _is_stand_in(owner) or isinstance(owner, tuple):
            return owner  # raises what the real object raises
        stop(f"assigns to {name} of a {type(owner).__name__}")
    return owner


_LASTS_UNCHANGED = (int, float, str, bytes, types.ModuleType, Enum)
_PLAIN_PRIVATE = {"_replace", "_asdict", "_fields", "__class__"}
_OF_OWN_CLASSES = {"__init__", "__post_init__"}
"""A policy may call these of its own classes and of what they are derived from."""


def attribute(owner: Any, name: str) -> Any:
    if isinstance(owner, Outside):
        return Outside(f"{owner._path}.{name}")
    if name[0] == "_" and not _may_read(owner, name):
        stop(f"reads {name}")
    if name == "__class__" and (kind := _type_of(owner)) is not NotImplemented:
        return kind
    if isinstance(owner, types.ModuleType) and not is_users(owner.__name__):
        found = getattr(owner, name)
        if any(found is kind for kind in _FUNCTIONS):
            stop(KIND_OF_FUNCTION)
        if (
            isinstance(found, types.ModuleType)
            and found.__name__.partition(".")[0] not in PURE_MODULES
            and not is_trusted(found.__name__)
        ):
            return Outside(found.__name__)
        if f"{owner.__name__}.{name}" in IMPURE:
            return Outside(f"{owner.__name__}.{name}")
        if not isinstance(found, _LASTS_UNCHANGED) and not callable(found):
            WATCH.sees(f"{owner.__name__}.{name}", found)
        return guarded(found)
    found = getattr(owner, name)
    return _checked(found) if isinstance(owner, BaseException) and name == "args" else found


_FUNCTIONS = (
    types.FunctionType, types.MethodType, types.BuiltinFunctionType, types.MethodWrapperType, types.WrapperDescriptorType,
    types.MethodDescriptorType, types.ClassMethodDescriptorType,
)  # fmt: skip
KIND_OF_FUNCTION = "asks what kind of function something is"
"""Which a check or a stand-in's method is not: Python functions stand for compiled ones."""


def _may_read(owner: Any, name: str) -> bool:
    """Whether an attribute with a leading underscore is the same of a stand-in as of the real object."""
    if name in _OF_OWN_CLASSES:
        return type(owner) is super or _is_users_own(owner)
    if name == "__name__":
        return isinstance(owner, type | types.ModuleType | types.FunctionType) or _is_users_own(owner)
    return name in _PLAIN_PRIVATE or (name[:2] != "__" and _is_users_own(owner))


def guarded(found: Any) -> Any:
    """A function that a policy may not call as one that says so, whoever calls it; anything else as it is."""
    if isinstance(found, type) or not callable(found) or (why := cannot_call(found)) is None:
        return found
    return Outside(why[1:]) if why[0] == "!" else Unknown(why)


def _is_users_own(owner: Any) -> bool:
    if type(owner) is types.ModuleType:
        return is_users(owner.__name__)
    return is_users(home_of(owner if isinstance(owner, type) else type(owner)))


def _decorator(found: Any) -> Any:
    return functools.partial(_called, found)


def _each(iterable: Any) -> Any:
    if isinstance(iterable, Outside):
        iterable._used()
    if isinstance(iterable, map | filter | zip | enumerate) or type(iterable).__module__ == "itertools":
        return map(_checked, iterable)  # what compiled code makes there, no other check would see
    return unordered(iterable)


def _type_of(*args: Any, **kwargs: Any) -> Any:
    if len(args) == 1 and (_is_compiled(args[0]) or isinstance(args[0], types.FunctionType)):
        stop(KIND_OF_FUNCTION)
    if len(args) == 1 and (_is_stand_in(args[0]) or isinstance(args[0], Unordered | UnorderedFrozen)):
        return args[0].__class__
    return NotImplemented


def _rounding(how: str) -> Callable[..., Any]:
    def act(*args: Any, **kwargs: Any) -> Any:
        if len(args) == 1 and not kwargs and isinstance(args[0], Ranged) and type(args[0]).__name__ == "Ranged":
            return args[0]._rounded(how)
        return NotImplemented

    return act


def _float(*args: Any) -> Any:
    x = args[0] if len(args) == 1 else None
    return x if isinstance(x, Ranged) and isinstance(x, float) else NotImplemented


def _sum(items: Any, /, start: Any = 0) -> Any:
    listed = list(_each(items))
    found = sum(listed, start)
    floats = len(listed) + (type(start) is not int or start != 0)
    # Two floats have the same sum either way, and the solver follows combined inputs without rounding.
    if sys.version_info >= (3, 12) and floats > 2 and type(found).__name__ == "Ranged":
        stop("adds up floats with sum(…), which compensates rounding")
    return found


def _plain_sorted(*args: Any, **kwargs: Any) -> Any:
    if len(args) == 1 and not kwargs and isinstance(args[0], types.MappingProxyType):
        ids = _sorted_ids(args[0])
        return NotImplemented if ids is None else ids
    return NotImplemented


def _sorted_ids(mapping: Any) -> Any:
    """Ids in ascending order, whatever order the mapping has them in."""
    return sorted(mapping)


def _finite(answer: bool) -> Callable[..., Any]:
    return lambda *args: answer if len(args) == 1 and isinstance(args[0], Ranged) else NotImplemented


_SPECIAL: dict[Any, Callable[..., Any]] = {
    type: _type_of, float: _float, int: _rounding("int"), round: _rounding("round"), math.floor: _rounding("floor"),
    math.ceil: _rounding("ceil"), math.trunc: _rounding("int"), math.sqrt: _rounding("sqrt"), sum: _sum,
    str: _text_of(str), repr: _text_of(repr), ascii: _text_of(ascii), format: _format, sorted: _plain_sorted, math.isfinite: _finite(True), math.isnan: _finite(False), math.isinf: _finite(False),
}  # fmt: skip


class Written:
    """A builtin that makes text, with the checks that a call by its name has."""

    def __init__(self, write: Any) -> None:
        self._write = write

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return on_behalf_of_the_policy(self._write, args, kwargs)


WRITTEN = {write.__name__: Written(write) for write in (repr, ascii, format, str)}
CHECKS: dict[str, Any] = {
    "__called__": _called, "__same__": _same, "__text__": _text, "__written__": _written, "__percent__": _percent,
    "__own__": _own, "__attribute__": attribute, "__decorator__": _decorator, "__each__": _each, "__among__": _among,
    "__unordered__": unordered, "__caught__": _caught, "__shown__": _shown, "__made__": _made,
}  # fmt: skip
"""By the names under which `source_checks` calls them."""
