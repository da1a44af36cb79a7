"""Write a file or a folder whole: under a temporary name beside its place, which it takes when it is complete."""

from __future__ import annotations

import os
import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PARTIAL = ".sortie-partial"
"""How temporary names end. They begin with a dot, so that nobody takes them for what is whole."""
_ABANDONED_S = 24 * 3600.0
"""What is not whole after this time was left by a process that was killed."""


@contextmanager
def replacing(path: Path, *, replace: bool = True) -> Iterator[Path]:
    """A name for a new file or folder, which takes the place of `path` at the end; after an error, nothing changes.

    Folders above it are made. A link stays: what it leads to is replaced. A device or a pipe is written itself.

    Args:
        path: the file or folder to be.
        replace: whether a folder with files may be replaced.

    Raises:
        OSError: the disk refuses, or a folder with files is there that may not be replaced.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        yield path
        return
    place = path.resolve()
    partial, old = (place.with_name(f".{secrets.token_hex(8)}{PARTIAL}") for _ in range(2))
    place.parent.mkdir(parents=True, exist_ok=True)
    _tidy(place.parent)
    try:
        yield partial
        for file in [partial] if partial.is_file() else [p for p in partial.rglob("*") if p.is_file()]:
            with file.open("rb") as written:
                os.fsync(written.fileno())
        if replace and partial.is_dir() and place.is_dir():  # a folder cannot be renamed over a full one
            place.rename(old)
        partial.rename(place)
        _remove(old)
    finally:
        _remove(partial)


def _tidy(folder: Path) -> None:
    """Remove what killed processes left in a folder."""
    for left in folder.glob(f".*{PARTIAL}"):
        with suppress(FileNotFoundError):  # another process has just renamed it
            if time.time() - left.stat().st_mtime > _ABANDONED_S:
                _remove(left)


def _remove(path: Path) -> None:
    """Remove a file, a folder, or nothing."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
