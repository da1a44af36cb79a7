"""Files and folders that commands write: their places are checked before the work, and taken by what is whole."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from sortie.scenarios.errors import SortieError
from sortie.scenarios.replacing import replacing

_HEAD_BYTES = 1000


class RunError(SortieError):
    """A file or folder that cannot be used as the user asked; the message names the path."""


def ensure_folder(path: Path, holds: str, what: str, written: Collection[str]) -> None:
    """Refuse a path that `writing` could not turn into a folder, before anything is flown or measured.

    Args:
        path: the folder to be.
        holds: a file by which an older one of the kind is known.
        what: the kind's name, as in "run".
        written: all that one of the kind may hold, by its path in it; the user's own files are not replaced with it.

    Raises:
        RunError: it holds something else, or cannot be made.
    """
    if Path.cwd().is_relative_to(path.resolve()):
        raise RunError(f"{path}: is the working folder or holds it, a {what} would replace it; name another folder")
    ensure_place(path)
    if path.exists() and not path.is_dir():
        raise RunError(f"{path}: is a file, a {what} needs a folder")
    names = sorted(entry.name for entry in path.iterdir()) if path.is_dir() else []
    known = {Path(name).parts[0] for name in written} if holds in names else ()
    if others := [name for name in names if name not in known]:
        raise RunError(f"{path}: holds {others[0]}, which no {what} wrote; choose another folder or move it")


def ensure_files(*paths: Path | None, replace: bool = True, mark: str | None = None) -> None:
    """Refuse paths of files that could not be written, before anything is flown or measured; None is no file.

    Args:
        paths: the files to be.
        replace: whether files that exist may be replaced, whoever wrote them.
        mark: a text near the begin of what the command writes. A file that has it may be replaced.

    Raises:
        RunError: one is a folder, is named twice, cannot be made, or exists and may not be replaced.
    """
    places: set[Path] = set()
    for path in filter(None, paths):
        if path.is_dir():
            raise RunError(f"{path}: is a folder, must be a file")
        if path.exists() and not path.is_file():  # a device or a pipe, such as /dev/stdout
            continue
        ensure_place(path)
        if path.resolve() in places:
            raise RunError(f"{path}: two outputs have this name, and one would replace the other; name two files")
        places.add(path.resolve())
        if not replace and path.is_file():
            with path.open("rb") as file:
                if mark is None or mark.encode() not in file.read(_HEAD_BYTES):
                    raise RunError(f"{path}: exists already; choose another file, or replace it with --replace")


def ensure_place(path: Path) -> None:
    """Refuse a path if its folder cannot be made or written to."""
    there = next(p for p in path.resolve().parents if p.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise RunError(f"{path}: its folder cannot be made or written to: {there} is a file, or is not writable")


@contextmanager
def writing(path: Path, *, replace: bool = True) -> Iterator[Path]:
    """As `replacing`; what the disk refuses is a RunError that names the path."""
    try:
        with replacing(path, replace=replace) as partial:
            yield partial
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror or error}") from error


def write_text(path: Path, text: str) -> None:
    """Write a text file whole. Raises RunError where the disk refuses."""
    with writing(path) as partial:
        partial.write_text(text, "utf-8")
