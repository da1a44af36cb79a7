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
from typing import Any

from sortie.policies import contract
from sortie.policies.catalogue.prior.full import full_sharing
from sortie.policies.contract import Descriptor, Directive, Disc, FleetView, Reposition, Roster
from sortie.policies.geometry import footprint_overlap, peers_by_overlap
from sortie.policies.registry import POLICIES
from sortie.policies.verification.symbols import Text
from sortie.scenarios import link_state
from sortie.scenarios.disc import disc_overlap
from sortie.scenarios.plain_sum import plain_sum
from sortie.scenarios.plugins.user_code import PREFIX, is_users
from sortie.scenarios.representation import Representation

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
_KNOWN |= {id(AssertionError), id(NotImplementedError), id(contract.looks_from), id(contract.boxes_across_networks)}
_KNOWN -= {id(kind) for kind in (enum.Enum, enum.IntEnum, abc.ABC, typing.Protocol)}  # classes may derive from these
_ENUMS = (Representation, contract.TaskPhase, contract.Coverage, link_state.LinkState)
MADE = (Directive, Disc, Reposition)
"""Sortie's named tuples that a policy may make."""
_SORTIES = {
    id(function)
    for function in (
        *MADE, *_ENUMS, contract.nothing, contract.nothing_to_all, full_sharing, footprint_overlap, peers_by_overlap,
        disc_overlap, plain_sum, link_state.state_of, link_state.is_tried, link_state.probed_mbps, link_state.heard_share,
        *POLICIES.values(),
    )
}  # fmt: skip
"""Sortie's functions and classes that a policy may call."""
TABLES = frozenset({"BOXES", "CELLS", "MAPS", "NAME_OF", "PHASE_NAMES", "PHASE_OF", "REPRESENTATION_OF"})
"""Sortie's tables that a policy may read. Of its other names a policy may read numbers, texts and enums."""
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
_OF_VIEWS = "attached full_sharing_maps human_in_region me members peers roster shares_codes_with shares_features_with"
OF_SORTIES: dict[type, frozenset[str]] = {
    **{kind: frozenset({"_replace", *kind._fields}) for kind in MADE},
    **{
        kind: frozenset({*kind._fields, *others.split()})
        for kind, others in (
            (FleetView, _OF_VIEWS),
            (Descriptor, "counts coverage_corner goodput_by_id goodput_to link_state"),
            (Roster, "slot"),
        )
    },
    **dict.fromkeys(_ENUMS, frozenset({"name", "value"})),
    Representation: frozenset({"level", "name", "value"}),
}
"""What a policy may read of objects of Sortie's classes."""
METHODS |= OF_SORTIES
_OF_HASHES = frozenset({"digest", "hexdigest", "update"})
_OF_POLICIES = (
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
    """Whether this is a function or a class of Python's or Sortie's that a policy may call."""
    return id(function) in _KNOWN or id(function) in _SORTIES


def runs_sorties_code(function: Any) -> bool:
    """Whether a call of what a policy may call runs a function, a method or a class of Sortie's, which has no checks."""
    return id(function) in _SORTIES or (
        type(function) is types.MethodType and shown_class(function.__self__) in OF_SORTIES
    )


def shown_class(value: object) -> type:
    """The class of an object; of a stand-in that of the real object."""
    kind = type(value)
    if kind is Text:
        return str
    return value.__class__ if home_of(kind).startswith("sortie.policies.verification.") else kind


def is_hash(value: object) -> bool:
    return home_of(type(value)) in ("_hashlib", "_blake2", "_md5", "_sha1", "_sha2", "_sha256", "_sha512")


def may_read(value: object, name: str) -> bool:
    """Whether a policy may read an attribute of an object of Python's or Sortie's classes."""
    return name in METHODS.get(shown_class(value), ()) or (name in _OF_HASHES and is_hash(value))


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


def is_of_policies(home: str) -> bool:
    """Whether a module is one of Sortie's that policies are made of. It may be imported; what may be used of it is listed."""
    return home in ("sortie", "sortie.policies") or home.startswith(_OF_POLICIES)


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
        if _is_tuple_method(function) or may_read(function.__self__, function.__name__):
            return None
        of_others = is_known(function.__func__)  # which would get the policy's object unseen
        return f"makes a method of {function.__func__.__name__}" if of_others else cannot_call(function.__func__)
    if isinstance(function, type):
        home = home_of(function)
        if function is FleetView:
            return "makes a view of its own"
        return None if is_users(home) else _unknown(home, function.__name__)
    if kind is functools.partial:
        return cannot_call(function.func)
    if hasattr(function, "cache_info"):
        return "keeps results (functools.cache)"
    home = home_of(kind)
    if is_users(home) or kind is operator.itemgetter or home.startswith("sortie.policies.verification"):
        return None  # a stand-in that is called raises what the real object raises
    return f"calls {kind.__module__}.{kind.__name__}" if callable(function) else None


def _python_function(function: Any) -> str | None:
    home = str(function.__globals__.get("__name__"))
    if is_users(home) or home.startswith("sortie.policies.verification"):
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
    if is_users(home) and type(owner).__mro__[1] is tuple:
        return None
    return _unknown(home, f"{type(owner).__name__}.{name}")


def _unknown(home: str, name: str) -> str:
    top = home.partition(".")[0]
    if home == "builtins":
        return f"calls {name}(…)"
    return f"{'calls ' if top in PURE_MODULES or is_of_policies(home) else '!'}{home}.{name}"


def _is_tuple_method(function: Any) -> bool:
    """Whether this is `_replace`, `_make` or `_asdict` of a named tuple of the policy's."""
    owner = getattr(function, "__self__", None)
    kind = owner if isinstance(owner, type) else type(owner)
    names = ("_replace", "_make", "_asdict")
    return issubclass(kind, tuple) and is_users(home_of(kind)) and function.__name__ in names


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
