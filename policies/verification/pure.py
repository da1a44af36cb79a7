"""What a policy's code may call and read while it is searched: what depends on nothing but its arguments."""

from __future__ import annotations

import abc
import bisect
import builtins
import collections
import dataclasses
import enum
import functools
import hashlib
import heapq
import itertools
import math
import operator
import statistics
import sys
import types
import typing
import zlib
from enum import Enum
from typing import Any

from sortie.policies.contract import FleetView
from sortie.scenarios.plugins.user_code import PREFIX, is_users

_FUNCTIONS: dict[types.ModuleType, str] = {
    builtins: "abs all any bool bytes chr dict divmod enumerate filter float frozenset int isinstance iter len list map max "
    "min next ord pow property range reversed round set slice sorted staticmethod classmethod str sum super tuple type zip",
    abc: "ABC abstractmethod",
    bisect: "bisect bisect_left bisect_right insort insort_left insort_right",
    collections: "Counter OrderedDict defaultdict deque namedtuple",
    dataclasses: "InitVar KW_ONLY dataclass field replace",
    enum: "Enum IntEnum auto",
    functools: "partial reduce wraps",
    hashlib: "blake2b blake2s md5 sha1 sha224 sha256 sha384 sha512",
    heapq: "heapify heappop heappush heappushpop heapreplace nlargest nsmallest",
    itertools: "accumulate chain combinations combinations_with_replacement compress count cycle dropwhile filterfalse groupby "
    "islice pairwise permutations product repeat starmap takewhile zip_longest",
    math: " ".join(name for name, value in vars(math).items() if callable(value) and name != "sumprod"),
    operator: "add eq ge gt itemgetter le lt mul ne neg truediv",
    statistics: "StatisticsError fmean geometric_mean harmonic_mean mean median median_high median_low mode multimode pstdev "
    "pvariance stdev variance",
    typing: "NamedTuple Protocol TypeVar cast",
    zlib: "adler32 crc32",
}
"""The functions and classes that a policy may call, by the module in which it finds them."""
NAMED = {module.__name__: frozenset(names.split()) for module, names in _FUNCTIONS.items()}
_KNOWN = {id(getattr(module, name)) for module, names in _FUNCTIONS.items() for name in names.split()} | {
    id(kind)
    for kind in (
        ValueError,
        KeyError,
        IndexError,
        LookupError,
        ZeroDivisionError,
        StopIteration,
        TypeError,
        RuntimeError,
    )
}
_KNOWN |= {id(AssertionError), id(NotImplementedError)}
_KNOWN -= {id(kind) for kind in (enum.Enum, enum.IntEnum, abc.ABC, typing.Protocol)}  # classes may derive from these
ONLY_TYPES = frozenset({"typing", "collections.abc", "types"})
"""Modules of which a policy may name everything, for annotations."""
_OF_DICTS = "clear copy get items keys pop popitem setdefault update values"
_OF_SETS = "copy difference intersection isdisjoint issubset issuperset symmetric_difference union"
_OF_SEQUENCES = "count index"
_TEXT = (
    "capitalize casefold center count encode endswith find index isalnum isalpha isdecimal isdigit islower isspace istitle isupper "
    "join ljust lower lstrip partition removeprefix removesuffix replace rfind rindex rjust rpartition rsplit rstrip split "
    "splitlines startswith strip swapcase title upper zfill"
)
METHODS: dict[type, frozenset[str]] = {
    kind: frozenset(names.split())
    for kind, names in {
        list: f"{_OF_SEQUENCES} append clear copy extend insert pop remove reverse sort",
        tuple: _OF_SEQUENCES,
        dict: _OF_DICTS,
        collections.defaultdict: _OF_DICTS,
        collections.OrderedDict: f"{_OF_DICTS} move_to_end",
        collections.Counter: f"{_OF_DICTS} elements most_common subtract",
        types.MappingProxyType: "copy get items keys values",
        set: f"{_OF_SETS} add clear difference_update discard intersection_update pop remove symmetric_difference_update update",
        frozenset: _OF_SETS,
        collections.deque: f"{_OF_SEQUENCES} append appendleft clear copy extend extendleft insert pop popleft remove reverse rotate",
        str: _TEXT,
        bytes: "hex",
        int: "bit_count bit_length",
        bool: "bit_count bit_length",
        float: "is_integer",
        range: f"{_OF_SEQUENCES} start step stop",
    }.items()
}
"""What a policy may read of objects of Python's own classes."""
_OF_HASHES = frozenset({"digest", "hexdigest", "update"})
_TRUSTED = (
    "sortie.policies.contract", "sortie.policies.geometry", "sortie.policies.catalogue", "sortie.scenarios.disc",
    "sortie.scenarios.link_state", "sortie.scenarios.plain_sum", "sortie.scenarios.representation",
)  # fmt: skip
_SEEDED = frozenset({"random.Random", "sortie.scenarios.streams.stream"})
"""Random draws that depend on their seed alone: allowed, but no search follows them."""
_OUTSIDE = {"print", "open", "input", "id", "hash", "breakpoint", "exit", "quit", "help"}
_NO_RANGES = {
    id(function)
    for function in (bytes, *(getattr(m, n) for m in (statistics, zlib, hashlib) for n in NAMED[m.__name__]))
}


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


def is_known(function: Any) -> bool:
    """Whether this is a function or a class of Python's that a policy may call."""
    return id(function) in _KNOWN


def is_hash(value: object) -> bool:
    return home_of(type(value)) in ("_hashlib", "_blake2", "_md5", "_sha1", "_sha2", "_sha256", "_sha512")


def may_read(value: object, name: str) -> bool:
    """Whether a policy may read an attribute of an object of Python's own classes."""
    return name in METHODS.get(type(value), ()) or (name in _OF_HASHES and is_hash(value))


def reads_stored_text(function: Any) -> bool:
    """Whether compiled code reads what is stored in a text without asking its methods."""
    if isinstance(function, functools.partial):
        return reads_stored_text(function.func)
    owner = getattr(function, "__self__", None)
    return function in (bytes, int, ord) or type(owner) is str or type(owner) is bytes


CALL_OTHERS = (map, filter, functools.reduce, functools.partial)
"""Compiled code that calls what it is given; so does all of `itertools`."""


def calls_others(function: Any) -> bool:
    """Whether this is compiled code that calls other functions, which no check would see."""
    return function in CALL_OTHERS or (isinstance(function, type) and home_of(function) == "itertools")


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
    if isinstance(function, functools.partial):
        return takes_ranges(function.func)
    return id(function) not in _NO_RANGES and not is_hash(getattr(function, "__self__", None))


def cannot_call(function: Any) -> str | None:
    """Why a search cannot follow a call; None if it can. It begins with `!` if the call is against the rules of the plane."""
    kind = type(function)
    if is_known(function):
        return None
    if kind is types.FunctionType:
        return _python_function(function)
    if kind is types.BuiltinFunctionType:
        return _compiled_function(function)
    if kind is types.MethodType:
        may = _is_tuple_method(function) or may_read(function.__self__, function.__name__)
        return None if may else cannot_call(function.__func__)
    if isinstance(function, type):
        home = home_of(function)
        if function is FleetView:
            return "makes a view of its own"
        return None if is_users(home) or is_trusted(home) else _unknown(home, function.__name__)
    if kind is functools.partial:
        return cannot_call(function.func)
    if hasattr(function, "cache_info"):
        return None if is_own_cache(function) else "keeps results (functools.cache)"
    home = home_of(kind)
    if is_users(home) or kind is operator.itemgetter or home.startswith("sortie.policies.verification"):
        return None  # a stand-in that is called raises what the real object raises
    return f"calls {kind.__module__}.{kind.__name__}" if callable(function) else None


def _python_function(function: Any) -> str | None:
    home = str(function.__module__)
    if is_users(home) or is_trusted(home) or home.startswith("sortie.policies.verification"):
        return None  # the last: a method of a stand-in, which refuses what it cannot answer
    path = f"{home}.{function.__name__}"
    if is_seeded(path):
        return f"draws from {path}"
    return _unknown(home, function.__name__)


def _compiled_function(function: Any) -> str | None:
    owner, name = function.__self__, function.__name__
    if owner is builtins:
        return f"!{name}(…)" if name in _OUTSIDE else f"calls {name}(…)"
    if owner is None or isinstance(owner, types.ModuleType):
        return _unknown(str(function.__module__), name)
    if may_read(owner, name) or owner is dict or owner is itertools.chain:
        return None
    home = home_of(type(owner))
    if home.startswith("sortie.") or (is_users(home) and type(owner).__mro__[1] is tuple):
        return None
    return _unknown(home, f"{type(owner).__name__}.{name}")


def _unknown(home: str, name: str) -> str:
    top = home.partition(".")[0]
    if home == "builtins":
        return f"calls {name}(…)"
    return f"{'calls ' if top in PURE_MODULES else '!'}{home}.{name}"


def _is_tuple_method(function: Any) -> bool:
    """Whether this is `_replace`, `_make` or `_asdict` of a named tuple."""
    owner = getattr(function, "__self__", None)
    kind = owner if isinstance(owner, type) else type(owner)
    return (
        issubclass(kind, tuple) and hasattr(kind, "_fields") and function.__name__ in ("_replace", "_make", "_asdict")
    )


PURE_MODULES = frozenset({
    "__future__", "abc", "bisect", "cmath", "collections", "contextlib", "copy", "dataclasses", "decimal", "enum",
    "fractions", "functools", "hashlib", "heapq", "itertools", "json", "math", "numbers", "numpy", "operator", "re", "statistics", "string",
    "types", "typing", "zlib",
})  # fmt: skip
"""Modules that use their arguments alone, for the most part. What is not among the functions above cannot be followed."""
IMPURE = frozenset({
    "numpy.random", "numpy.datetime64", "numpy.load", "numpy.fromfile", "numpy.loadtxt", "numpy.genfromtxt",
    "numpy.memmap", "numpy.save", "numpy.empty", "statistics.random", "contextlib.chdir", "contextlib.os", "contextlib.sys",
    "contextlib.redirect_stdout", "contextlib.redirect_stderr",
})  # fmt: skip
"""Parts of these modules that are against the rules of the plane."""
