"""Which data files a user's code has read in this process: a row of a flight depends on what they held."""

from __future__ import annotations

import os
import sys
import sysconfig
import threading
from importlib.util import source_from_cache
from pathlib import Path
from types import FrameType

from sortie.scenarios.plugins import user_calls
from sortie.sim.identity import content_digest

_SORTIE = str(Path(__file__).parents[2]) + os.sep
_LIBRARIES = tuple(
    {sysconfig.get_path(name) + os.sep for name in ("stdlib", "platstdlib", "purelib", "platlib")} | {"<"}
)
"""Libraries, which read for whoever calls them."""
_WRITING = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
_LISTING = {"os.listdir", "os.scandir"}
_read: dict[str, str] = {}
_watching = _looking = False


def watch() -> None:
    """From now on, note what a user's code opens for reading, as it is then. Python has no way to end that.

    Python tells of what Python opens; what a compiled library opens by itself, as pyarrow and HDF5 do, is not seen.
    """
    global _watching
    if not _watching:
        _watching = True
        sys.addaudithook(_note)


def files_read() -> dict[str, str]:
    """SHA-256 digests by absolute path, of everything so far: a module keeps what it read when it was loaded."""
    return dict(_read)


def _note(event: str, arguments: tuple[object, ...]) -> None:
    global _looking
    if _looking or (event != "open" and event not in _LISTING):
        return
    flags = arguments[2] if event == "open" else 0
    if not isinstance(arguments[0], str | bytes) or not isinstance(flags, int) or flags & _WRITING:
        return
    _looking = True  # a digest opens the file
    try:
        path = os.fsdecode(arguments[0])
        path = source_from_cache(path) if path.endswith(".pyc") else path
        begins = sys._getframe(1)
        if event != "open" and begins.f_code.co_filename.startswith("<"):
            return  # an import looks through folders
        if not path.startswith(_LIBRARIES) and _is_users(begins):
            # as it was named: from another working folder, or through another link, it is another file
            for name in {path, str(Path(path).resolve())}:
                _read[name] = content_digest(name)
    except ValueError:  # whoever opens it gets the error
        pass
    finally:
        _looking = False


def _is_users(frame: FrameType | None) -> bool:
    """Whether the innermost code that is no library's is a user's, and Sortie has called it: a user's program reads what it likes.

    A thread's reads are the user's too: nobody sees who began it. So are those of installed models, which Sortie calls by `user_calls`.
    """
    users = False
    while frame is not None:
        file = frame.f_code.co_filename
        if file.startswith(_SORTIE):
            return users or file == user_calls.__file__
        users = users or not file.startswith(_LIBRARIES)
        frame = frame.f_back
    return users and threading.current_thread() is not threading.main_thread()
