"""A copy of a policy that can reach nothing but its view: no clock, no files, no network, no other room.

    confined(my_policy)(view)    # raises Reached if the policy uses a clock, a file, another room

The policy's functions are copied with a new namespace. The namespace has pure mathematics, the contract's types and the
policy's own helpers. Every other name raises when it is used. This finds an honest policy's mistake in a test. It does
not stop a hostile policy: C extensions and further methods of a policy's own classes are not checked.
"""

from __future__ import annotations

import builtins
import functools
import sys
import types
from collections.abc import Callable
from typing import Any, NoReturn, TypeVar, cast

from sortie.scenarios.plugins.user_calls import Guarded, guarded
from sortie.scenarios.plugins.user_code import is_users

Decides = TypeVar("Decides", bound=Callable[..., Any])

ALLOWED = frozenset({
    "__future__", "_bisect", "_collections", "_functools", "_heapq", "_json", "_operator", "_random", "abc", "bisect",
    "builtins", "cmath", "collections", "contextlib", "copy", "dataclasses", "decimal", "enum", "fractions", "functools",
    "heapq", "itertools", "json", "math", "numbers", "numpy", "operator", "re", "sortie.policies", "statistics", "string", "types", "typing",
})  # fmt: skip
"""Packages that only use their arguments; a policy may use them."""
SHARED = frozenset(
    {
        "sortie.scenarios.disc",
        "sortie.scenarios.link_state",
        "sortie.scenarios.plain_sum",
        "sortie.scenarios.representation",
        "sortie.scenarios.streams",
    }
)
"""Modules of another room that a policy may use: two types, a sum, and random draws that depend on their key alone."""
FORBIDDEN = frozenset({
    "simpy", "sortie.fleet", "sortie.perception", "sortie.radio", "sortie.scenarios", "sortie.sim", "torch"
})  # fmt: skip
_ONLY = {"random": {"Random"}}
"""Modules of which a policy may use these names only, such as a random generator with a seed of its own."""
_EXCEPT = {
    "contextlib": {"chdir", "os", "redirect_stderr", "redirect_stdout", "sys"},
    "json": {"codecs"},
    "numpy": {"DataSource", "ctypeslib", "fromfile", "genfromtxt", "load", "loadtxt", "memmap", "random", "save", "savez"}
}  # fmt: skip
_NO_BUILTINS = {"breakpoint", "compile", "eval", "exec", "exit", "globals", "help", "input", "open", "print", "quit"}


class Reached(BaseException):
    """A policy used something that is not in its view. An ordinary `except` in the policy does not catch it."""

    def __init__(self, what: str) -> None:
        super().__init__(f"uses {what}, which is not in its view")


class _Forbidden:
    """A placeholder for a value that may not be used."""

    __slots__ = ("_name",)

    def __init__(self, name: str) -> None:
        object.__setattr__(self, "_name", name)

    def _reached(self, *_: object, **__: object) -> NoReturn:
        raise Reached(object.__getattribute__(self, "_name"))

    __call__ = __getattr__ = __setattr__ = __iter__ = __len__ = __getitem__ = __bool__ = __eq__ = _reached
    __hash__ = None  # type: ignore[assignment]


class _Part:
    """A module of which only some names may be used."""

    __slots__ = ("_module",)

    def __init__(self, module: types.ModuleType) -> None:
        self._module = module

    def __getattr__(self, name: str) -> Any:
        home = self._module.__name__
        if name in _EXCEPT.get(home, ()) or (home in _ONLY and name not in _ONLY[home]):
            raise Reached(f"{home}.{name}")
        return getattr(self._module, name)


class _OwnModule:
    """A module whose names are judged one by one: the policy's own, whose functions are confined as well, and `sortie`."""

    __slots__ = ("_allowed", "_module")

    def __init__(self, module: types.ModuleType, allowed: Callable[[str, Any], Any]) -> None:
        self._module, self._allowed = module, allowed

    def __getattr__(self, name: str) -> Any:
        return self._allowed(name, getattr(self._module, name))


def confined(policy: Decides) -> Decides:
    """A copy of a policy, or of its viewpoint, that decides the same as long as it only uses its view.

    A call raises `Reached` with the name of whatever else the policy uses.
    """
    built: Any = _Rebuilding().function(policy)
    return cast(Decides, built)


class _Rebuilding:
    """Copies of one policy's functions and of the names that they use, each made once."""

    def __init__(self) -> None:
        self._functions: dict[int, types.FunctionType] = {}
        self._namespaces: dict[int, dict[str, Any]] = {}

    def function(self, found: Any) -> Callable[..., Any]:
        """A copy of a callable with confined globals."""
        if isinstance(found, Guarded):
            return guarded(self.function(found.__wrapped__))
        if hasattr(found, "cache_info"):  # the result of a cached function depends on its arguments alone
            found = found.__wrapped__
        if isinstance(found, functools.partial):
            return functools.partial(self.function(found.func), *found.args, **found.keywords)
        if isinstance(found, types.MethodType):
            return types.MethodType(self.function(found.__func__), found.__self__)
        if isinstance(found, types.FunctionType):
            return self._plain(found)
        call = getattr(type(found), "__call__", None)  # noqa: B004 - an object whose method is the policy
        if isinstance(call, types.FunctionType):
            return types.MethodType(self._plain(call), found)
        other: Callable[..., Any] = found
        return other

    def _plain(self, found: types.FunctionType) -> types.FunctionType:
        if id(found) in self._functions:
            return self._functions[id(found)]
        module, code = found.__globals__, found.__code__
        if id(module) not in self._namespaces:
            plain = {name: module.get(name) for name in ("__name__", "__package__")}
            self._namespaces[id(module)] = {"__builtins__": self._builtins(module["__builtins__"]), **plain}
        space = self._namespaces[id(module)]
        cells = found.__closure__ and tuple(types.CellType() for _ in found.__closure__)
        built = types.FunctionType(code, space, found.__name__, found.__defaults__, cells)
        built.__kwdefaults__ = found.__kwdefaults__
        self._functions[id(found)] = built
        for name in _names(code) & module.keys() - space.keys():
            space[name] = None  # a placeholder: the value may use the same name
            space[name] = self._allowed(name, module[name])
        for name, old, new in zip(code.co_freevars, found.__closure__ or (), cells or (), strict=True):
            new.cell_contents = self._allowed(name, old.cell_contents)
        return built

    def _allowed(self, name: str, value: Any) -> Any:
        """The value itself if it is harmless, a confined copy of the policy's own function, or a forbidden placeholder."""
        if isinstance(value, types.ModuleType):
            return self._module(value)
        home: str = getattr(value, "__module__", None) or type(value).__module__
        if home in SHARED or (home in _ONLY and name in _ONLY[home]):
            return value
        if _is_forbidden(home) or name in _EXCEPT.get(home, ()):
            return _Forbidden(f"{home}.{name}")
        own = home.split(".")[0] not in ALLOWED
        if own and isinstance(getattr(value, "__wrapped__", value), types.FunctionType | functools.partial):
            return self.function(value)
        return value

    def _module(self, module: types.ModuleType) -> Any:
        home = module.__name__
        if home in _EXCEPT or home in _ONLY:
            return _Part(module)
        if is_users(home) or home == "sortie":  # the public API: each name is judged by where it is at home
            return _OwnModule(module, self._allowed)
        return _Forbidden(home) if _is_forbidden(home) else module

    def _builtins(self, own: Any) -> dict[str, Any]:
        """Builtins for the functions of a module that has `own`; its imports find what they find without confinement."""
        find = own["__import__"] if isinstance(own, dict) else __import__

        def importing(name: str, *rest: Any) -> Any:
            if _is_forbidden(name) and name not in _ONLY:
                raise Reached(name)
            return self._module(find(name, *rest))

        kept = {n: _Forbidden(n) if n in _NO_BUILTINS else v for n, v in vars(builtins).items()}
        return kept | {"__import__": importing}


def _names(code: types.CodeType) -> set[str]:
    """Names that a function, or a function inside it, may use."""
    inner = [_names(c) for c in code.co_consts if isinstance(c, types.CodeType)]
    return set(code.co_names).union(*inner)


def _is_forbidden(home: str) -> bool:
    """Whether a policy may not use a module: another room, or a part of the standard library that uses more than its arguments."""
    parts = home.split(".")
    root = ".".join(parts[: 2 if parts[0] == "sortie" else 1])
    return root not in ALLOWED and (root in FORBIDDEN or root in sys.stdlib_module_names) and home not in SHARED
