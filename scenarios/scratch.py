"""Room on disk for what a long sortie cannot keep in memory: arrays and tapes in files without a name.

The operating system removes these files with the process that has them, however it ends, so a killed sortie leaves nothing.
The pages of an array count as the process's memory once they are touched; `release` gives them back, and loses nothing.
"""

from __future__ import annotations

import io
import math
import mmap
import os
import sys
import tempfile
import threading
import weakref
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from sortie.scenarios.errors import SortieError

IN_MEMORY_BYTES = 1 << 20
"""Arrays up to this size stay in memory: a short sortie needs no disk."""
BLOCK_BYTES = 1 << 20
TAPE_IN_MEMORY_BYTES = 16 << 20
"""So much of a tape stays in memory. What is more goes to disk, with all before it."""
_LARGE = "/var/tmp"  # noqa: S108 (the convention: /tmp may be a part of the memory, this is not)
_maps: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()
_lock = threading.Lock()  # sorties may fly in threads (`sortie.sim.env`)


class ScratchError(SortieError):
    """No room on disk for what a sortie puts there while it flies."""


def folder() -> str:
    """Where scratch files lie: `TMPDIR` where that is set, else a folder on disk if there is one."""
    if "TMPDIR" not in os.environ and os.access(_LARGE, os.W_OK):
        return _LARGE
    return tempfile.gettempdir()


class Tape:
    """Bytes that are written one behind the other and read when all are there; on disk where they are many."""

    def __init__(self) -> None:
        self._early = io.BytesIO()
        self._file: BinaryIO | None = None
        self.size = 0

    def append(self, data: Any) -> int:
        """Append bytes, or anything that has a buffer of them; returns where they begin.

        Raises:
            ScratchError: the disk refuses.
        """
        begin, view = self.size, memoryview(data).cast("B")
        self.size += len(view)
        if self._file is None and self.size > TAPE_IN_MEMORY_BYTES:
            self._file = _new_file()
            weakref.finalize(self, self._file.close)
            self._write(self._early.getbuffer())
            self._early = io.BytesIO()
        self._write(view)
        return begin

    def _write(self, data: memoryview) -> None:
        try:
            (self._early if self._file is None else self._file).write(data)
        except OSError as error:
            raise _no_room(error) from error

    def finish(self) -> memoryview | mmap.mmap:
        """All bytes; nothing can be appended any more.

        Raises:
            ScratchError: the disk refuses.
        """
        if self._file is None:
            return self._early.getbuffer()
        try:
            self._file.flush()
        except OSError as error:
            raise _no_room(error) from error
        with self._file as file:  # the map has a handle of its own
            return _mapped(file, mmap.ACCESS_READ)


def _new_file(size: int = 0) -> BinaryIO:
    try:
        file = cast(BinaryIO, tempfile.TemporaryFile(dir=folder()))  # noqa: SIM115 (the caller has it)
        if size and sys.platform == "darwin":
            file.truncate(size)
        elif size:  # a full disk would otherwise end the process at a later write
            os.posix_fallocate(file.fileno(), 0, size)
    except OSError as error:
        raise _no_room(error) from error
    return file


def _no_room(error: OSError) -> ScratchError:
    what = f"no room for the sortie's temporary files: {error.strerror}"
    return ScratchError(f"{folder()}: {what}; set TMPDIR to a folder with room")


def _mapped(file: BinaryIO, access: int) -> mmap.mmap:
    new = mmap.mmap(file.fileno(), 0, access=access)
    with _lock:
        _maps.add(new)
    return new


def empty(shape: tuple[int, ...]) -> NDArray[np.float64]:
    """A new array of floats; its values are undefined until they are written.

    Raises:
        ScratchError: the disk refuses.
    """
    count = math.prod(shape)
    if count * 8 <= IN_MEMORY_BYTES:
        return np.empty(shape)
    with _new_file(count * 8) as file:
        return np.frombuffer(_mapped(file, mmap.ACCESS_WRITE), np.float64, count).reshape(shape)


def copied(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """An array of its own with the same values.

    Raises:
        ScratchError: the disk refuses.
    """
    new = empty(values.shape)
    for rows in blocks(len(values), values[0].nbytes if len(values) else 0):
        new[rows] = values[rows]
        release()
    return new


def blocks(rows: int, row_bytes: int) -> list[slice]:
    """All rows of an array in blocks of about `BLOCK_BYTES`, none of a single row unless there is no other."""
    each = max(2, BLOCK_BYTES // max(1, row_bytes))
    begins = list(range(0, max(1, rows - 1), each))
    return [slice(a, b) for a, b in zip(begins, [*begins[1:], rows], strict=True)]


def release() -> None:
    """Take the pages of all arrays and maps out of memory. They come back when they are touched."""
    with _lock:
        maps = list(_maps)
    for each in maps:
        each.madvise(mmap.MADV_DONTNEED)
