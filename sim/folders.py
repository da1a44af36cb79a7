"""Folders and files that commands write: checked before the work starts, replaced whole when it is done."""

from __future__ import annotations

import errno
import glob
import os
import secrets
import shutil
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import BinaryIO

import psutil

from sortie.scenarios.errors import SortieError
from sortie.scenarios.report_text import replace_section

_PARTIAL, _ASIDE = ".partial", ".old"
_RUN = ("outcome.json", "record.json", "scenario.yaml")
"""Every run's folder has these, and its tables as Parquet."""
_NAME_BYTES = 228
"""A name may have so many bytes: file systems allow 255, and `partial_path` adds some."""

GENERATOR = '<meta name="generator" content="Sortie">'
"""In the head of each page that Sortie writes."""
_HEAD_BYTES = 1000


class RunError(SortieError):
    """A file or folder that cannot be used as the user asked; the message names the path."""


def ensure_folder(path: Path, holds: str, what: str, written: Collection[str] = (), *, replace: bool = True) -> None:
    """Refuse a path that `replacing` could not use, before anything is flown or measured.

    Args:
        path: the folder to be.
        holds: a file by which an older one of the kind is known.
        what: the kind's name, as in "run".
        written: all that one of the kind may hold, by its path in it, so that nothing of a user's goes when it is
            replaced; left out, anything.
        replace: whether an older one may be replaced.

    Raises:
        RunError: it holds something else, or one that may not be replaced; or it cannot be made.
    """
    if not path.resolve().name:
        raise RunError(f"{path}: is the root of the file system, a {what} needs a folder below it")
    _ensure_place(path)
    if not path.exists():
        return
    if not path.is_dir():
        raise RunError(f"{path}: is a file, a {what} needs a folder")
    names = sorted(entry.name for entry in path.iterdir())
    if names and not (path / holds).is_file():
        raise RunError(f"{path}: holds files but no {holds}; a {what} would replace them, name another folder")
    known = {*(Path(name).parts[0] for name in written), ".DS_Store"}  # a desktop that looked in
    if written and (others := [name for name in names if name not in known]):
        more = f" and {len(others) - 1} more" if len(others) > 1 else ""
        raise RunError(f"{path}: holds {others[0]}{more}, which no {what} wrote; choose another folder or move it")
    if names and not replace:
        raise RunError(f"{path}: holds a {what} already; choose another folder, or replace it with --replace")


def ensure_files(*paths: Path | None, replace: bool = True) -> None:
    """Refuse paths of files that could not be written, before anything is flown or measured; None is no file.

    Args:
        paths: the files to be.
        replace: whether files that exist may be replaced, whoever wrote them. A page of Sortie always may.

    Raises:
        RunError: one is a folder, a part of a run, named twice, cannot be made, or exists and may not be replaced.
    """
    places: set[Path] = set()
    for path in filter(None, paths):
        if path.is_dir():
            raise RunError(f"{path}: is a folder, must be a file")
        if _is_device(path):
            continue
        _ensure_place(path)
        _ensure_spared(path.resolve())
        if path.resolve() in places:
            raise RunError(f"{path}: two outputs have this name, and one would replace the other; name two files")
        places.add(path.resolve())
        if not replace and os.path.lexists(path) and not _is_own_page(path):
            raise RunError(f"{path}: exists already; choose another file, or replace it with --replace")


def _is_own_page(path: Path) -> bool:
    """Whether a file is an HTML page that Sortie wrote."""
    with path.open("rb") as file:
        return GENERATOR.encode() in file.read(_HEAD_BYTES)


def _ensure_spared(path: Path) -> None:
    """Refuse to replace a file of a run: without it the others are none.

    Raises:
        RunError: it is one.
    """
    its = path.name in _RUN or path.suffix == ".parquet"
    if its and path.exists() and all((path.parent / name).is_file() for name in _RUN):
        raise RunError(f"{path}: is a part of the run in {path.parent}, which would be lost; name another file")


def ensure_between(path: Path | None, begin: str, end: str) -> None:
    """Refuse a file that `put_between` could not put a section into, before it is made; None is none.

    Raises:
        RunError: no such file, or one without the markers.
    """
    if path is not None:
        _put_between(path, begin + end, begin, end)
        _ensure_place(path)


@contextmanager
def replacing(path: Path, *, replace: bool = True) -> Iterator[Path]:
    """A new temporary folder beside `path` that takes its place at the end; where the block fails, nothing changes.

    Args:
        path: the folder to be.
        replace: whether it takes the place of a folder with files; otherwise that one stays, and the new one goes.

    Raises:
        RunError: the disk refuses.
    """
    place = path.resolve()  # where a link leads: the link stays
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        with partial_path(place, Path.mkdir) as partial:
            yield partial
            aside = partial.with_suffix(_ASIDE)
            if replace and place.exists():  # a folder cannot be renamed over a full one
                place.rename(aside)
            with suppress(FileExistsError) if not replace else nullcontext():
                _rename(partial, place)
            _remove(aside)
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror or error}") from error


def _rename(folder: Path, place: Path) -> None:
    """Raises FileExistsError: a folder with files is there."""
    try:
        folder.rename(place)
    except OSError as error:
        if error.errno == errno.ENOTEMPTY:
            raise FileExistsError(error.errno, error.strerror) from None
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text durably, its folder too where there is none.

    Raises:
        RunError: the disk refuses.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, text.encode())
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror or error}") from error


def write_durably(path: Path, data: bytes) -> None:
    """A file whole or not at all, under a temporary name and then renamed; on disk at the return.

    Raises:
        OSError: the disk refuses.
    """
    with writing_durably(path) as file:
        file.write(data)


@contextmanager
def writing_durably(path: Path) -> Iterator[BinaryIO]:
    """A file to write, as `write_durably` does, piece by piece; where the block fails, an older file stays.

    Raises:
        RunError: it is a part of a run.
        OSError: the disk refuses.
    """
    with partial_file(path) as partial, partial.open("wb") as file:
        yield file
        file.flush()
        if partial.is_file():
            os.fsync(file.fileno())


@contextmanager
def partial_file(path: Path) -> Iterator[Path]:
    """A temporary file to write that takes the place of `path` at the end; where the block fails, an older file stays.

    A link stays: the file that it leads to is replaced. A device or a pipe, such as `/dev/stdout`, is written itself.

    Raises:
        OSError: the disk refuses.
    """
    if _is_device(path):
        yield path
        return
    place = path.resolve()
    _ensure_spared(place)
    with partial_path(place, Path.touch) as partial:
        yield partial
        partial.replace(place)
    sync_folder(place.parent)


@contextmanager
def partial_path(path: Path, make: Callable[[Path], None]) -> Iterator[Path]:
    """A file or folder beside `path` under a name that nobody else has, to be written and then renamed.

    What is still there at the end is removed, and so is what a process left that was killed.

    Args:
        path: what it will be.
        make: makes it, empty: `Path.touch` or `Path.mkdir`.

    Raises:
        OSError: the disk refuses.
    """
    _tidy(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}{_PARTIAL}")
    make(partial)
    try:
        yield partial
    finally:
        _remove(partial)


def sync_folder(folder: Path) -> None:
    """Its entries are on disk at the return."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def put_between(path: Path, section: str, begin: str, end: str) -> None:
    """Replace a Markdown file's section between its markers, which the new one holds too.

    Raises:
        RunError: no such file, or one without the markers.
    """
    write_text(path, _put_between(path, section, begin, end))


def _put_between(path: Path, section: str, begin: str, end: str) -> str:
    try:
        return replace_section(path.read_text(encoding="utf-8"), section, begin, end)
    except OSError as error:
        raise RunError(f"{path}: {error.strerror or error}") from error
    except ValueError as error:
        raise RunError(f"{path}: {error}") from error


def _is_device(path: Path) -> bool:
    """Whether a path leads to a device or a pipe."""
    return path.exists() and not (path.is_file() or path.is_dir())


def _ensure_place(path: Path) -> None:
    """Refuse a path if its name is too long, or its folder cannot be made or written to."""
    place = path.resolve()
    if (length := len(os.fsencode(place.name))) > _NAME_BYTES:
        raise RunError(f"{path}: a name of {length} bytes, must have at most {_NAME_BYTES}")
    there = next(p for p in place.parents if p.exists())
    if not there.is_dir():
        raise RunError(f"{path}: cannot make its folder: {there} is a file")
    if not os.access(there, os.W_OK):
        raise RunError(f"{path}: its folder {there} is not writable")


def _tidy(path: Path) -> None:
    """Remove what killed processes left beside a path. An older folder that had stepped aside comes back."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.*-????????.*"):
        writer = left.name[len(path.name) + 2 :].partition("-")[0]
        if left.suffix not in (_PARTIAL, _ASIDE) or not writer.isdigit() or psutil.pid_exists(int(writer)):
            continue
        if left.suffix == _ASIDE and not path.exists():
            left.rename(path)
        _remove(left)


def _remove(path: Path) -> None:
    """Remove a file, a folder, or nothing."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
