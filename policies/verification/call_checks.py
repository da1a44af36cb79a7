"""The checks on calls and attributes in an instrumented policy, where plain Python would answer for a stand-in.

They let pure code through (`pure`). Clocks, dice, files and hashes raise `Reached`. What a search cannot follow raises
`Refused`. `instrument` puts them, and those of `value_checks`, into the policy's source.
"""

from __future__ import annotations

import collections
import dataclasses
import functools
import math
import sys
import types
from abc import abstractmethod
from collections.abc import Callable, Iterator
from enum import Enum, EnumType
from typing import Any

from sortie.policies.contract import boxes_across_networks, looks_from
from sortie.policies.registry import POLICIES
from sortie.policies.verification.outside import Outside, Unknown
from sortie.policies.verification.pure import (
    IMPURE,
    MADE,
    NAMED,
    OF_SORTIES,
    ONLY_TYPES,
    PURE_MODULES,
    TABLES,
    calls_others,
    cannot_call,
    home_of,
    is_of_policies,
    may_read,
    reads_stored_text,
    runs_sorties_code,
    shown_class,
    takes_ranges,
)
from sortie.policies.verification.stand_ins import SORTS, InAnyOrder
from sortie.policies.verification.symbols import Ranged
from sortie.policies.verification.value_checks import (
    VALUE_CHECKS,
    are_plain,
    cannot_ask,
    checked,
    is_stand_in,
    join,
    text_of,
    with_texts,
)
from sortie.policies.verification.watch import WATCH, ordered_for, plain_set, reach, stop, unordered
from sortie.scenarios.plain_sum import plain_sum
from sortie.scenarios.plugins.user_code import is_users


def _called(function: Any, /, *args: Any, **kwargs: Any) -> Any:
    """A call of the policy's code."""
    _refuse_others(function)
    if isinstance(function, EnumType) and (len(args) != 1 or kwargs):
        stop(f"makes an enum by a call of {function.__name__}")
    if _decorates(function) and not _makes_decorator(function, args):
        stop("decorates by a call")  # something that may be older than this decision
    if _is_own_code(function):
        return function(*args, **kwargs)
    return on_behalf_of_the_policy(function, args, kwargs)


def _is_own_code(function: Any) -> bool:
    """Whether a call runs the policy's own code, which has checks, or makes an object of its own class."""
    while type(function) is types.MethodType:
        function = function.__func__
    if type(function) is types.FunctionType:
        return is_users(function.__globals__.get("__name__"))
    return is_users(home_of(function if isinstance(function, type) else type(function)))


def _refuse_others(function: Any) -> None:
    if isinstance(function, Outside):
        function._used()
    if not _decorates(function) and (why := cannot_call(function)) is not None:
        reach(why[1:]) if why.startswith("!") else stop(why)


def on_behalf_of_the_policy(function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Call something that is not the policy's own code, with arguments that it treats as it would treat real ones."""
    _refuse_to_hand_on(function, args, kwargs)
    args, kwargs = ordered_for(function, args, kwargs, _str)
    if _is_of_text(function) and function.__name__ == "join" and len(args) == 1 and not kwargs:
        return join(function, _texts_alone(list(args[0])))
    if not takes_ranges(function) and any(map(_is_lazy, args)):  # it may ask for a part, or in another order
        stop(f"gives something other than lists and tuples to {getattr(function, '__qualname__', function)}")
    if _is_of_text(function):  # what is lazy is asked here, not there
        args = tuple([list(value) if _is_lazy(value) else value for value in args])
    if function is plain_sum:
        args = tuple([list(value) if type(value) is types.GeneratorType else value for value in args])
    _refuse_arguments(function, args, kwargs)
    is_plain = isinstance(function, type | types.BuiltinFunctionType | types.FunctionType)
    special = _SPECIAL.get(function) if is_plain else None
    if special is not None and (found := special(*args, **kwargs)) is not NotImplemented:
        return found
    found = function(*args, **kwargs)
    return checked(with_texts(found) if runs_sorties_code(function) else found)


def _refuse_to_hand_on(function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
    """Functions that compiled code would call without a check."""
    for value in (*args, *kwargs.values()):
        if isinstance(value, Outside):
            value._used()
        if not callable(value) or function is isinstance or _decorates(function):  # see `_refuse_foreign`
            continue
        _refuse_others(value)
        is_known = value in (isinstance, type, sum) or calls_others(value)
        makes = function in (collections.defaultdict, dataclasses.field) or (function is map and len(args) == 2)
        reads = reads_stored_text(value) and not (value is int and makes)
        others = runs_sorties_code(value) and not is_stand_in(getattr(value, "__self__", None))
        if is_known or reads or others or _decorates(value):
            stop(f"hands on {getattr(value, '__qualname__', value)}")


def _refuse_arguments(function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
    """Arguments whose stand-ins would be treated otherwise than the real objects."""
    given, name = (*args, *kwargs.values()), getattr(function, "__qualname__", function)
    if (_is_of_text(function) or not takes_ranges(function)) and not are_plain(given):
        stop(f"gives more than plain numbers and texts to {name}")
    if function in (ord, int) and not all(isinstance(value, Ranged) or are_plain([value]) for value in given):
        stop(f"reads what {name} is given")
    if function is int and any(type(value) is str and len(value) > _LONGEST_TEXT for value in given):
        stop("reads a number in a long text")
    if runs_sorties_code(function) and not all(map(_is_for_sortie, given)):
        stop(f"gives more than numbers, texts, lists, tuples and Sortie's objects to {name}")
    if function in POLICIES.values() and not are_plain(kwargs.values()):
        stop(f"gives {name} a parameter that is no plain number")  # it may use its text
    if function is isinstance and len(args) == 2 and (why := cannot_ask(args[1])):
        stop(why)
    if _decorates(function):
        if kwargs and function is not dataclasses.dataclass:
            stop("gives a decorator more than what it decorates")
        _refuse_foreign(function, args)


def _is_of_text(function: Any) -> bool:
    return type(getattr(function, "__self__", None)) is str


_LONGEST_TEXT = 600
"""Of a number; Python's settings decide from where on it is an error."""


def _texts_alone(items: list[Any]) -> list[Any]:
    """The items; raises what `join` raises if one of them is no text."""
    if not all(issubclass(shown_class(item), str) for item in items):
        "".join([0])  # type: ignore[list-item]
    return items


def _is_lazy(value: Any) -> bool:
    """Whether what a value yields is worked out when somebody asks for it, or by whoever asks."""
    return not isinstance(value, str | bytes) and hasattr(type(value), "__iter__") and type(value) not in (list, tuple)


def _is_for_sortie(value: Any) -> bool:
    """Whether Sortie's functions may be given this: they go through it, and write it, as they like."""
    kind = type(value)
    if kind in (list, tuple, *MADE):
        return all(map(_is_for_sortie, value))
    return are_plain([value]) or kind in OF_SORTIES or (is_stand_in(value) and kind is not InAnyOrder)


def _str(*args: Any) -> Any:
    """`str`, where compiled code calls it."""
    return on_behalf_of_the_policy(str, args, {})


_DECORATORS = (dataclasses.dataclass, functools.wraps, abstractmethod, looks_from, boxes_across_networks)
_MADE_BY_THEM = {dataclasses.dataclass().__code__, looks_from(lambda _: None).__code__}


def _decorates(function: Any) -> bool:
    """Whether this is a decorator that sets attributes, or what one with arguments returns."""
    if type(function) is functools.partial:
        return function.func is functools.update_wrapper  # which `wraps` alone makes
    return function in _DECORATORS or getattr(function, "__code__", None) in _MADE_BY_THEM


def _makes_decorator(function: Any, args: tuple[Any, ...]) -> bool:
    """Whether a call of a decorator only gives it what it is to do: `dataclass(frozen=True)`, `wraps(f)`, `looks_from(f)`."""
    return function is functools.wraps or function is looks_from or (function is dataclasses.dataclass and not args)


def _refuse_foreign(decorate: Any, given: tuple[Any, ...]) -> None:
    """A decorator may change nothing but the policy's own: that would last until the next decision."""
    for value in given:
        own = _home_of_function(value) if type(value) is types.FunctionType else None
        is_class = isinstance(value, type) and (
            decorate is dataclasses.dataclass or type(decorate) is types.FunctionType
        )
        if not is_users(home_of(value) if is_class else own):
            stop(f"gives something that is not its own to {getattr(decorate, '__name__', 'a decorator')}")


def _home_of_function(function: Any) -> Any:
    """The module of a function; of one that `_across_networks` made that of the policy's function in it."""
    inner = getattr(function, "__wrapped__", None)
    if type(inner) is types.FunctionType and inner.__globals__ is globals():
        return _home_of_function(inner.__wrapped__)  # type: ignore[attr-defined]
    return function.__globals__.get("__name__")


def _own(owner: Any, name: str) -> Any:
    """What an attribute may be assigned to: an object of the policy's own classes."""
    if isinstance(owner, type | Enum) or not is_users(home_of(type(owner))):
        if issubclass(type(owner), tuple) and (name[0] != "_" or not is_stand_in(owner)):
            return owner  # raises what the real object raises
        stop(f"assigns to {name} of a {type(owner).__name__}")
    return owner


_LASTS_UNCHANGED = (int, float, str, bytes, Enum)


def attribute(owner: Any, name: str) -> Any:
    """An attribute that the policy reads, if that of a stand-in is like that of the real object."""
    kind = type(owner)
    if isinstance(owner, Outside):
        return type(owner)(f"{owner._path}.{name}")
    if kind is super:
        return _of_base(owner, name)
    if kind is types.ModuleType:
        return getattr(owner, name) if is_users(owner.__name__) else _of_module(owner, name)
    real = shown_class(owner)
    if is_stand_in(owner) and not hasattr(real, name):
        raise AttributeError(f"'{real.__name__}' object has no attribute '{name}'")
    if not _may_read(owner, name) and hasattr(owner, name):
        is_format = kind is str and name[:6] == "format"
        stop("writes text with str.format" if is_format else f"reads {name} of a {real.__name__}")
    return getattr(owner, name)


def _may_read(owner: Any, name: str) -> bool:
    if isinstance(owner, type):
        if owner is dict or home_of(owner) == "itertools":
            return name in ("fromkeys", "from_iterable")
        own = any(name in vars(base) for base in owner.__mro__ if is_users(home_of(base)))
        return own or name in vars(owner).get("_member_map_", ())
    return is_users(home_of(type(owner))) or may_read(owner, name)


def _of_base(owner: Any, name: str) -> Any:
    """A method of a base class (`super().name`)."""
    mro = owner.__self_class__.__mro__
    bases = mro[mro.index(owner.__thisclass__) + 1 :]
    if name not in ("__init__", "__post_init__") and not any(name in vars(b) for b in bases if is_users(home_of(b))):
        stop(f"reads {name} of a base class that is not its own")
    return getattr(owner, name)


def _of_module(module: types.ModuleType, name: str) -> Any:
    """A name of a module that is not the policy's."""
    home, path = module.__name__, f"{module.__name__}.{name}"
    found = getattr(module, name)
    if name in NAMED.get(home, ()):
        return found
    if isinstance(found, types.ModuleType):
        known = found.__name__ == path and (path in NAMED or path in ONLY_TYPES or is_of_policies(path))
        return found if known else Outside(found.__name__)
    if name[0] == "_":
        return Unknown(f"reads {path}")
    if home in ONLY_TYPES:
        is_type = isinstance(found, type | bool) or home_of(type(found)) == "typing"
        return guarded(found) if is_type else Unknown(f"reads {path}")
    if is_of_policies(home):
        if isinstance(found, _LASTS_UNCHANGED) or callable(found):
            return guarded(found)
        if name not in TABLES:
            return Unknown(f"reads {path}")
        WATCH.sees(path, found)
        return found
    if home in NAMED and isinstance(found, _LASTS_UNCHANGED):
        return found
    return Unknown(f"calls {path}") if home in PURE_MODULES and path not in IMPURE else Outside(path)


def guarded(found: Any) -> Any:
    """A function that a policy may not call as one that says so, whoever calls it; anything else as it is."""
    is_type = isinstance(found, type) or home_of(type(found)) == "typing"  # which may stand in annotations
    if is_type or not callable(found) or (why := cannot_call(found)) is None:
        return found
    return Outside(why[1:]) if why[0] == "!" else Unknown(why)


def _decorator(found: Any, is_first: bool) -> Any:
    """A decorator where it stands. The first one is given what has just been made; another one may be given something older."""

    def decorate(made: Any) -> Any:
        if not _decorates(found):
            return _called(found, made)
        if not (is_first or WATCH.is_loading):
            stop("decorates what another decorator returns")
        return on_behalf_of_the_policy(found, (made,), {})

    return decorate


def _each(iterable: Any) -> Any:
    if isinstance(iterable, Outside):
        iterable._used()
    if isinstance(iterable, map | filter | zip | enumerate) or type(iterable).__module__ == "itertools":
        return map(checked, iterable)  # what compiled code makes there, no other check would see
    return unordered(iterable)


def _rounding(how: str) -> Callable[..., Any]:
    def act(*args: Any, **kwargs: Any) -> Any:
        if len(args) == 1 and not kwargs and isinstance(args[0], Ranged) and type(args[0]).__name__ == "Ranged":
            return args[0]._rounded(how)
        return NotImplemented

    return act


def _type_of(*args: Any, **kwargs: Any) -> Any:
    if len(args) != 1 or kwargs:
        stop("makes a class by type(…)")
    if callable(args[0]) and not isinstance(args[0], type):
        stop("asks what kind of function something is")  # Python functions stand for compiled ones
    if hasattr(type(args[0]), "__next__"):
        stop("asks what kind of iterator something is")  # another one may stand for it
    return shown_class(args[0])


def _float(*args: Any) -> Any:
    x = args[0] if len(args) == 1 else None
    return x if isinstance(x, Ranged) and isinstance(x, float) else NotImplemented


COMPENSATES = sys.version_info >= (3, 12)
"""Whether `sum` compensates the rounding of floats in this Python."""


def _sum(items: Any, /, start: Any = 0) -> Any:
    listed: list[Any] = []

    def asked() -> Iterator[Any]:  # one by one, as `sum` does
        for item in _each(items):
            listed.append(item)
            yield item

    found = sum(asked(), start)
    floats = len(listed) + (type(start) is not int or start != 0)
    over_reals = isinstance(found, Ranged) and not found._path.exact  # without rounding, as the verdict says
    # Two floats have the same sum either way.
    if COMPENSATES and floats > 2 and not over_reals and any(map(is_stand_in, (*listed, found))):
        stop("adds up floats with sum(…), which compensates rounding")
    if COMPENSATES and over_reals:
        return found._made(found._term, lambda first, *rest: sum(rest, first), (start, *listed), found._most)
    return found


def _plain_sorted(*args: Any, **kwargs: Any) -> Any:
    if len(args) == 1 and not kwargs and isinstance(args[0], types.MappingProxyType):
        ids = _sorted_ids(args[0])
        return NotImplemented if ids is None else ids
    return NotImplemented


def _sorted_ids(mapping: Any) -> Any:
    """Ids in ascending order, whatever order the mapping has them in."""
    return sorted(mapping)


def _across_networks(policy: Any) -> Any:
    """The decorator, around a function of the policy's that gives Sortie's code nothing but what is listed."""

    @functools.wraps(policy)
    def decide(*args: Any, **kwargs: Any) -> Any:
        found = policy(*args, **kwargs)
        if not _is_for_sortie(found):
            stop("returns more than directives to boxes_across_networks")
        return found

    return boxes_across_networks(decide)


def _finite(answer: bool) -> Callable[..., Any]:
    return lambda *args: answer if len(args) == 1 and isinstance(args[0], Ranged) else NotImplemented


assert _sorted_ids.__name__ == SORTS  # noqa: S101
_SPECIAL: dict[Any, Callable[..., Any]] = {
    type: _type_of, float: _float, int: _rounding("int"), round: _rounding("round"), math.floor: _rounding("floor"),
    math.ceil: _rounding("ceil"), math.trunc: _rounding("int"), math.sqrt: _rounding("sqrt"), sum: _sum,
    sorted: _plain_sorted, math.isfinite: _finite(True), math.isnan: _finite(False), math.isinf: _finite(False), str: text_of,
    boxes_across_networks: _across_networks,
}  # fmt: skip
CHECKS: dict[str, Any] = {
    "__called__": _called, "__own__": _own, "__attribute__": attribute, "__decorator__": _decorator, "__each__": _each,
    "__unordered__": unordered, "__plain_set__": plain_set, **VALUE_CHECKS,
}  # fmt: skip
"""By the names under which `source_checks` calls them."""
