"""What a policy keeps from one decision to the next: everything that its functions can reach and change.

Objects of the kinds that plain Python (`plain`) can make are compared. A policy that keeps another one is refused.
"""

from __future__ import annotations

import collections
import dataclasses
import enum
import functools
import operator
import struct
import types
from collections.abc import Callable
from enum import Enum
from typing import Any, NamedTuple

from sortie.policies.verification.pure import home_of
from sortie.policies.verification.symbols import Refused
from sortie.scenarios.plugins.user_code import is_users, modules_with


class Kept:
    """A policy's lasting objects as they were before its first decision."""

    def __init__(self, roots: Callable[[], dict[str, Any]]) -> None:
        self._roots = roots
        self._before = self._now()

    def _now(self) -> dict[str, Any]:
        met: dict[int, tuple[int, Any]] = {}  # of all: two names may have the same object, or equal ones
        return {name: _fingerprint(value, met) for name, value in self._roots().items()}

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
        own = _named(module)
        alone = {n: v for n, v in own.items() if type(v) is not types.ModuleType or not is_users(v.__name__)}
        return {**alone, "the policy itself": function, **others}

    return Kept(roots)


def _named(owner: Any) -> dict[str, Any]:
    """What a module or a class has under names that a policy can read, and the class's methods."""
    return {n: value for n, value in vars(owner).items() if n[:2] != "__" or type(value) is types.FunctionType}


def fingerprint(value: Any) -> Any:
    """What is equal for an object as long as nothing in it has changed.

    Raises:
        Refused: it may change in a way that cannot be seen.
    """
    return _fingerprint(value, {})


_TUPLE_FIELD: Any = type(vars(NamedTuple("Named", [("x", int)]))["x"])
_SENTINELS = (type(dataclasses.MISSING), type(dataclasses.KW_ONLY), type(vars(dataclasses)["_HAS_DEFAULT_FACTORY"]))
_LEAVES = (
    *_SENTINELS,
    int,
    str,
    bytes,
    bool,
    type(None),
    type(Ellipsis),
    type(NotImplemented),
    _TUPLE_FIELD,
    types.MemberDescriptorType,
    types.WrapperDescriptorType,
)
_OF_TYPES = (types.GenericAlias, types.UnionType)
_DICTS = (dict, types.MappingProxyType, collections.OrderedDict, collections.defaultdict, collections.Counter)


def _fingerprint(value: Any, met: dict[int, tuple[int, Any]]) -> Any:
    kind = type(value)
    if kind is float:  # with the sign of zero and of NaN
        return "float", struct.pack("d", value)
    if kind in _LEAVES:
        return kind.__name__, value
    if kind is range:  # equal ones may differ: empty ranges
        return "range", repr(value)
    if id(value) in met:
        return "again", met[id(value)][0]
    met[id(value)] = len(met), value  # kept, so that nothing made later gets its id
    if issubclass(kind, Enum) and not is_users(home_of(kind)):
        return kind.__name__, id(value)
    if kind in (list, tuple) or (issubclass(kind, tuple) and not is_users(home_of(kind))):
        return kind.__name__, tuple([_fingerprint(v, met) for v in value])
    if kind is collections.deque:
        return kind.__name__, value.maxlen, tuple([_fingerprint(v, met) for v in value])
    if kind in _DICTS:
        makes = _fingerprint(value.default_factory, met) if kind is collections.defaultdict else ()
        return kind.__name__, makes, tuple([(_fingerprint(k, met), _fingerprint(v, met)) for k, v in value.items()])
    if issubclass(kind, set | frozenset) and not is_users(home_of(kind)):
        inside = list((set if issubclass(kind, set) else frozenset).__iter__(value))  # it may watch its order
        members = [_fingerprint(v, met) for v in inside]
        ordered = all(isinstance(v, int) for v in inside)  # by what was there before, and it may be seen
        return kind.__name__, tuple(members) if ordered else frozenset(members)
    if kind is types.BuiltinFunctionType:  # a method of a list changes with the list
        owner = value.__self__
        of = owner.__name__ if isinstance(owner, types.ModuleType) else _fingerprint(owner, met)
        return kind.__name__, value.__name__, of
    # an object that is gone may leave its place to one with other code or types
    itself = value.__code__ if kind is types.FunctionType else value if kind in _OF_TYPES else None
    return kind.__name__, id(value), itself, tuple([_fingerprint(v, met) for v in _parts(value)])


def _parts(value: Any) -> list[Any]:
    """The changeable parts of a function, a class, a module or an object."""
    kind = type(value)
    if kind is types.ModuleType:
        return list(_named(value).values()) if is_users(value.__name__) else []
    if isinstance(value, type):
        own = [base for base in value.__mro__ if is_users(home_of(base))]
        return [part for base in own for part in _named(base).values()]
    if is_users(home_of(kind)):
        return [kind, *_attributes(value), *(tuple.__iter__(value) if isinstance(value, tuple) else ())]
    if kind is types.FunctionType:
        cells = [cell.cell_contents for cell in value.__closure__ or () if _is_full(cell)]
        return [*cells, *(value.__defaults__ or ()), *(value.__kwdefaults__ or {}).values()]
    if kind is functools.partial:
        return [value.func, value.args, value.keywords]
    if kind is types.MethodType:
        return [value.__func__, value.__self__]
    if kind is staticmethod or kind is classmethod:
        return [value.__func__]
    if kind is property:
        return [value.fget, value.fset, value.fdel]
    if kind is operator.itemgetter:
        return [value.__reduce__()]
    if kind in (*_OF_TYPES, enum.property) or home_of(kind) in _UNCHANGING:
        return []
    raise Refused(f"keeps a {kind.__name__} from one decision to the next")


_UNCHANGING = {
    "__future__", "typing",
    *(f"sortie.policies.verification.{m}" for m in ("call_checks", "outside")),
}  # fmt: skip
"""Modules of classes that keep nothing that a policy can reach and change."""


def _attributes(value: Any) -> list[Any]:
    """What an object of the policy's own class keeps in its dictionary and in its slots, with its names."""
    found: list[Any] = [x for item in getattr(value, "__dict__", {}).items() for x in item]
    for base in type(value).__mro__:
        if is_users(home_of(base)):
            slots = [name for name, of in vars(base).items() if type(of) is types.MemberDescriptorType]
            found += [x for name in slots for x in (name, getattr(value, name, NotImplemented))]
    return found


def _is_full(cell: types.CellType) -> bool:
    try:
        cell.cell_contents  # noqa: B018
    except ValueError:
        return False
    return True
