"""What a policy's code may call while it is searched: functions whose results depend on their arguments alone."""

from __future__ import annotations

import abc
import bisect
import builtins
import collections
import dataclasses
import functools
import heapq
import itertools
import math
import operator
import random
import re
import statistics
import sys
import types
import typing
from enum import Enum
from typing import Any

from sortie.policies.contract import looks_from
from sortie.scenarios.plugins.user_code import PREFIX, is_users

PURE_MODULES = frozenset({
    "__future__", "abc", "bisect", "cmath", "collections", "contextlib", "copy", "dataclasses", "decimal", "enum",
    "fractions", "functools", "hashlib", "heapq", "itertools", "json", "math", "numbers", "numpy", "operator", "re", "statistics", "string",
    "types", "typing", "zlib",
})  # fmt: skip
"""Modules that may be imported. What is called is judged one by one."""
IMPURE = frozenset({
    "numpy.random", "numpy.datetime64", "numpy.load", "numpy.fromfile", "numpy.loadtxt", "numpy.genfromtxt",
    "numpy.memmap", "numpy.save", "numpy.empty", "statistics.random", "contextlib.chdir", "contextlib.os", "contextlib.sys",
    "contextlib.redirect_stdout", "contextlib.redirect_stderr",
})  # fmt: skip
_TRUSTED = (
    "sortie.policies.contract", "sortie.policies.geometry", "sortie.policies.catalogue", "sortie.scenarios.disc",
    "sortie.scenarios.link_state", "sortie.scenarios.plain_sum", "sortie.scenarios.representation",
)  # fmt: skip
_SEEDED = frozenset({"random.Random", "sortie.scenarios.streams.stream"})
"""Random draws that depend on their seed alone: allowed, but no search follows them."""
_OUTSIDE = {"print", "open", "input", "id", "hash", "breakpoint", "exit", "quit", "help"}
_BUILTINS = {
    getattr(builtins, name)
    for name in [
        "abs",
        "all",
        "any",
        "ascii",
        "bool",
        "bytes",
        "callable",
        "chr",
        "complex",
        "dict",
        "divmod",
        "enumerate",
        "filter",
        "float",
        "format",
        "frozenset",
        "int",
        "isinstance",
        "issubclass",
        "iter",
        "len",
        "list",
        "map",
        "max",
        "min",
        "next",
        "object",
        "ord",
        "pow",
        "property",
        "range",
        "repr",
        "reversed",
        "round",
        "set",
        "slice",
        "sorted",
        "staticmethod",
        "classmethod",
        "str",
        "sum",
        "super",
        "tuple",
        "type",
        "zip",
        "bytearray",
    ]
}
_PLAIN: tuple[Any, ...] = (
    list, dict, set, frozenset, str, bytes, bytearray, tuple, int, float, bool, complex, range, types.MappingProxyType,
    collections.deque, collections.Counter, collections.OrderedDict, collections.defaultdict, re.Pattern, re.Match,
    type({}.keys()), type({}.values()), type({}.items()),
)  # fmt: skip
_C_MODULES = frozenset({
    "math", "cmath", "operator", "_operator", "itertools", "_functools", "_bisect", "_heapq", "_collections", "zlib",
    "_hashlib", "_statistics", "_sha1", "_sha2", "_md5", "_blake2", "_sha256", "_sha512",
})  # fmt: skip
_PYTHON_MODULES = frozenset(
    {"statistics", "dataclasses", "functools", "enum", "heapq", "typing", "fractions", "re", "hashlib"}
)
_TYPE_MODULES = frozenset({"itertools", "collections", "enum", "typing", "decimal", "fractions", "abc", "numbers"})
_NOT = {
    operator.attrgetter: "operator.attrgetter", operator.methodcaller: "operator.methodcaller",
    operator.is_: "operator.is_", operator.is_not: "operator.is_not", functools.lru_cache: "functools.lru_cache",
    functools.cache: "functools.cache", functools.singledispatch: "functools.singledispatch",
    statistics.NormalDist: "statistics.NormalDist", typing.overload: "typing.overload",
    typing.get_overloads: "typing.get_overloads", typing.get_type_hints: "typing.get_type_hints",
    typing.runtime_checkable: "typing.runtime_checkable", getattr(operator, "call", None): "operator.call",
}  # fmt: skip
_OPEN_MODULES = frozenset(
    {"builtins", "math", "operator", "_operator", "itertools", "_functools", "_bisect", "_heapq", "_collections"}
)


HEAP = 1 << 9
"""Of a class's `__flags__`: it was made while Python ran."""
flags_of: Any = vars(type)["__flags__"].__get__
_QUALNAME: Any = vars(type)["__qualname__"].__get__
"""As Python stores them, whatever a metaclass says."""


def home_of(kind: type) -> str:
    """The module of a class. One that is not found there is the policy's own, whatever its `__module__` says."""
    home = str(type.__dict__["__module__"].__get__(kind))
    if not flags_of(kind) & HEAP or is_users(home):
        return home
    found: Any = sys.modules.get(home)
    for part in _QUALNAME(kind).split("."):
        found = getattr(found, part, None)
    return home if found is kind else PREFIX


def reads_stored_text(function: Any) -> bool:
    """Whether compiled code reads what is stored in a text, or the order of a set, without asking its methods."""
    if isinstance(function, types.MethodDescriptorType | types.ClassMethodDescriptorType):
        return function.__objclass__ in (str, bytes, bytearray, set, frozenset)
    if isinstance(function, type):
        return function in (bytes, bytearray, complex, int) or (
            issubclass(function, str | bytes) and function is not str
        )
    if type(function) is types.BuiltinFunctionType:
        return function in (ord, operator.contains, operator.concat, operator.iconcat) or type(function.__self__) in (
            str,
            bytes,
            bytearray,
        )
    return isinstance(function, functools.partial) and reads_stored_text(function.func)


CALL_OTHERS = (map, filter, functools.reduce, functools.partial)
"""Compiled code that calls what it is given; so does all of `itertools`."""


def calls_others(function: Any) -> bool:
    """Whether this is compiled code that calls other functions, which no check would see."""
    return function in CALL_OTHERS or (isinstance(function, type) and home_of(function) == "itertools")


_MAY_WRITE = frozenset({"abc", "dataclasses", "enum", "functools", "typing"})
_ONLY_READ = (
    functools.wraps, dataclasses.asdict, dataclasses.astuple, dataclasses.field, dataclasses.fields,
    dataclasses.is_dataclass, dataclasses.make_dataclass, dataclasses.replace, typing.cast, typing.get_args,
    typing.get_origin,
)  # fmt: skip


_MARKS = looks_from(lambda _: None).__code__


def may_write(function: Any) -> bool:
    """Whether this is a function that may set attributes of what it is given, as decorators do."""
    while isinstance(function, functools.partial):
        function = function.func
    if type(function) is not types.FunctionType:
        return False
    return function.__code__ is _MARKS or (function.__module__ in _MAY_WRITE and function not in _ONLY_READ)


def is_others(value: Any) -> bool:
    """Whether a value has attributes that can be set, and is not the policy's own."""
    if isinstance(value, types.FunctionType):
        return not is_users(str(value.__globals__.get("__name__")))
    if isinstance(value, types.ModuleType):
        return not is_users(value.__name__)
    kind = value if isinstance(value, type) else type(value)
    return bool(type(value).__dictoffset__) and not is_users(home_of(kind))


def foreign_method(kind: type) -> str | None:
    """The first method with a special name that Python would call without a check; None if the class has none."""
    for name, value in vars(kind).items():
        if isinstance(value, property):
            parts, special = [value.fget, value.fset, value.fdel], name[:2] == "__"
        else:
            parts, special = [getattr(value, "__func__", value)], False
        if special or any(map(_is_foreign, parts if isinstance(value, property) or name[:2] == "__" else ())):
            return name
    return None


_METHODS = (
    types.FunctionType, types.MethodType, types.WrapperDescriptorType, types.MethodDescriptorType, types.ClassMethodDescriptorType,
    types.GetSetDescriptorType, types.MemberDescriptorType,
)  # fmt: skip


def _is_foreign(value: Any) -> bool:
    kind = type(value)
    if kind in _METHODS or (kind is types.BuiltinFunctionType and value.__name__ == "__new__"):
        return False
    return hasattr(kind, "__get__") or (callable(value) and (isinstance(value, type) or not is_users(home_of(kind))))


def is_trusted(home: str) -> bool:
    """Whether a module is one of Sortie's that policies are made of."""
    return home in ("sortie", "sortie.policies") or home.startswith(_TRUSTED)


def is_own_cache(value: Any) -> bool:
    """Whether this is a function of Sortie's own that keeps results (`functools.cache`)."""
    return hasattr(value, "cache_info") and is_trusted(str(value.__module__))


def is_cache_key(value: Any) -> bool:
    """Whether a cache may keep this as an argument: a plain number or text, a stand-in, or a tuple of these.

    No two of them are equal and of different types, so that no argument gets what was kept for another one.
    """
    if isinstance(value, tuple | frozenset):
        members = (frozenset if isinstance(value, frozenset) else tuple).__iter__(value)  # type: ignore[arg-type]
        return not is_users(home_of(type(value))) and all(map(is_cache_key, members))
    return type(value) in (int, str, bytes) or (
        home_of(type(value)).startswith("sortie.")
        and isinstance(value, int | float | str)
        and not isinstance(value, Enum)
    )


def is_seeded(path: str) -> bool:
    """Whether this is a random generator with a seed of its own."""
    return path in _SEEDED


def takes_ranges(function: Any) -> bool:
    """Whether a function asks its arguments by their methods alone, so that a stand-in can answer for a real object."""
    if isinstance(function, types.FunctionType | types.MethodType):
        home = str(function.__module__)
        return (
            is_users(home)
            or home.startswith("sortie.")
            or home in ("functools", "heapq", "enum")
            or _is_tuple_method(function)
        )
    if isinstance(function, type):
        home = home_of(function)
        return (
            function in _BUILTINS or is_users(home) or is_trusted(home)
            or home in ("itertools", "collections", "functools") or issubclass(function, BaseException)
        )  # fmt: skip
    if isinstance(function, functools.partial):
        return takes_ranges(function.func)
    if is_users(home_of(type(function))):
        return isinstance(type(function).__call__, types.FunctionType)
    owner = getattr(function, "__self__", None)
    if owner is None or isinstance(owner, types.ModuleType):
        return getattr(function, "__module__", None) in _OPEN_MODULES or isinstance(
            function, types.MethodDescriptorType
        )
    return not isinstance(owner, re.Pattern) and (isinstance(owner, _PLAIN) or owner in _PLAIN)


def cannot_call(function: Any) -> str | None:
    """Why a search cannot follow a call; None if it can. It begins with `!` if the call is against the rules of the plane."""
    kind = type(function)
    if kind is types.FunctionType:
        return _python_function(function)
    if kind is types.BuiltinFunctionType or kind is types.MethodWrapperType:
        return _compiled_function(function)
    if kind is types.MethodType:
        if isinstance(function.__self__, random.Random):
            return "!random"
        return None if _is_tuple_method(function) else cannot_call(function.__func__)
    if kind is types.MethodDescriptorType or kind is types.ClassMethodDescriptorType:
        return None if function.__objclass__ in _PLAIN else f"calls {function.__qualname__}"
    if isinstance(function, type):
        return _class(function)
    if isinstance(function, functools.partial):
        return cannot_call(function.func)
    if hasattr(function, "cache_info"):
        return None if is_own_cache(function) else "keeps results (functools.cache)"
    home = home_of(kind)
    if is_users(home) or kind is operator.itemgetter or isinstance(function, Enum):
        return None
    if home.startswith("sortie.policies.verification"):
        return None  # a stand-in that is called raises what the real object raises
    if home == "typing" or kind in (types.GenericAlias, types.UnionType):
        return None
    return f"calls {kind.__module__}.{kind.__name__}" if callable(function) else None


def _python_function(function: Any) -> str | None:
    home = str(function.__module__)
    if is_users(home) or is_trusted(home) or function is abc.abstractmethod:
        return None
    if function in _NOT:
        return f"calls {_NOT[function]}"
    path = f"{home}.{function.__name__}"
    if is_seeded(path):
        return f"draws from {path}"
    if home.startswith("sortie.policies.verification"):
        return None  # a method of a stand-in, which refuses what it cannot answer
    if home.startswith("sortie."):
        return f"!{path}"
    if home in _PYTHON_MODULES or home.startswith("collections") or function.__code__.co_filename == "<string>":
        return None
    return f"calls {path}" if home.partition(".")[0] in PURE_MODULES else f"!{path}"


def _compiled_function(function: Any) -> str | None:
    owner, name = function.__self__, function.__name__
    if owner is builtins:
        if function in _BUILTINS:
            return None
        return f"!{name}(…)" if name in _OUTSIDE else f"calls {name}(…)"
    if owner is None or isinstance(owner, types.ModuleType):
        home = str(function.__module__)
        if function in _NOT:
            return f"calls {_NOT[function]}"
        if home in _C_MODULES:
            return None
        return f"calls {home}.{name}" if home.partition(".")[0] in PURE_MODULES else f"!{home}.{name}"
    if isinstance(owner, _PLAIN) or (isinstance(owner, type) and owner in _PLAIN) or isinstance(owner, type(iter(()))):
        return None
    home = home_of(type(owner))
    if home in _C_MODULES or home in ("decimal", "fractions"):
        return None
    if is_users(home) or home.startswith("sortie.") or (isinstance(owner, type) and is_users(home_of(owner))):
        return None
    return (
        f"!{home}.{type(owner).__name__}.{name}"
        if home in ("random", "_random")
        else f"calls {home}.{type(owner).__name__}.{name}"
    )


def _class(kind: type) -> str | None:
    home = home_of(kind)
    if issubclass(kind, set | frozenset) and is_users(home):
        return f"calls {kind.__name__}, a set of its own kind"
    if kind in _BUILTINS or kind in _PLAIN or is_users(home) or is_trusted(home) or issubclass(kind, BaseException):
        return None
    path = f"{home}.{kind.__name__}"
    if kind in _NOT:
        return f"calls {_NOT[kind]}"
    if path in _SEEDED:
        return f"draws from {path}"
    if home in _TYPE_MODULES or kind in (functools.partial, functools.reduce, operator.itemgetter):
        return None
    if issubclass(kind, tuple) and hasattr(kind, "_fields"):
        return None
    return f"calls {path}" if home.partition(".")[0] in PURE_MODULES else f"!{path}"


def _is_tuple_method(function: Any) -> bool:
    """Whether this is `_replace`, `_make` or `_asdict` of a named tuple."""
    owner = getattr(function, "__self__", None)
    kind = owner if isinstance(owner, type) else type(owner)
    return (
        issubclass(kind, tuple) and hasattr(kind, "_fields") and function.__name__ in ("_replace", "_make", "_asdict")
    )


_KEEP = (bisect, heapq, itertools, math)  # loaded before any policy runs
