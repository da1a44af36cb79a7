"""Names of models: a built-in one, an installed plug-in, or `path/to/file.py:Name`. `resolve` finds what a name means.

Every kind of model that can be replaced from outside is named in the same way, in YAML, on the command line, in Python
and in campaigns. An installed package offers a model by an entry point in the group `sortie.KIND`.
"""

from __future__ import annotations

import difflib
import functools
import hashlib
import inspect
import re
import sys
import traceback
from collections.abc import Callable, Mapping
from importlib.metadata import Distribution, EntryPoint, entry_points
from numbers import Real
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sortie.scenarios.errors import SortieError
from sortie.scenarios.plugins.user_calls import Guarded, Source, guarded
from sortie.scenarios.plugins.user_code import imported_files, is_loaded, is_users, load

FILE = re.compile(r".+\.py:[^\W\d]\w*")
"""`path/to/file.py:Name`."""
Params = Mapping[str, object]


class PluginError(SortieError):
    """A model from outside that is not there, does not load, or does not keep its contract."""


def is_file(reference: str) -> bool:
    """Whether a name means a model in a user's file."""
    return ":" in reference


@functools.cache
def installed(kind: str) -> Mapping[str, EntryPoint]:
    """The models of a kind that installed packages offer, by name."""
    return {entry.name: entry for entry in entry_points(group=f"sortie.{kind}")}


def resolve(
    kind: str,
    reference: str,
    params: Params | None = None,
    builtin: Mapping[str, Callable[..., Any]] | None = None,
    error: type[SortieError] = PluginError,
) -> Callable[..., Any]:
    """What a name means, with its parameters bound.

    Args:
        kind: the kind of model, as errors and the group of entry points have it, such as `path_loss`.
        reference: a built-in name, an installed plug-in's name, or `path/to/file.py:Name`.
        params: keyword-only arguments of the model.
        builtin: Sortie's own models of this kind, by name. They come before installed ones.
        error: raised where the name means nothing or a parameter is unknown.

    Returns:
        The function or class. A `partial` of it where there are parameters.
    """
    known = builtin or {}
    if is_file(reference):
        function = from_file(kind, reference, error)
    elif reference in known:
        function = known[reference]
    elif reference in installed(kind):
        function = _from_package(kind, installed(kind)[reference], error)
    else:
        raise error(unknown(kind, reference, [*known, *installed(kind)]))
    return bound(kind, reference, function, params or {}, error)


def unknown(kind: str, reference: str, names: list[str]) -> str:
    """The error for a name that means nothing."""
    thing = _thing(kind)
    if reference.endswith(".py"):
        return f"{kind} file {reference!r} without its {thing.lower()}, must be {reference}:{thing}"
    near = difflib.get_close_matches(reference, names, 1)
    hint = f", did you mean {near[0]}?" if near else ","
    listed = f" known: {', '.join(names)}, or" if names else " must be"
    return f"unknown {kind} {reference!r}{hint}{listed} path/to/file.py:{thing}"


def _thing(kind: str) -> str:
    """What a reference to a file names in it, in errors."""
    return "function" if kind == "policy" else "Name"


def bound(
    kind: str, reference: str, function: Callable[..., Any], params: Params, error: type[SortieError] = PluginError
) -> Callable[..., Any]:
    """A model with its parameters bound; `error` where it has no such parameter."""
    known = parameters(function)
    for key in params:
        if key not in known:
            raise error(f"{kind} {reference!r} has no parameter {key!r}, it has: {', '.join(known) or 'none'}")
    return functools.partial(function, **params) if params else function


def parameters(function: Callable[..., object]) -> dict[str, object]:
    """The keyword-only parameters of a function or a class, and their defaults.

    Example:
        >>> def loss_db(distance_m, *, depth_m=10.0): ...
        >>> parameters(loss_db)
        {'depth_m': 10.0}
    """
    signature = inspect.signature(function)
    return {p.name: p.default for p in signature.parameters.values() if p.kind is p.KEYWORD_ONLY}


def file_of(kind: str, reference: str, error: type[SortieError] = PluginError) -> tuple[Path, str]:
    """The file and the name in it that `path/to/file.py:Name` means."""
    file, _, attribute = reference.rpartition(":")
    path = Path(file)
    if not path.is_file():
        raise error(f"{kind} file {file!r} not found")
    if path.suffix != ".py":
        raise error(f"{kind} file {file!r} is not a Python file")
    return path, attribute


def from_file(kind: str, reference: str, error: type[SortieError] = PluginError) -> Callable[..., Any]:
    """The function or class that `path/to/file.py:Name` means. It is the user's own code and runs as such."""
    path, attribute = file_of(kind, reference, error)
    file = str(path)
    module = _loaded(path, f"{kind} file {file!r}", error)
    function = getattr(module, attribute, None)
    if not callable(function):
        raise error(f"{kind} file {file!r} has no {_thing(kind).replace('Name', 'function or class')} {attribute!r}")
    try:
        inspect.signature(function)
    except (TypeError, ValueError) as failure:  # some of those written in C
        raise error(f"{kind} file {file!r}: {attribute!r} names no parameters, must be a Python function") from failure
    plain = function.__wrapped__ if isinstance(function, Guarded) else function  # whose own file may be another one
    return Guarded(plain, Source(path, attribute, vars(module)))


def code_files(path: Path) -> tuple[Path, ...]:
    """The files that a user's code is in: a file of models and all that it imports. It is loaded where it is not yet.

    Raises:
        PluginError: it does not load.
    """
    if not is_loaded(path):
        _loaded(path, f"file {str(path)!r}", PluginError)
    return imported_files(path)


def _loaded(path: Path, what: str, error: type[SortieError]) -> ModuleType:
    try:
        return load(path)
    except (Exception, SystemExit) as failure:
        raise error(f"{what} does not load: {describe_error(failure)}") from failure


def _from_package(kind: str, entry: EntryPoint, error: type[SortieError]) -> Callable[..., Any]:
    try:
        function = entry.load()
    except Exception as failure:
        where = f"{entry.name!r} of {entry.dist.name if entry.dist else entry.value}"
        raise error(f"{kind} {where} does not load: {describe_error(failure)}") from failure
    if not callable(function):
        raise error(f"{kind} {entry.name!r}: {entry.value} is no function or class")
    return guarded(function)


def describe_error(error: BaseException, called: Any = None) -> str:
    """An exception that a user's code raised, with the file and the last line of that code that it passed through.

    Where it passed through none, as with a wrong number of arguments, they are those where `called` is defined.
    """
    lines = _lines_outside(error) or _defined(called)
    own = next((top for top, _, _ in lines if is_users(top)), lines[0][0] if lines else "")
    place = next((f" ({Path(file).name}, line {n})" for top, file, n in reversed(lines) if top == own), "")
    return f"{error if isinstance(error, SortieError) else f'{type(error).__name__}: {error}'}{place}"


def passes_through_users(error: BaseException) -> bool:
    """Whether an exception was raised in a file that `load` ran, or in what that file called."""
    return any(is_users(top) for top, _, _ in _lines_outside(error))


def _lines_outside(error: BaseException) -> list[tuple[str, str, int]]:
    """The lines of a traceback that are neither Sortie's nor Python's: package, file and number."""
    lines = []
    for frame, number in traceback.walk_tb(error.__traceback__):
        top = str(frame.f_globals.get("__name__")).partition(".")[0]
        if top != "sortie" and top not in sys.stdlib_module_names:
            lines.append((top, frame.f_code.co_filename, number))
    return lines


def _defined(called: Any) -> list[tuple[str, str, int]]:
    """As `_lines_outside`: where a function or class of the user is defined."""
    inner = _inner(called)
    code = getattr(inner.__init__ if inspect.isclass(inner) else inner, "__code__", None)
    return [] if code is None else [("", code.co_filename, code.co_firstlineno)]


def _inner(model: Any) -> Any:
    inner = inspect.unwrap(model)
    return inspect.unwrap(getattr(inner, "func", inner))


def name_of(model: Any) -> str:
    """A model's name for errors: that of the function or class."""
    inner = _inner(model)
    owner = getattr(inner, "__self__", None)
    if owner is not None:
        return f"{type(owner).__name__}.{inner.__name__}"
    return str(getattr(inner, "__name__", type(inner).__name__))


def checked_call(kind: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Call a user's model; what it raises becomes a `PluginError` of one line that names the model and the place."""
    try:
        return function(*args, **kwargs)
    except PluginError:  # of a model that this one calls
        raise
    except (Exception, SystemExit) as failure:
        raise PluginError(f"{kind} {name_of(function)}: {describe_error(failure, function)}") from failure


def checked_array(
    kind: str,
    function: Callable[..., Any],
    shape: tuple[int, ...],
    *args: Any,
    left_out: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64]:
    """Call a user's model, and check that it returns finite numbers of a shape, but for those left out.

    The model gets copies of arrays, so that it may change them.

    Raises:
        PluginError: it fails, or returns no numbers, another shape or a number that is not finite.
    """
    answer = checked_call(kind, function, *(np.array(arg) if isinstance(arg, np.ndarray) else arg for arg in args))
    if (found := real_array(answer)) is None:
        raise PluginError(f"{kind} {name_of(function)}: returns {_shown(answer)}, must be numbers of shape {shape}")
    if found.shape != shape:
        raise PluginError(f"{kind} {name_of(function)}: returns shape {found.shape}, must be {shape}")
    wrong = ~np.isfinite(found) & (True if left_out is None else ~left_out)
    if wrong.any():
        raise PluginError(f"{kind} {name_of(function)}: returns {found[wrong][0]}, must be finite")
    return found


def real_array(values: object) -> NDArray[np.float64] | None:
    """Numbers as an array; None of what is no numbers. NumPy alone reads text, makes None nan and drops imaginary parts."""
    try:
        found = np.asarray(values)
        if found.dtype.kind in "biuf" or (found.dtype.kind == "O" and all(isinstance(v, Real) for v in found.flat)):
            return found.astype(float)
        return None
    except (TypeError, ValueError, OverflowError):
        return None


def _shown(answer: object) -> str:
    """What a model returned, short enough for a line."""
    text = repr(answer).replace("\n", " ")
    return text if len(text) <= 60 else f"{type(answer).__name__} {text[:60]}…"


class Guard:
    """A user's object as everything else calls it: errors of its methods are of one line. It has the object's public
    methods and attributes."""

    def __init__(
        self, kind: str, model: object, needed: tuple[str, ...] = (), name: str | None = None, *, timed: bool = True
    ) -> None:
        """Args:
            kind: the kind of model, for errors.
            model: the user's object.
            needed: methods that it must have.
            name: the name in the record; None keeps the object's own.
            timed: whether `limits.decision_s` is for calls of it.

        Raises:
            PluginError: a method is missing.
        """
        lacks = [method for method in needed if not callable(getattr(model, method, None))]
        if lacks:
            raise PluginError(f"{kind} {name or name_of(model)} has no {lacks[0]!r}, must have {', '.join(needed)}")
        for attribute in dir(model):
            if not attribute.startswith("_"):
                value = getattr(model, attribute)
                if callable(value):
                    called = functools.partial(checked_call, kind, guarded(value) if timed else value)
                    value = functools.update_wrapper(called, value)
                setattr(self, attribute, value)
        if name is not None:
            self.name = name


def package_of(kind: str, reference: str) -> tuple[str, str] | None:
    """The package that offers a model, as `name version`, and a digest of the package's Python files.

    None where the name means a built-in model or a user's file.
    """
    entry = None if is_file(reference) else installed(kind).get(reference)
    return None if entry is None or entry.dist is None else package(entry.dist)


def package(found: Distribution) -> tuple[str, str]:
    """An installed package as `name version`, and a digest of its Python files."""
    digest = hashlib.sha256()
    for name in sorted(str(file) for file in found.files or () if file.suffix == ".py"):
        path = Path(str(found.locate_file(name)))
        digest.update(name.encode() + b"\0" + (path.read_bytes() if path.is_file() else b"") + b"\0")
    return f"{found.name} {found.version}", digest.hexdigest()[:16]
