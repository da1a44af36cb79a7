"""A digest of Sortie's own files and of the versions of libraries: what results that are kept were computed by."""

from __future__ import annotations

import functools
import hashlib
import re
from collections.abc import Iterable, Iterator
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from importlib.resources.abc import Traversable

_UNREAD = re.compile(r"\..*|__pycache__|.*\.md")
"""Names of files and folders that no run reads: hidden ones, caches, pages."""


def digest_of(contents: Iterable[tuple[str, bytes]], libraries: Iterable[str]) -> str:
    """SHA-256 of named contents and of the versions of libraries, hex."""
    digest = hashlib.sha256()
    for name, data in sorted(contents):
        digest.update(f"{name}\0{len(data)}\0".encode())
        digest.update(data)
    for library in sorted(libraries):
        digest.update(f"{library}={installed(library)}\0".encode())
    return digest.hexdigest()


@functools.cache
def sources_digest(rooms: tuple[str, ...], libraries: tuple[str, ...]) -> str:
    """16 hex digits over the Python files of some rooms, and the versions of libraries.

    Example:
        >>> sources_digest(("scenarios",), ("numpy",)) == sources_digest(("scenarios",), ())
        False
    """
    inside = (item for room in rooms for item in contents(files(f"sortie.{room}"), f"{room}/"))
    return digest_of((item for item in inside if item[0].endswith(".py")), libraries)[:16]


def contents(folder: Traversable, prefix: str = "") -> Iterator[tuple[str, bytes]]:
    """Every file below a folder of the package: its path in the package, and what it holds."""
    for entry in folder.iterdir():
        if _UNREAD.fullmatch(entry.name):
            continue
        if entry.is_dir():
            yield from contents(entry, f"{prefix}{entry.name}/")
        else:
            yield f"{prefix}{entry.name}", entry.read_bytes()


def installed(library: str) -> str:
    """A library's version; `none` where it is missing."""
    try:
        return version(library)
    except PackageNotFoundError:
        return "none"
