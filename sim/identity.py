"""Which code made a record (the release, a digest of everything that the package holds and stands on), and on what machine."""

from __future__ import annotations

import functools
import hashlib
import inspect
import os
import platform
import re
from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import requires, version
from importlib.resources import files
from pathlib import Path
from tokenize import TokenError
from typing import Any

from sortie.scenarios.code_digest import contents, digest_of, installed
from sortie.scenarios.plugins.reference import code_files, file_of, is_file, package_of
from sortie.scenarios.plugins.user_code import imported_files, imported_packages
from sortie.scenarios.reading.files import ensure_files, named_files, named_models
from sortie.scenarios.regular import regular
from sortie.scenarios.schema import Scenario
from sortie.scenarios.shipped import located

DISTRIBUTION = "sortie-sim"
RELEASE = version(DISTRIBUTION)
_WITHOUT_TORCH = {"none", "surrogate"}
"""Detectors that never compute with torch."""


@functools.cache
def code_version() -> str:
    """The release, a plus sign, and 16 hex digits of a SHA-256 digest.

    The digest covers every file of the installed package (sources, learned parameters, the library of
    scenarios) and the version of every library that the package requires. Two processes with equal versions run the
    same code, but for optional libraries: what is kept of flights with torch is kept under `flight_code`.

    Example:
        >>> code_version().partition("+")[0] == RELEASE
        True
    """
    return f"{RELEASE}+{digest_of(contents(files('sortie')), _required())[:16]}"


def codes_here() -> tuple[str, str]:
    """The code of flights without torch, `code_version`, and of those with it, which also names torch's version."""
    return code_version(), f"{code_version()} torch {installed('torch')}"


def flight_code(sections: object) -> str:
    """The one of `codes_here` under which flights are kept.

    Args:
        sections: of scenarios or of a campaign, as JSON. A detector that is no built-in one may compute with torch.
    """
    return codes_here()[not set(_detectors(sections)) <= _WITHOUT_TORCH]


def _detectors(sections: object) -> Iterator[str]:
    """All values of `detector` and of fields such as `perception.detector`, with those that are varied."""
    if isinstance(sections, list | tuple):
        for section in sections:
            yield from _detectors(section)
    elif isinstance(sections, dict):
        for key, value in sections.items():
            if key.rpartition(".")[2] != "detector":
                yield from _detectors(value)
                continue
            several = value.get("values", ()) if isinstance(value, dict) else value
            yield from (v for v in (several if isinstance(several, list | tuple) else [several]) if isinstance(v, str))


def _argument(value: object) -> str:
    """An argument as text that is the same in every process: the repr of most objects holds an address."""
    plain = value is None or isinstance(value, str | int | float)
    return repr(value) if plain else name_of(value)


def machine() -> str:
    """The processor's model, where the system reports it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    except OSError:
        models = []
    return models[0] if models else platform.processor() or platform.machine()


def name_of(thing: object) -> str:
    """The name under which a record keeps a policy or a detector that was passed as a Python object.

    That is its attribute `name`, where the object or its own class has one. A subclass does not inherit it, because it
    may do something else. Without one it is the module and the qualified name, with the arguments that a `partial` binds.

    Example:
        >>> name_of(functools.partial(file_digest, path="a"))
        "sortie.sim.identity.file_digest(path='a')"
    """
    if isinstance(thing, functools.partial):
        bound = [*map(_argument, thing.args), *(f"{key}={_argument(value)}" for key, value in thing.keywords.items())]
        return f"{name_of(thing.func)}({', '.join(bound)})"
    own = {*vars(type(thing)), *getattr(thing, "__dict__", ())}
    if "name" in own and isinstance(name := getattr(thing, "name", None), str):
        return name
    source: Any = thing if hasattr(thing, "__qualname__") else type(thing)
    return f"{source.__module__}.{source.__qualname__}"


def policy_files(scenario: Scenario) -> list[str]:
    """The policies of a scenario that are in files, as it names them."""
    named = named_models(scenario.model_dump(mode="json"))
    return [name for kind, name in named if kind == "policy" and is_file(name)]


def own_files(
    scenario: Scenario, policy: str | Callable[..., object] | None = None, detector: object = None
) -> dict[str, str]:
    """The files beside the package that a sortie reads.

    Those are the files that the scenario names (models of one's own, weights, recordings, traces), the files of objects
    that were passed in, and the modules that Python files among them have imported. The standard library and installed
    packages do not count, but for packages that offer a model which flies.

    Args:
        scenario: what flies.
        policy: a name, `file.py:function` or a callable that decides in place of the scenario's policies.
        detector: the detector that flies.

    Returns:
        16 hex digits of SHA-256 by path, or by name and version of a package. An object without a file stands under its name, with the digest of its
        source, or of nothing where Python has none.

    Raises:
        PluginError: a file of a model is not there, or does not load.
        ScenarioError: another file that the scenario names is not there.
        OSError: a file cannot be read.
    """
    sections = scenario.model_dump(mode="json")
    if policy is not None and policy != scenario.policy.name:
        sections["policy"] = {"name": policy if isinstance(policy, str) else ""}
    for kind, name in named_models(sections):
        if is_file(name):
            file_of(kind, name)  # its errors: a model that does not fly may be missing
    ensure_files(sections)
    named = {name: located(Path(name)) for name in named_files(sections)}
    found = {name: _digest(path) for name, path in named.items() if path.suffix != ".py"}
    modules = {file for path in named.values() if path.suffix == ".py" for file in code_files(path)}
    for thing in (None if isinstance(policy, str) else policy, detector):
        function: Any = inspect.unwrap(thing.func if isinstance(thing, functools.partial) else thing)  # type: ignore[arg-type]
        function = function if inspect.isroutine(function) else type(function)
        if thing is None or str(getattr(function, "__module__", "")).partition(".")[0] == "sortie":
            continue
        try:
            file = Path(inspect.getsourcefile(function) or "")
            source = inspect.getsource(function)
        except (OSError, TypeError, SyntaxError, TokenError):  # typed in, written in C, or its file holds other text
            file, source = Path(), ""
        if file.is_file():
            modules.update(imported_files(file))
        else:
            found[name_of(thing)] = hashlib.sha256(source.encode()).hexdigest()[:16]
    found |= packages(named_models(sections))
    return found | {_shown(path): _digest(path) for path in sorted(modules)}


def packages(models: Iterable[tuple[str, str]], code: Iterable[str] = ()) -> dict[str, str]:
    """The installed packages on which models depend.

    Args:
        models: kinds and names.
        code: files; of those in Python, the packages that they import count too.

    Returns:
        By `name version` the digest of the Python files of a package that offers a model; no digest for an imported one.
    """
    imported = {name for path in code if path.endswith(".py") for name in imported_packages(Path(path))}
    offered = dict(package for kind, name in models if (package := package_of(kind, name)) is not None)
    return {f"{name} {installed(name)}": "" for name in sorted(imported)} | offered


def _digest(path: Path) -> str:
    """16 hex digits of a file, or of a folder's files with their names."""
    if not path.is_dir():
        return file_digest(path)[:16]
    inside = sorted(file for file in path.rglob("*") if file.is_file())
    lines = "".join(f"{file.relative_to(path).as_posix()} {_digest(file)}\n" for file in inside)
    return hashlib.sha256(lines.encode()).hexdigest()[:16]


def _shown(path: Path) -> str:
    """A path from the working folder where it is below it."""
    here = Path.cwd()
    return (path.relative_to(here) if path.is_relative_to(here) else path).as_posix()


def file_digest(path: Path) -> str:
    """SHA-256 of a file as it is now, hex. It is read again only once its size or its time of change differ.

    Raises:
        OSError: the file cannot be read.
    """
    now = regular(path).stat()
    return _digest_as_it_stands(path, now.st_size, now.st_mtime_ns)


def content_digest(path: str) -> str:
    """SHA-256 of a file, or of the names in a folder, as they are now; empty where there is nothing to read."""
    try:
        if os.path.isdir(path):
            return hashlib.sha256("\0".join(sorted(os.listdir(path))).encode()).hexdigest()
        return file_digest(Path(path))
    except OSError:
        return ""


@functools.lru_cache(maxsize=4096)
def _digest_as_it_stands(path: Path, size: int, changed_ns: int) -> str:
    """A recording may be large and fly often."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _required() -> set[str]:
    """Libraries that the package requires, the optional ones left out."""
    needed = [line for line in requires(DISTRIBUTION) or () if "extra ==" not in line]
    return {match[0].lower() for line in needed if (match := re.match(r"[\w.-]+", line))}
