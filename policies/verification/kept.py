"""What a policy keeps from one decision to the next: everything that its functions can reach and change."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import functools
import gc
import inspect
import operator
import re
import struct
import types
from collections.abc import Callable
from decimal import Decimal
from enum import Enum, Flag
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from sortie.policies.verification.pure import HEAP, flags_of, home_of, is_own_cache
from sortie.policies.verification.symbols import Refused
from sortie.scenarios.plugins.user_code import is_users, modules_with

_TUPLE_FIELD: Any = type(vars(NamedTuple("Named", [("x", int)]))["x"])
_LEAVES = (
    int, str, bytes, bool, type(None), type(Ellipsis), type(NotImplemented), Fraction,
    types.MethodDescriptorType, types.WrapperDescriptorType, _TUPLE_FIELD, types.CodeType,
    type(vars(dataclasses).get("_HAS_DEFAULT_FACTORY")), type(dataclasses.MISSING),
    types.GetSetDescriptorType, types.MemberDescriptorType, re.Pattern, np.dtype, np.ufunc,
)  # fmt: skip


_MRO: Any = vars(type)["__mro__"].__get__
_NAMES: Any = vars(type)["__dict__"].__get__
_PLACE_OF_DICT: Any = vars(type)["__dictoffset__"].__get__
"""As Python stores them, whatever a metaclass says."""


class Kept:
    """A policy's lasting objects as they were before its first decision."""

    def __init__(self, roots: Callable[[], dict[str, Any]]) -> None:
        self._roots = roots
        self._before = self._now()

    def _now(self) -> dict[str, Any]:
        return {name: fingerprint(value) for name, value in self._roots().items()}

    def changed(self) -> str:
        """What has changed since, in words; empty if nothing has."""
        now = self._now()
        if now == self._before:
            return ""
        return next(f"changes {name}" for name in now if now[name] != self._before.get(name))


def kept_by(function: Callable[..., Any], module: types.ModuleType) -> Kept:
    """The lasting objects of a policy: its modules' names, its defaults, its closure, its object's attributes.

    Modules that only a function imports are imported now, so that they are watched from the first decision on.

    Raises:
        Refused: one of them is of a kind that cannot be compared, such as an iterator, or a module does not load.
    """
    try:
        modules = modules_with(module)
    except Exception as error:
        raise Refused(f"imports a module that does not load: {error}") from error

    def roots() -> dict[str, Any]:
        others = {f"the module {m.__name__.partition('.')[2]}": m for m in modules.values() if m is not module}
        others.pop("the module ", None)  # their package, which holds no more than them
        own = {name: value for name, value in vars(module).items() if name[:2] != "__"}
        alone = {n: v for n, v in own.items() if type(v) is not types.ModuleType or not is_users(v.__name__)}
        return {**alone, "the policy itself": function, **others}

    return Kept(roots)


def fingerprint(value: Any) -> Any:
    """What is equal for an object as long as nothing in it has changed.

    Raises:
        Refused: it may change in a way that cannot be seen.
    """
    return _fingerprint(value, {})


def _fingerprint(value: Any, met: dict[int, tuple[int, Any]]) -> Any:
    kind = type(value)
    if kind is float:  # with the sign of NaN
        return "float", struct.pack("d", value)
    if kind is complex:
        return "complex", struct.pack("dd", value.real, value.imag)
    if issubclass(kind, np.generic) and not is_users(home_of(kind)) and not value.dtype.hasobject:
        return kind.__name__, value.tobytes()
    if kind in _LEAVES or issubclass(kind, np.ufunc):
        return kind.__name__, value
    if kind in (Decimal, range):  # equal ones may differ: 1.0 and 1, -0 and 0, empty ranges
        return kind.__name__, repr(value)
    if id(value) in met:
        return "again", met[id(value)][0]
    met[id(value)] = len(met), value  # kept, so that nothing made later gets its id
    if issubclass(kind, Enum) and not is_users(home_of(kind)):
        return kind.__name__, id(value)
    if kind is types.BuiltinFunctionType:  # a method of a list changes with the list
        owner = value.__self__
        of = owner.__name__ if isinstance(owner, types.ModuleType) else _fingerprint(owner, met)
        return kind.__name__, value.__name__, of
    if kind in (list, tuple) or (issubclass(kind, tuple) and not is_users(home_of(kind))):
        return kind.__name__, tuple([_fingerprint(v, met) for v in value])
    if kind is types.MappingProxyType:
        return kind.__name__, _fingerprint(gc.get_referents(value)[0], met)
    if kind in (dict, collections.OrderedDict, collections.defaultdict, collections.Counter):
        makes = _fingerprint(value.default_factory, met) if kind is collections.defaultdict else ()
        return kind.__name__, makes, tuple([(_fingerprint(k, met), _fingerprint(v, met)) for k, v in value.items()])
    if issubclass(kind, set | frozenset) and not is_users(home_of(kind)):
        members = [_fingerprint(v, met) for v in _members(value)]
        ordered = all(isinstance(v, int) for v in _members(value))  # by what was there before, and it may be seen
        return kind.__name__, tuple(members) if ordered else frozenset(members)
    if kind in (collections.deque, bytearray):
        return kind.__name__, getattr(value, "maxlen", None), tuple([_fingerprint(v, met) for v in value])
    if kind is np.ndarray and not value.dtype.hasobject:
        return "array", value.dtype.str, value.shape, value.tobytes()
    return kind.__name__, id(value), _parts(value, met)


def _members(value: Any) -> Any:
    """The members of a set, which may be one that watches its order."""
    return (set if issubclass(type(value), set) else frozenset).__iter__(value)


def _parts(value: Any, met: dict[int, tuple[int, Any]]) -> Any:
    """The changeable parts of a function, a class, a module or an object."""
    found: list[Any]
    kind = type(value)
    if is_users(home_of(kind)) and not issubclass(kind, type):
        found = _parts_of_users(value)
    elif issubclass(kind, types.FunctionType):
        is_others = not is_users(value.__globals__.get("__name__"))
        if is_others and not value.__dict__ and value.__closure__ is None:
            return ()
        cells = [c.cell_contents for c in value.__closure__ or () if _is_full(c)]
        found = [
            *cells,
            *(value.__defaults__ or ()),
            *(value.__kwdefaults__ or {}).values(),
            *(v for v in value.__dict__.values() if type(v) is not inspect.Signature),
            *(
                []
                if is_others
                else [value.__code__, value.__name__, value.__qualname__, value.__module__, value.__doc__]
            ),
            *([] if is_others else value.__annotations__.values()),
        ]
    elif issubclass(kind, types.ModuleType):
        found = [v for n, v in vars(value).items() if n[:2] != "__"] if is_users(value.__name__) else []
    elif issubclass(kind, type):
        if issubclass(value, Flag) and is_users(home_of(value)):
            _fill_cache(value)
        own = {n: v for n, v in _NAMES(value).items() if not _is_pythons(n, v)} if is_users(home_of(value)) else {}
        found = [*(x for item in own.items() for x in item), *(c for c in _MRO(value)[1:] if is_users(home_of(c)))]
        found += [kind] if is_users(home_of(kind)) else []
    elif issubclass(kind, functools.partial):
        found = [value.func, value.args, value.keywords]
    elif issubclass(kind, types.MethodType):
        found = [value.__func__, value.__self__]
    elif issubclass(kind, staticmethod | classmethod):
        found = [value.__func__]
    elif issubclass(kind, property):
        found = [value.fget, value.fset, value.fdel, value.__doc__]
    elif issubclass(kind, dataclasses.Field):
        found = [value.type, value.default, value.default_factory, value.metadata]
    elif issubclass(kind, operator.itemgetter):
        found = [value.__reduce__()]
    elif issubclass(kind, types.GenericAlias | types.UnionType) or home_of(kind) == "typing":
        found = [getattr(value, name, None) for name in _OF_ANNOTATIONS]
    elif home_of(kind) in _UNCHANGING or is_own_cache(value):
        found = []
    elif hasattr(value, "__wrapped__") or hasattr(value, "cache_info"):
        raise Refused("keeps results from one decision to the next (functools)")
    else:
        raise Refused(f"keeps a {kind.__name__} from one decision to the next")
    return tuple([_fingerprint(v, met) for v in found])


MOST_FLAGS = 8


def _fill_cache(kind: type[Flag]) -> None:
    """Make every member that `|` and `~` can make: Python keeps each one from its first use on, and that is no memory.

    A class with more than `MOST_FLAGS` flags, or that makes members itself, is left as it is.
    """
    flags: list[Flag] = list(kind.__members__.values())
    if len(flags) > MOST_FLAGS or kind._missing_.__func__ is not Flag._missing_.__func__:  # type: ignore[attr-defined]
        return
    values = {0}
    for flag in flags:
        values |= {value | flag.value for value in values}
    for value in values:
        with contextlib.suppress(ValueError):  # a boundary may forbid it
            Flag.__invert__(kind(value))


_BASES = (
    object, int, float, complex, str, bytes, bytearray, tuple, list, dict, collections.OrderedDict,
    collections.defaultdict, collections.deque, property, staticmethod, classmethod, types.ModuleType, Decimal,
)  # fmt: skip
"""Compiled classes that keep no more than their content and what their attributes show."""
_PLAIN: tuple[Any, ...] = (str, bytes, int, float, complex)
"""Of these, those with one plain value as their content."""


def _parts_of_users(value: Any) -> list[Any]:
    """What an object of the policy's own class keeps: its attributes, its content, and its class, reached through it alone.

    All is read as Python stores it, whatever the class's own methods and attributes say.
    """
    kind = type(value)
    if issubclass(kind, Flag):
        _fill_cache(kind)
    found = [x for item in _attributes(value).items() for x in item]
    for base in _MRO(kind):
        is_compiled = not flags_of(base) & HEAP
        if is_compiled and base not in _BASES and not issubclass(base, BaseException):
            raise Refused(f"keeps a {base.__name__} from one decision to the next")
        if base is not object and base not in _PLAIN:
            hidden = _ALWAYS_SHOWN if is_compiled else _OF_EVERY_CLASS
            shown = [of for n, of in _NAMES(base).items() if type(of) in _SHOWN and n not in hidden]
            found += [_stored(of, value) for of in shown]
    found += [plain.__getnewargs__(value) for plain in _PLAIN if issubclass(kind, plain)]
    if issubclass(kind, Decimal):
        found.append(Decimal.__str__(value))
    if issubclass(kind, dict):
        ordered: Any = collections.OrderedDict if issubclass(kind, collections.OrderedDict) else dict
        found += [x for key in ordered.__iter__(value) for x in (key, dict.__getitem__(value, key))]
    for base in (list, tuple, bytearray, collections.deque):
        if issubclass(kind, base):
            read: Any = base.__iter__
            found += read(value)
    return [kind, *found]


_OF_ANNOTATIONS = (
    "__origin__", "__args__", "__metadata__", "__bound__", "__constraints__", "__default__", "__supertype__", "__value__",
    "__forward_value__",
)  # fmt: skip
"""What an annotation holds, such as the types in `list[int]`. They need not be types."""
_UNCHANGING = {
    "__future__",
    "operator",
    *(f"sortie.policies.verification.{m}" for m in ("call_checks", "outside")),
}
"""Modules of classes that keep nothing that changes."""
_SHOWN = (types.MemberDescriptorType, types.GetSetDescriptorType)
_OF_EVERY_CLASS = {"__dict__", "__weakref__"}
_ALWAYS_SHOWN = _OF_EVERY_CLASS | {"__class__", "__traceback__", "__context__", "__cause__"}


def _attributes(value: Any) -> dict[str, Any]:
    """The dictionary of an object; empty where it has none."""
    kind = type(value)
    for base in _MRO(kind):
        of = _NAMES(base).get("__dict__")
        if type(of) in _SHOWN:
            found: dict[str, Any] = of.__get__(value)
            return found
    if _PLACE_OF_DICT(kind):
        raise Refused(f"keeps a {kind.__name__}, a class with a __dict__ of its own, from one decision to the next")
    return {}


def _stored(of: Any, value: Any) -> tuple[Any, ...]:
    """The content of a slot; nothing where it has none."""
    try:
        return (of.__get__(value),)
    except AttributeError:
        return ()


def _is_pythons(name: str, value: Any) -> bool:
    """Whether Python itself made this part of a class, and nothing in it can be changed."""
    if name == "__dataclass_params__":
        return home_of(type(value)) == "dataclasses"
    if name not in ("__annotate__", "__annotate_func__") or type(value) is not types.FunctionType:
        return False
    others = (value.__defaults__, value.__kwdefaults__, value.__dict__)
    return not any(others) and set(value.__code__.co_freevars) <= {"__classdict__"}


def _is_full(cell: types.CellType) -> bool:
    try:
        cell.cell_contents  # noqa: B018
    except ValueError:
        return False
    return True
