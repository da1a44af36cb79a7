"""Which code made a record: the release, and a digest of everything that the package holds and stands on."""

from __future__ import annotations

import functools
import hashlib
import inspect
import re
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path

from sortie.policies.user_code import imported_files
from sortie.scenarios.reading.files import named_files
from sortie.scenarios.schema import Scenario

DISTRIBUTION = "sortie-sim"
RELEASE = version(DISTRIBUTION)
_UNREAD = re.compile(r"\..*|__pycache__|.*\.md")
"""Names of files and folders that no run reads: hidden ones, caches, pages."""


@functools.cache
def code_version() -> str:
    """The release, a plus sign, and 16 hex digits of a SHA-256 digest.

    The digest covers every file of the installed package (sources, compiled parts, learned parameters, the library of
    scenarios) and the version of every library that the package requires. Two processes with equal versions run the
    same code.

    Example:
        >>> code_version().partition("+")[0] == RELEASE
        True
    """
    digest = hashlib.sha256()
    for name, data in sorted(_files(files("sortie"), "")):
        digest.update(f"{name}\0{len(data)}\0".encode())
        digest.update(data)
    for library in sorted(_required()):
        digest.update(f"{library}={_installed(library)}\0".encode())
    return f"{RELEASE}+{digest.hexdigest()[:16]}"


def release_of(code: str) -> str:
    """The release in a `code_version`.

    Example:
        >>> release_of("0.1.0+0123456789abcdef")
        '0.1.0'
    """
    return code.partition("+")[0]


def user_code(scenario: Scenario, policy: str | Callable[..., object] | None = None) -> dict[str, str]:
    """The user's own code that a sortie runs: every Python file that the scenario names, and every module that such a
    file imports from outside the standard library and installed packages.

    Args:
        scenario: whose policies and fusion may be in files.
        policy: a name, `file.py:function` or a callable that decides in place of the scenario's policy.

    Returns:
        16 hex digits of SHA-256 by path; a callable that is in no file stands under its name with the digest of its
        source, or of nothing where Python has none.
    """
    named = [Path(name) for name in named_files(scenario.model_dump(mode="json")) if name.endswith(".py")]
    found = {}
    if isinstance(policy, str):
        named += [Path(policy.rpartition(":")[0])] if ":" in policy else []
    elif policy is not None:
        function = inspect.unwrap(policy.func if isinstance(policy, functools.partial) else policy)
        function = function if inspect.isroutine(function) else type(function)
        home = str(getattr(function, "__module__", "")).partition(".")[0]
        try:
            file = Path(inspect.getsourcefile(function) or "")
            source = inspect.getsource(function)
        except (OSError, TypeError):  # typed in, or written in C
            file, source = Path(), ""
        if file.is_file() and home != "sortie":
            named.append(file)
        elif home != "sortie":
            found[function.__qualname__] = hashlib.sha256(source.encode()).hexdigest()[:16]
    files = {file for path in named for file in imported_files(path)}
    return found | {_shown(path): file_digest(path)[:16] for path in sorted(files)}


def _shown(path: Path) -> str:
    """A path from the working folder where it is below it."""
    here = Path.cwd()
    return (path.relative_to(here) if path.is_relative_to(here) else path).as_posix()


def file_digest(path: Path) -> str:
    """SHA-256 of a file, hex.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _files(folder: Traversable, prefix: str) -> list[tuple[str, bytes]]:
    """Every file below a folder of the package: its path in the package, and what it holds."""
    found = []
    for entry in folder.iterdir():
        if _UNREAD.fullmatch(entry.name):
            continue
        if entry.is_dir():
            found += _files(entry, f"{prefix}{entry.name}/")
        else:
            found.append((f"{prefix}{entry.name}", entry.read_bytes()))
    return found


def _required() -> set[str]:
    """Libraries that the package requires, the optional ones left out."""
    needed = [line for line in requires(DISTRIBUTION) or () if "extra ==" not in line]
    return {match[0].lower() for line in needed if (match := re.match(r"[\w.-]+", line))}


def _installed(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return "none"
