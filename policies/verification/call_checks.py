"""The checks on calls and attributes in an instrumented policy, where plain Python would answer for a stand-in.

They let pure code through. Clocks, dice, files and hashes raise `Reached`. What a search cannot follow raises
`Refused`. `instrument` puts them, and those of `value_checks`, into the policy's source.
"""

from __future__ import annotations

import functools
import math
import sys
import types
from collections.abc import Callable
from enum import Enum, EnumType
from typing import Any

from sortie.policies.verification.outside import Outside, Unknown
from sortie.policies.verification.pure import (
    IMPURE,
    PURE_MODULES,
    calls_others,
    cannot_call,
    home_of,
    is_others,
    is_own_cache,
    is_trusted,
    may_write,
    reads_stored_text,
    takes_ranges,
)
from sortie.policies.verification.stand_ins import FOR_USER
from sortie.policies.verification.symbols import Ranged, Text
from sortie.policies.verification.value_checks import (
    DOUBTFUL,
    MAKES_TEXT,
    VALUE_CHECKS,
    cannot_ask,
    checked,
    is_stand_in,
    may_hold_stand_in,
    passed,
    stands_for_text,
)
from sortie.policies.verification.watch import WATCH, Unordered, UnorderedFrozen, ordered_for, reach, stop, unordered
from sortie.scenarios.plugins.user_code import is_users


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
    if (
        isinstance(function, types.MethodDescriptorType)
        and type(args[0] if args else None) is not function.__objclass__
    ):
        stop(f"calls {function.__qualname__} of something else")  # which may have a method of its own
    try:
        return on_behalf_of_the_policy(function, args, kwargs)
    except DOUBTFUL:  # a lambda may be called by compiled code that catches it
        passed()
        raise


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
            or value is isinstance
            or value is issubclass
            or isinstance(value, types.MethodDescriptorType)
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
    has_text = any(map(may_hold_stand_in, (*args, *kwargs.values())))
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
    if function is isinstance and len(args) == 2 and is_stand_in(args[0]) and (why := cannot_ask(args[1])):
        stop(why)
    special = _SPECIAL.get(function) if isinstance(function, type | types.BuiltinFunctionType) else None
    if special is not None and (found := special(*args, **kwargs)) is not NotImplemented:
        return found
    if type(owner) is str and (has_text or function.__name__ in ("format", "format_map")):
        return stands_for_text(function, args, kwargs)
    return checked(function(*args, **kwargs))


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


def _own(owner: Any, name: str) -> Any:
    """What an attribute may be assigned to: an object of the policy's own classes."""
    if isinstance(owner, type) or not is_users(home_of(type(owner))):
        if issubclass(type(owner), tuple) and (name[0] != "_" or not is_stand_in(owner)):
            return owner  # raises what the real object raises
        stop(f"assigns to {name} of a {type(owner).__name__}")
    return owner


_LASTS_UNCHANGED = (int, float, str, bytes, types.ModuleType, Enum)
_PLAIN_PRIVATE = {"_replace", "_asdict", "_fields", "__class__"}
_OF_OWN_CLASSES = {"__init__", "__post_init__"}
"""A policy may call these of its own classes and of what they are derived from."""


def attribute(owner: Any, name: str) -> Any:
    if isinstance(owner, Outside):
        if name[:2] == "__":
            owner._used()
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
    return checked(found) if isinstance(owner, BaseException) and name == "args" else found


def _own_kinds(*kinds: Any) -> None:
    """Classes in patterns that name attributes: an object of the policy's own class, by no rule of that class, has them."""
    if not all(type(kind) in (type, EnumType) and is_users(home_of(kind)) for kind in kinds):
        stop("matches an attribute that a search cannot follow")


def _pattern(root: Callable[[], Any], *path: str) -> None:
    """A dotted name in a pattern, which Python reads without a check: it must be a constant of a class or of a module."""
    try:
        found = root()
    except NameError:
        stop("matches a name that is not known yet")
    for name in path:
        if isinstance(found, types.ModuleType):
            found = attribute(found, name)
        elif type(found) is EnumType:
            found = found.__members__.get(name)
        elif type(found) is type:
            found = vars(found).get(name)
        else:
            stop("matches a dotted name that is no constant")
    if not isinstance(found, Enum | int | float | str | bytes) or is_stand_in(found):
        stop("matches a dotted name that is no constant")


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
        return map(checked, iterable)  # what compiled code makes there, no other check would see
    return unordered(iterable)


def _type_of(*args: Any, **kwargs: Any) -> Any:
    if len(args) == 1 and (_is_compiled(args[0]) or isinstance(args[0], types.FunctionType)):
        stop(KIND_OF_FUNCTION)
    if len(args) == 1 and (is_stand_in(args[0]) or isinstance(args[0], Unordered | UnorderedFrozen)):
        return str if type(args[0]) is Text else args[0].__class__
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
    sorted: _plain_sorted, math.isfinite: _finite(True), math.isnan: _finite(False), math.isinf: _finite(False), **MAKES_TEXT,
}  # fmt: skip


class Written:
    """A builtin that makes text, with the checks that a call by its name has."""

    def __init__(self, write: Any) -> None:
        self._write = write

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return on_behalf_of_the_policy(self._write, args, kwargs)


WRITTEN = {write.__name__: Written(write) for write in (repr, ascii, format, str)}
CHECKS: dict[str, Any] = {
    "__called__": _called, "__own__": _own, "__attribute__": attribute, "__decorator__": _decorator, "__each__": _each,
    "__unordered__": unordered, "__pattern__": _pattern, "__own_kinds__": _own_kinds, **VALUE_CHECKS,
}  # fmt: skip
"""By the names under which `source_checks` calls them."""
